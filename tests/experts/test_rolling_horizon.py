import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import experts
import oracles
import plan_oracles
import strategies
from mapf_env import BatchedEnv, Instance, Maze, random_instance

CORRIDOR = np.array([[0] * 9, [1, 0, *[1] * 7]], bool)


def played(
    planner: experts.RollingHorizon, instance: Instance, steps: int, seed: int
) -> tuple[int, npt.NDArray[np.int32]]:
    """Goals reached, and the joint positions (T + 1, N, 2); a robot that arrives gets a goal at random."""
    generator, positions, goals = np.random.default_rng(seed), instance.starts, instance.goals.copy()
    region = sorted(next(r for r in oracles.regions(instance.grid) if oracles.cells(positions)[0] in r))
    joint, reached = [positions], 0
    for _ in range(steps):
        actions = planner.act(positions, goals)
        positions = np.array(
            [oracles.moved(cell, a) for cell, a in zip(oracles.cells(positions), actions.tolist(), strict=True)],
            np.int32,
        )
        joint.append(positions)
        for robot in np.flatnonzero((positions == goals).all(-1)):
            reached += 1
            goals[robot] = region[generator.integers(len(region))]
    return reached, np.stack(joint)


@settings(deadline=None, max_examples=100)
@given(
    strategies.instances(max_side=6, max_agents=10),
    st.integers(1, 8),
    st.integers(1, 8),
    st.integers(1, 30),
    st.integers(0, 2**64 - 1),
)
def test_moves_never_conflict(instance: Instance, window: int, execute: int, rounds: int, seed: int) -> None:
    planner = experts.RollingHorizon(
        instance.grid, window=window, execute=min(window, execute), rounds=rounds, seed=seed
    )
    _, joint = played(planner, instance, 12, seed % 1000)
    found = plan_oracles.faults(instance.grid, instance.starts, instance.goals, joint)
    assert [fault for fault in found if fault != "does not end on the goals"] == []


def test_equal_calls_give_equal_moves() -> None:
    instance = random_instance(num_agents=30, density=0.2, seed=0)
    one, same, other = (
        played(experts.RollingHorizon(instance.grid, seed=seed), instance, 20, 0)[1] for seed in (3, 3, 4)
    )
    assert (one == same).all()
    assert (one != other).any()


def test_robots_change_places_in_a_corridor() -> None:
    facing = Instance(CORRIDOR, [(0, 3), (0, 8)], [(0, 8), (0, 3)])
    planner = experts.RollingHorizon(CORRIDOR, window=16)
    positions, met = facing.starts, set[int]()
    for _ in range(60):
        actions = planner.act(positions, facing.goals).tolist()
        moved = [oracles.moved(cell, a) for cell, a in zip(oracles.cells(positions), actions, strict=True)]
        positions = np.array(moved, np.int32)
        met |= set(np.flatnonzero((positions == facing.goals).all(-1)).tolist())
    assert met == {0, 1}


def test_more_rounds_bring_more_goals() -> None:
    reached = {1: 0, 200: 0}
    for seed in range(3):
        crowd = random_instance(height=21, width=21, num_agents=48, style=Maze(loops=0.3), seed=seed)
        for rounds in reached:
            reached[rounds] += played(experts.RollingHorizon(crowd.grid, rounds=rounds), crowd, 100, seed)[0]
    assert reached[200] > 1.2 * reached[1]


def test_a_lifelong_environment_executes_the_moves_as_they_are() -> None:
    env = BatchedEnv(1, num_agents=30, density=0.2, task="lifelong", max_cycles=50)
    env.reset(0)
    planner = experts.RollingHorizon(env.grids[0], rounds=50)
    for _ in range(50):
        step = env.step(planner.act(env.positions[0], env.goals[0])[None])
        assert not step.replaced.any()


def test_bad_arguments_are_named() -> None:
    for name in ("window", "execute", "rounds"):
        with pytest.raises(ValueError, match=name):
            experts.RollingHorizon(CORRIDOR, **{name: 0})
    with pytest.raises(ValueError, match=r"execute must be an integer in 1\.\.4"):
        experts.RollingHorizon(CORRIDOR, window=4, execute=5)
    planner = experts.RollingHorizon(np.array([[0, 0, 1, 0]], bool))
    for positions, goals, message in (
        ([(0, 0)], [(0, 3)], r"positions\[0\]: agent 0 at \(0, 0\) cannot reach its goal"),
        ([(0, 2)], [(0, 3)], r"positions\[0\]: agent 0 at \(0, 2\) lies on an obstacle"),
        ([(0, 1)], [(0, 4)], r"goals\[0\]: agent 0 at \(0, 4\) lies outside the map"),
        ([(0, 1), (0, 1)], [(0, 1), (0, 0)], r"positions\[1\]: agent 1 at \(0, 1\) shares its cell"),
        ([(0, 1), (0, 0)], [(0, 1)], "2 positions, 1 goals"),
    ):
        with pytest.raises(ValueError, match=message):
            planner.act(positions, goals)


@settings(deadline=None, max_examples=50)
@given(st.lists(strategies.instances(max_side=6, max_agents=8), max_size=4), st.integers(0, 2**64 - 1))
def test_next_moves_are_those_of_a_planner_for_each_state(instances: list[Instance], seed: int) -> None:
    moves = experts.next_moves(instances, window=6, rounds=20, seed=seed)
    expected = [
        experts.RollingHorizon(each.grid, window=6, rounds=20, seed=seed).act(each.starts, each.goals)
        for each in instances
    ]
    assert moves.tolist() == [move for own in expected for move in own.tolist()]
    assert moves.dtype == np.int8
    threaded = experts.next_moves(instances, window=6, rounds=20, seed=seed, threads=3)
    assert threaded.tolist() == moves.tolist()


def test_bad_arguments_of_next_moves_are_named() -> None:
    instance = random_instance(seed=0)
    for name in ("window", "rounds", "threads"):
        with pytest.raises(ValueError, match=name):
            experts.next_moves([instance], **{name: 0})  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"instances\[1\] must be a mapf_env.Instance"):
        experts.next_moves([instance, 3])  # pyright: ignore[reportArgumentType]
