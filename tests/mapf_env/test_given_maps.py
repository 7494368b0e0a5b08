"""Environments on a given map or given cases, and errors for unknown settings."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pettingzoo
import pytest

import oracles
from mapf_env import BatchedEnv, Instance, env, joint_env, parallel_env, parse_map, random_instance

GRID = parse_map("""
    ..#....
    .##.#..
    ....#..
""")
FREE = oracles.free_cells(GRID)

State = tuple[npt.NDArray[np.bool_], list[oracles.Cell], list[oracles.Cell]]


def as_batch(**settings: Any) -> Callable[[int | None], State]:
    batch = BatchedEnv(1, **settings)

    def begin(seed: int | None) -> State:
        batch.reset(seed)
        return batch.grids[0], oracles.cells(batch.positions[0]), oracles.cells(batch.goals[0])

    return begin


def as_parallel(**settings: Any) -> Callable[[int | None], State]:
    one = parallel_env(**settings)

    def begin(seed: int | None) -> State:
        one.reset(seed=seed)
        return one.grid, oracles.cells(one.positions), oracles.cells(one.goals)

    return begin


def as_aec(**settings: Any) -> Callable[[int | None], State]:
    turns = env(**settings)

    def begin(seed: int | None) -> State:
        turns.reset(seed=seed)
        one: Any = turns.unwrapped
        return one.grid, oracles.cells(one.positions), oracles.cells(one.goals)

    return begin


def as_joint(**settings: Any) -> Callable[[int | None], State]:
    one = joint_env(**settings)

    def begin(seed: int | None) -> State:
        one.reset(seed=seed)
        batch = one._batch
        return batch.grids[0], oracles.cells(batch.positions[0]), oracles.cells(batch.goals[0])

    return begin


INTERFACES = [as_batch, as_parallel, as_aec, as_joint]


@pytest.mark.parametrize("make", INTERFACES)
def test_a_given_map_is_played_with_drawn_starts_and_goals(make: Callable[..., Callable[[int | None], State]]) -> None:
    begin, begun = make(grid=GRID.astype(int), num_agents=3), set()
    for seed in range(8):
        grid, starts, goals = begin(seed)
        assert np.array_equal(grid, GRID)
        assert set(starts) | set(goals) <= FREE
        assert len(set(starts)) == len(set(goals)) == 3
        assert begin(seed)[1:] == (starts, goals)
        begun.add((*starts, *goals))
    assert len(begun) > 4
    expected = random_instance(grid=GRID, num_agents=3, seed=0)
    assert expected.num_agents == 3


@pytest.mark.parametrize("make", INTERFACES)
def test_given_cases_are_played(make: Callable[..., Callable[[int | None], State]]) -> None:
    cases = [random_instance(num_agents=2, height=5, width=6, seed=seed) for seed in range(3)]
    begin = make(cases=iter(cases), num_agents=2, height=5, width=6)
    played = {Instance(*begin(seed)) for seed in range(20)}
    assert played == set(cases)


@pytest.mark.parametrize("make", INTERFACES)
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"grid": GRID, "height": 5}, "the grid has a height of 3, got height=5: leave out height"),
        ({"grid": GRID, "num_agents": len(FREE) + 1}, "agents"),
        ({"grid": GRID, "cases": [], "num_agents": 3}, "give cases or a grid, not both"),
        ({"grid": np.zeros((2, 2, 2), bool)}, r"grid must have shape \(H, W\)"),
        ({"cases": []}, "there are no cases to play"),
        ({"cases": [random_instance(num_agents=2)]}, "the instance has 2 agents, the environment 10"),
    ],
)
def test_maps_and_cases_that_do_not_fit_are_refused(
    make: Callable[..., Any], settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make(**settings)


def test_an_own_map_is_played_again_after_an_instance_of_another_size() -> None:
    one, joint = parallel_env(grid=GRID, num_agents=2), joint_env(grid=GRID, num_agents=2)
    other = {"instance": random_instance(num_agents=2, height=4, width=9, seed=0)}
    for reset in (one.reset, joint.reset):
        reset(seed=0)
        reset(options=other)
        reset()
    assert np.array_equal(one.grid, GRID)
    assert np.array_equal(joint._batch.grids[0], GRID)


@pytest.mark.parametrize(
    "make", [*INTERFACES, lambda **settings: pettingzoo.make("parallel", "mapf/grid-v0", **settings)]
)
def test_an_unknown_setting_is_refused_with_the_nearest_one_and_all_that_exist(make: Callable[..., Any]) -> None:
    with pytest.raises(
        TypeError, match=r"there is no setting 'fov_radios': did you mean 'fov_radius'\? .*comm_radius, "
    ):
        make(fov_radios=3)
    with pytest.raises(TypeError, match=r"there is no setting 'xyz': the settings are .*cases, .*, grid, .*, width"):
        make(xyz=3)
