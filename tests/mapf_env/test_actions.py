"""One rule for actions, the same in each interface: integers 0..4, where True and False are not integers."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import mapf_env
from mapf_env import Action, BatchedEnv, Instance, joint_env, parallel_env, parse_instance, rules

INSTANCE = parse_instance("""
    ...B
    A..b
    a...
""")
SIZE: dict[str, Any] = {"num_agents": 2, "height": 3, "width": 4, "density": 0.0}
AGENTS = ("agent_0", "agent_1")

Positions = list[list[int]]
Play = Callable[[Any, Any], Positions]
"""Plays two actions from `INSTANCE` and returns where the robots are then."""


class TensorScalar:
    """A number of another array library: an index even where its dtype says that it is a truth value."""

    def __init__(self, value: int, dtype: str) -> None:
        self.value, self.dtype = value, dtype

    def __index__(self) -> int:
        return self.value


def by_agent(**settings: Any) -> Play:
    def play(first: Any, second: Any) -> Positions:
        env = parallel_env(**SIZE, **settings)
        env.reset(seed=0, options={"instance": INSTANCE})
        env.step({"agent_0": first, "agent_1": second})
        return env.positions.tolist()

    return play


def in_turns(first: Any, second: Any) -> Positions:
    env = mapf_env.env(**SIZE)
    env.reset(seed=0, options={"instance": INSTANCE})
    env.step(first)
    env.step(second)
    return env.unwrapped.positions.tolist()  # pyright: ignore[reportAttributeAccessIssue]


def by_team(first: Any, second: Any) -> Positions:
    env = joint_env(**SIZE)
    env.reset(seed=0, options={"instance": INSTANCE})
    env.step([first, second])  # pyright: ignore[reportArgumentType]
    return env._batch.positions[0].tolist()


def in_a_batch(first: Any, second: Any) -> Positions:
    env = BatchedEnv(2, **SIZE)
    env.reset(seed=0, instances=[INSTANCE, INSTANCE])
    env.step([[4, 4], [first, second]])
    return env.positions[1].tolist()


def by_the_rules(first: Any, second: Any) -> Positions:
    maps, seeds, times = rules.bordered(INSTANCE.grid[None], 1), np.zeros(1, np.uint64), np.zeros(1, np.int64)
    executed = rules.shield(maps, 1, INSTANCE.starts[None], [[first, second]], seeds, times)
    rules.move(INSTANCE.starts[None], [[first, second]])
    return rules.move(INSTANCE.starts[None], executed)[0].tolist()


def by_the_pibt_rules(first: Any, second: Any) -> Positions:
    maps, seeds, times = rules.bordered(INSTANCE.grid[None], 1), np.zeros(1, np.uint64), np.zeros(1, np.int64)
    under_way = np.zeros((1, 2), np.int32)
    executed = rules.pibt_shield(maps, 1, INSTANCE.starts[None], [[first, second]], under_way, seeds, times)
    return rules.move(INSTANCE.starts[None], executed)[0].tolist()


INTERFACES = pytest.mark.parametrize(
    "play",
    [
        by_agent(),
        by_agent(reuse_buffers=True),
        by_agent(shield="pibt"),
        in_turns,
        by_team,
        in_a_batch,
        by_the_rules,
        by_the_pibt_rules,
    ],
    ids=["agents", "reused", "pibt", "turns", "team", "batch", "rules", "pibt-rules"],
)


@INTERFACES
@pytest.mark.parametrize(
    "right", [3, Action.RIGHT, np.int8(3), np.uint64(3), np.array(3), TensorScalar(3, "torch.int64")]
)
def test_integers_of_any_kind_are_actions(play: Play, right: Any) -> None:
    assert play(right, 2) == [[1, 1], [1, 3]]
    assert play(2, right) == [[2, 0], [0, 3]]


@INTERFACES
@pytest.mark.parametrize(
    "truth", [True, False, np.True_, np.array(True), TensorScalar(1, "torch.bool")], ids=lambda value: repr(value)[:12]
)
def test_a_truth_value_is_not_an_action(play: Play, truth: Any) -> None:
    for first, second in ((truth, 4), (4, truth), (truth, truth)):
        with pytest.raises(TypeError):
            play(first, second)


@INTERFACES
@pytest.mark.parametrize("other", [1.0, np.float32(1), None, "1", b"1", 1j], ids=repr)
def test_only_integers_are_actions(play: Play, other: Any) -> None:
    for first, second in ((other, 4), (4, other), (other, other)):
        with pytest.raises(TypeError):
            play(first, second)


@INTERFACES
@pytest.mark.parametrize(
    "beyond", [-1, 5, 2**31, -(2**63), 2**63, 2**64 - 1, 2**70, np.uint64(2**64 - 1), np.int8(-1)], ids=repr
)
def test_other_integers_are_out_of_range(play: Play, beyond: Any) -> None:
    for first, second in ((beyond, 4), (4, beyond), (beyond, beyond)):
        with pytest.raises(ValueError, match=r"none of 0\.\.4"):
            play(first, second)


def test_arrays_of_truth_values_are_not_joint_actions() -> None:
    for joint in (np.ones((2, 2), bool), [[True, False]] * 2, np.ones((2, 2), bool).tolist()):
        with pytest.raises(TypeError, match="got dtype bool"):
            batch().step(joint)
    with pytest.raises(TypeError, match="actions must be numbers, got True or False among them"):
        batch().step([[True, 4], [4, 4]])


def test_truth_values_are_not_preferences() -> None:
    alone: dict[str, Any] = {"shield": "pibt", "preferences": True}
    env = parallel_env(**SIZE, **alone)
    env.reset(options={"instance": INSTANCE})
    for values in ([True, 0.5, 0, 0, 0], [True] * 5, np.ones(5, bool)):
        with pytest.raises(TypeError, match="must be numbers"):
            env.step({"agent_0": [0.0] * 5, "agent_1": values})
        with pytest.raises(TypeError, match="must be numbers"):
            batch(shield="pibt").step([[values, [0.0] * 5]] * 2)


def test_truth_values_are_not_cells() -> None:
    grid = np.zeros((2, 2), bool)
    for cells in ([(True, 0)], [(True, False)], np.ones((1, 2), bool)):
        with pytest.raises(TypeError, match="starts must be"):
            Instance(grid, cells, [(0, 0)])
        with pytest.raises(TypeError, match="goals must be"):
            Instance(grid, [(0, 0)], cells)
    with pytest.raises(ValueError, match=r"the start \(2147483647, 0\) of agent 0 lies outside"):
        Instance(grid, [(2**70, 0)], [(0, 0)])


def batch(**settings: Any) -> BatchedEnv:
    env = BatchedEnv(2, **SIZE, **settings)
    env.reset(seed=0, instances=[INSTANCE, INSTANCE])
    return env
