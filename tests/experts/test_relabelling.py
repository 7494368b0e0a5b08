import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import experts
import strategies
from mapf_env import Action, Instance, random_instance

OPEN = Instance(np.zeros((4, 4), bool), [(0, 0), (3, 3)], [(3, 3), (0, 0)])


def first_actions(instance: Instance, **options: float) -> tuple[list[int], bool]:
    result = experts.solve(instance, **options)  # pyright: ignore[reportArgumentType]
    if result.solution is None or not result.solved or len(result.solution.paths) == 1:
        return [Action.IDLE] * instance.num_agents, result.solved
    return result.solution.actions[0].tolist(), True


@settings(deadline=None, max_examples=60)
@given(strategies.instances(max_side=5, max_agents=3), st.integers(0, 9), st.sampled_from([1.0, 1.2]), st.data())
def test_labels_are_the_first_actions_of_solve(instance: Instance, seed: int, w: float, data: st.DataObject) -> None:
    region = np.argwhere(instance.shared_map.regions == instance.shared_map.regions[tuple(instance.starts[0])])
    orders = data.draw(st.lists(st.permutations(range(len(region))), min_size=1, max_size=4))
    positions = np.array([region[list(order[: instance.num_agents])] for order in orders])
    actions, solved = experts.relabel(instance, positions, w=w, seed=seed, node_limit=500)
    assert actions.dtype == np.int8
    assert actions.shape == (len(orders), instance.num_agents)
    for state, label, done in zip(positions, actions, solved, strict=True):
        expected = first_actions(instance.at(state), w=w, seed=seed, node_limit=500)
        assert (label.tolist(), bool(done)) == expected


def test_states_of_many_instances_on_many_threads() -> None:
    instances = [random_instance(height=10 + seed % 3, num_agents=6, seed=seed) for seed in range(5)]
    batch = [instances[i % 5] for i in range(203)]
    positions = np.array([each.starts for each in batch])
    actions, solved = experts.relabel(batch, positions)
    assert solved.all()
    expected = [first_actions(each)[0] for each in instances]
    assert actions.tolist() == [expected[i % 5] for i in range(203)]
    for threads in (1, 2, 3):
        again, _ = experts.relabel(batch, positions, threads=threads)
        np.testing.assert_array_equal(again, actions)


def test_states_of_different_team_sizes_and_maps_in_one_call() -> None:
    instances = [random_instance(height=10 + n % 3, num_agents=n, seed=n) for n in (3, 9, 1, 6)]
    batch = [instances[i % 4] for i in range(50)]
    positions = np.concatenate([each.starts for each in batch])
    offsets = np.cumsum([0, *[each.num_agents for each in batch]])
    actions, solved = experts.relabel(batch, positions, offsets=offsets, threads=2)
    assert solved.all()
    assert actions.tolist() == [move for each in batch for move in first_actions(each)[0]]


def test_the_expert_brings_every_team_to_its_goals() -> None:
    instance = random_instance(num_agents=10, seed=1)
    solution = experts.solve(instance).solution
    assert solution is not None
    actions, solved = experts.relabel(instance, solution.paths)
    assert solved.all()
    assert (actions[-1] == Action.IDLE).all()


def test_unsolved_states_idle() -> None:
    corridor = Instance(np.zeros((1, 4), bool), [(0, 0), (0, 3)], [(0, 3), (0, 0)])
    actions, solved = experts.relabel(corridor, [corridor.starts, corridor.goals])
    assert solved.tolist() == [False, True]
    assert (actions == Action.IDLE).all()


def test_no_states() -> None:
    actions, solved = experts.relabel(OPEN, np.zeros((0, 2, 2), int))
    assert actions.shape == (0, 2)
    assert solved.shape == (0,)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ([(0, 0), (4, 0)], r"positions\[1, 1\]: agent 1 at \(4, 0\) lies outside the map"),
        ([(-1, 0), (3, 0)], r"agent 0 at \(-1, 0\) lies outside"),
        ([(2**40, 0), (3, 0)], "lies outside"),
        ([(1, 1), (1, 1)], r"positions\[1, 1\]: agent 1 at \(1, 1\) shares its cell"),
        ([(0, 2), (1, 1)], r"agent 0 at \(0, 2\) lies on an obstacle"),
        ([(0, 3), (1, 1)], r"agent 0 at \(0, 3\) cannot reach its goal"),
    ],
)
def test_bad_states_are_named(state: list[tuple[int, int]], message: str) -> None:
    grid = np.zeros((4, 4), bool)
    grid[:, 2] = True
    instance = Instance(grid, [(0, 0), (3, 1)], [(3, 0), (0, 1)])
    for threads in (1, 2):
        with pytest.raises(ValueError, match=message):
            experts.relabel(instance, np.array([instance.starts, state]), threads=threads)


def test_bad_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"positions must have shape \(B, N, 2\)"):
        experts.relabel(OPEN, OPEN.starts)
    with pytest.raises(ValueError, match="3 agents, but an instance has 2"):
        experts.relabel(OPEN, np.zeros((1, 3, 2), int))
    with pytest.raises(ValueError, match="2 instances but positions of 1 states"):
        experts.relabel([OPEN, OPEN], OPEN.starts[None])
    with pytest.raises(TypeError, match="positions must be integers"):
        experts.relabel(OPEN, OPEN.starts[None].astype(float))
    with pytest.raises(ValueError, match="state 1 holds 2 agents, but an instance has 3"):
        experts.relabel([OPEN, random_instance(num_agents=3, seed=0)], np.zeros((2, 2, 2), int))
    for offsets in ([0, 1], [1, 2], [0, 0, 2], [0, 2, 1, 2], [0, 3]):
        with pytest.raises(ValueError, match="offsets must rise from 0 to the number of robots, 2"):
            experts.relabel(OPEN, OPEN.starts, offsets=offsets)
    with pytest.raises(ValueError, match="state 0 holds 1 agents, but an instance has 2"):
        experts.relabel(OPEN, OPEN.starts, offsets=[0, 1, 2])
    with pytest.raises(ValueError, match="w must be"):
        experts.relabel(OPEN, OPEN.starts[None], w=0.5)
