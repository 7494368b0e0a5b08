import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import experts
import plan_oracles
import strategies
from experts import FoundBy, PlanLabels
from mapf_env import Action, Instance, Maze, random_instance

SWAP = Instance(np.zeros((1, 4), bool), [(0, 0), (0, 3)], [(0, 3), (0, 0)])
STEP = {Action.UP: (-1, 0), Action.LEFT: (0, -1), Action.DOWN: (1, 0), Action.RIGHT: (0, 1), Action.IDLE: (0, 0)}


def states_of(labels: PlanLabels, source: int) -> list[tuple[npt.NDArray[np.int32], npt.NDArray[np.int8]]]:
    """Positions (N, 2) and actions (N,) of the states of one plan."""
    chosen = np.flatnonzero(labels.source == source)
    assert labels.time[chosen].tolist() == list(range(len(chosen)))
    spans = [slice(labels.offsets[state], labels.offsets[state + 1]) for state in chosen]
    return [(labels.positions[span], labels.actions[span]) for span in spans]


def require_labels(instance: Instance, labels: PlanLabels, source: int) -> npt.NDArray[np.int32]:
    """The joint positions (T + 1, N, 2) that the labels lead through, which begin at the starts without a conflict."""
    joint = [instance.starts]
    for positions, actions in states_of(labels, source):
        np.testing.assert_array_equal(positions, joint[-1])
        joint.append(positions + np.array([STEP[Action(action)] for action in actions.tolist()], np.int32))
    paths = np.stack(joint).astype(np.int32)
    found = plan_oracles.faults(instance.grid, instance.starts, instance.goals, paths)
    assert [fault for fault in found if fault != "does not end on the goals"] == []
    return paths


@settings(deadline=None, max_examples=100)
@given(st.lists(strategies.instances(max_side=6, max_agents=8), max_size=4), st.integers(0, 2**64 - 1))
def test_labels_are_plans_of_teams_of_any_sizes(instances: list[Instance], seed: int) -> None:
    labels = experts.label_plans(instances, steps=1_000, rounds=20, node_limit=500, seed=seed)
    assert labels.offsets[0] == 0
    assert labels.offsets[-1] == len(labels.positions) == len(labels.actions)
    assert len(labels.offsets) == len(labels.source) + 1 == len(labels.time) + 1
    for source, instance in enumerate(instances):
        if not labels.solved[source]:
            assert not (labels.source == source).any()
            assert labels.found_by[source] is None
            continue
        paths = require_labels(instance, labels, source)
        assert plan_oracles.faults(instance.grid, instance.starts, instance.goals, paths) == []
        assert labels.costs[source] == plan_oracles.sum_of_costs(paths)
        assert labels.found_by[source] in (FoundBy.ECBS, FoundBy.LACAM, FoundBy.IMPROVEMENT)


def test_every_crowd_of_a_maze_has_labels_and_more_rounds_make_cheaper_plans() -> None:
    maze = Maze(loops=0.3)
    crowds = [random_instance(height=21, width=21, num_agents=48, style=maze, seed=seed) for seed in range(6)]
    few, many = (experts.label_plans(crowds, steps=8, rounds=rounds) for rounds in (1, 400))
    for labels in (few, many):
        assert labels.solved.all()
        assert labels.source.tolist() == [source for source in range(6) for _ in range(8)]
        for source, crowd in enumerate(crowds):
            require_labels(crowd, labels, source)
    assert many.costs.sum() < 0.8 * few.costs.sum()


def test_labels_do_not_depend_on_threads_or_repetition() -> None:
    instances = [random_instance(num_agents=n, density=0.2, seed=seed) for n in (4, 25, 60) for seed in range(4)]
    once = experts.label_plans(instances, rounds=50)
    for again in (experts.label_plans(instances, rounds=50), experts.label_plans(instances, rounds=50, threads=3)):
        for name in PlanLabels.__slots__:
            np.testing.assert_array_equal(getattr(once, name), getattr(again, name))
    other = experts.label_plans(instances, rounds=50, seed=1)
    assert len(other.actions) != len(once.actions) or (other.actions != once.actions).any()


def test_teams_without_a_plan_or_a_way_to_go_have_no_states() -> None:
    home = Instance(np.zeros((2, 2), bool), [(0, 0)], [(0, 0)])
    labels = experts.label_plans([SWAP, home, random_instance(seed=0)], steps=3)
    assert labels.solved.tolist() == [False, True, True]
    assert labels.source.tolist() == [2, 2, 2]
    assert labels.costs[:2].tolist() == [0, 0]
    empty = experts.label_plans([])
    assert (len(empty.source), empty.offsets.tolist(), empty.positions.shape) == (0, [0], (0, 2))


def test_bad_arguments_are_named() -> None:
    for name in ("steps", "node_limit", "rounds", "threads"):
        with pytest.raises(ValueError, match=name):
            experts.label_plans([SWAP], **{name: 0})  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="w must be"):
        experts.label_plans([SWAP], w=0.9)
    with pytest.raises(TypeError, match=r"instances\[1\] must be a mapf_env.Instance"):
        experts.label_plans([SWAP, 3])  # pyright: ignore[reportArgumentType]
