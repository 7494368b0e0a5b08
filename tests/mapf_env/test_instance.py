"""Instances: invalid ones cannot be constructed."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import oracles
import strategies
from mapf_env import Instance, _native, distances

OPEN = np.zeros((3, 3), bool)


@given(strategies.instances())
def test_well_formed_problems_are_kept_as_given(instance: Instance) -> None:
    again = Instance(instance.grid.astype(int).tolist(), instance.starts.tolist(), instance.goals.tolist())
    assert again == instance
    assert hash(again) == hash(instance)
    assert again.num_agents == len(instance.starts)
    assert again.grid.dtype == bool
    assert again.starts.dtype == again.goals.dtype == np.int32


@given(strategies.crowds(), st.data())
def test_it_is_built_exactly_if_every_goal_can_be_reached(
    crowd: tuple[oracles.Grid, list[oracles.Cell]], data: st.DataObject
) -> None:
    grid, starts = crowd
    goals = data.draw(st.permutations(sorted(oracles.free_cells(grid))))[: len(starts)]
    cut_off = [i for i in range(len(starts)) if goals[i] not in oracles.distances(grid, starts[i])]
    if cut_off:
        with pytest.raises(ValueError, match=rf"agent {cut_off[0]} cannot reach its goal"):
            Instance(grid, starts, goals)
    else:
        assert Instance(grid, starts, goals).num_agents == len(starts)


@given(strategies.instances())
def test_copies_by_pickle_and_deepcopy_are_equal(instance: Instance) -> None:
    assert pickle.loads(pickle.dumps(instance)) == instance
    assert copy.deepcopy(instance) == instance


@given(strategies.instances(min_agents=2), st.data())
def test_at_moves_the_starts_only(instance: Instance, data: st.DataObject) -> None:
    region = sorted(oracles.distances(instance.grid, tuple(instance.starts[0].tolist())))
    positions = data.draw(st.permutations(region))[: instance.num_agents]
    there = instance.at(positions)
    assert there == Instance(instance.grid, positions, instance.goals)
    assert there.at(instance.starts) == instance


def test_arrays_are_private_read_only_copies() -> None:
    grid, starts = OPEN.copy(), np.array([[0, 0]])
    instance = Instance(grid, starts, [[2, 2]])
    grid[1, 1], starts[0] = True, (1, 0)
    assert not instance.grid.any()
    assert instance.starts.tolist() == [[0, 0]]
    for array in (instance.grid, instance.starts, instance.goals, instance.at([[1, 1]]).starts):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_another_problem_is_not_equal() -> None:
    instance = Instance(OPEN, [[0, 0]], [[2, 2]])
    assert instance != Instance(OPEN, [[0, 1]], [[2, 2]])
    assert instance != Instance(OPEN, [[0, 0]], [[2, 1]])
    assert instance != Instance(np.zeros((3, 4), bool), [[0, 0]], [[2, 2]])
    assert instance != "an instance"
    assert repr(instance) == "Instance(3x3, 0 obstacles, 1 agents)"


WALL = np.array([[0, 1, 0]], bool)


@pytest.mark.parametrize(
    ("grid", "starts", "goals", "message"),
    [
        (WALL, [[0, 0], [0, 1]], [[0, 0], [0, 2]], r"the start \(0, 1\) of agent 1 lies on an obstacle; choose"),
        (WALL, [[0, 0]], [[0, 1]], r"the goal \(0, 1\) of agent 0 lies on an obstacle; choose"),
        (WALL, [[0, 0]], [[0, 2]], r"agent 0 cannot reach its goal \(0, 2\) from \(0, 0\)"),
        (OPEN, [[0, 0], [0, 3]], [[1, 0], [1, 1]], r"the start \(0, 3\) of agent 1 lies outside the 3x3 map"),
        (OPEN, [[0, 0]], [[-1, 0]], r"the goal \(-1, 0\) of agent 0 lies outside the 3x3 map"),
        (OPEN, [[0, 0]], [[2**40, 0]], r"the goal .* of agent 0 lies outside the 3x3 map"),
        (OPEN, [[1, 1], [0, 0], [1, 1]], [[0, 0], [0, 1], [0, 2]], r"agents 0 and 2 share the start \(1, 1\)"),
        (OPEN, [[0, 0], [0, 1]], [[2, 2], [2, 2]], r"agents 0 and 1 share the goal \(2, 2\)"),
        (OPEN, [[0, 0], [0, 1]], [[2, 2]], "2 starts but 1 goals"),
        (OPEN, [0, 0], [[2, 2]], r"starts must have shape \(N, 2\)"),
        (OPEN, [[0, 0]], [[2, 2, 2]], r"goals must have shape \(N, 2\)"),
        (OPEN, [], [], r"starts must have shape \(N, 2\)"),
        (np.zeros(4, bool), [[0, 0]], [[0, 1]], r"grid must have shape \(H, W\)"),
        (np.zeros((0, 4), bool), [[0, 0]], [[0, 1]], r"grid must have shape \(H, W\) with at least one cell"),
        (np.full((2, 2), 2), [[0, 0]], [[0, 1]], r"grid must hold 0 \(free\) and 1 \(obstacle\) only"),
    ],
)
def test_ill_formed_problems_are_refused(grid: object, starts: object, goals: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Instance(grid, starts, goals)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("grid", "starts", "message"),
    [
        (OPEN, [[0.0, 0.0]], "starts must be integers, got dtype float64"),
        (np.zeros((3, 3)), [[0, 0]], r"grid must be bool \(True is an obstacle\) or integers 0 and 1"),
    ],
)
def test_wrong_dtypes_are_refused(grid: object, starts: object, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        Instance(grid, starts, [[2, 2]])  # pyright: ignore[reportArgumentType]


@given(strategies.instances())
def test_unreachable_positions_are_refused_by_at_as_well(instance: Instance) -> None:
    with pytest.raises(ValueError, match=r"the start .* of agent 0 lies outside"):
        instance.at(np.full_like(instance.starts, -1))


@given(strategies.grids())
def test_native_distances_and_regions_agree_with_search_in_python(grid: oracles.Grid) -> None:
    free = sorted(oracles.free_cells(grid))
    tables = distances(grid, np.array(free, np.int32))
    labels = _native.regions(grid)
    assert (labels == -1).tolist() == grid.tolist()
    assert labels.max() + 1 == len(oracles.regions(grid))
    for cell, table in zip(free, tables, strict=True):
        steps = oracles.distances(grid, cell)
        expected = [[steps.get((r, c), -1) for c in range(grid.shape[1])] for r in range(grid.shape[0])]
        assert table.tolist() == expected
        assert ((table >= 0) == (labels == labels[cell])).all()


@pytest.mark.parametrize(
    "shape", [(1, 168), (168, 1), (2, 126), (20, 20), (6, 62), (1, 424), (424, 1), (4, 200), (34, 34), (64, 40)]
)
@pytest.mark.parametrize("density", [0.0, 0.1, 0.4])
def test_native_distances_on_maps_of_all_widths(shape: tuple[int, int], density: float) -> None:
    # Maps up to 512 and up to 1,280 cells with their border are searched by words of 64 cells, larger ones by a queue.
    random = np.random.default_rng(0)
    grid = random.random(shape) < density
    grid[0, 0] = False
    free = np.argwhere(~grid).astype(np.int32)
    cells = random.permutation(free)[:3]
    for cell, table in zip(cells, distances(grid, cells), strict=True):
        steps = oracles.distances(grid, (int(cell[0]), int(cell[1])))
        expected = np.full(shape, -1)
        for (row, col), distance in steps.items():
            expected[row, col] = distance
        np.testing.assert_array_equal(table, expected)
