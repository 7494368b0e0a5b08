"""The cost of a solution, and the audit of its faults."""

import pickle
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import oracles
import strategies
from mapf_env import MOVES, Action, Conflict, Instance, Solution


@st.composite
def walks(draw: st.DrawFn) -> tuple[Instance, Solution]:
    """An instance and any walk of its robots, through walls and each other."""
    instance = draw(strategies.instances(max_side=4, max_agents=4))
    team, path = oracles.cells(instance.starts), []
    for _ in range(draw(st.integers(0, 5))):
        path.append(team)
        actions = draw(strategies.joint_actions(len(team)))
        team = [oracles.moved(cell, action) for cell, action in zip(team, actions, strict=True)]
    path.append(team)
    return instance, Solution(np.array(path))


def test_actions_are_the_papers() -> None:
    assert [action.name for action in Action] == ["UP", "LEFT", "DOWN", "RIGHT", "IDLE"]
    assert {int(action): tuple(MOVES[action].tolist()) for action in Action} == oracles.STEP


@given(walks())
def test_actions_walk_the_paths(walk: tuple[Instance, Solution]) -> None:
    paths = walk[1].paths
    assert (paths[:-1] + MOVES[walk[1].actions] == paths[1:]).all()


@given(walks())
def test_costs_count_until_the_last_arrival(walk: tuple[Instance, Solution]) -> None:
    solution = walk[1]
    arrivals = [oracles.arrival(oracles.cells(path)) for path in solution.paths.transpose(1, 0, 2)]
    assert solution.arrival_times.tolist() == arrivals
    assert solution.sum_of_costs == sum(arrivals)
    assert solution.makespan == max(arrivals)


@given(walks())
def test_a_solution_is_valid_exactly_if_no_step_has_a_fault(walk: tuple[Instance, Solution]) -> None:
    instance, solution = walk
    teams = [oracles.cells(team) for team in solution.paths]
    faulty = any(oracles.faults(instance.grid, before, after) for before, after in pairwise(teams))
    missed = [goal for cell, goal in zip(teams[-1], oracles.cells(instance.goals), strict=True) if cell != goal]
    found = solution.violations(instance)
    assert len([violation for violation in found if " ends at " in violation]) == len(missed)
    assert (len(found) > len(missed)) == faulty
    assert [conflict.time for conflict in solution.conflicts()] == sorted(c.time for c in solution.conflicts())


@given(walks())
def test_conflicts_are_those_of_each_pair_and_step(walk: tuple[Instance, Solution]) -> None:
    teams = [oracles.cells(team) for team in walk[1].paths]
    pairs = [(i, j) for i in range(len(teams[0])) for j in range(i + 1, len(teams[0]))]
    vertex = {("vertex", t, p, team[p[0]]) for t, team in enumerate(teams) for p in pairs if team[p[0]] == team[p[1]]}
    swap = {
        ("swap", t, (i, j), teams[t][i])
        for t in range(1, len(teams))
        for i, j in pairs
        if teams[t][i] == teams[t - 1][j] and teams[t][j] == teams[t - 1][i] and teams[t][i] != teams[t][j]
    }
    # Two robots that stay together in one cell do not swap.
    found = {(c.kind, c.time, c.agents, c.cell) for c in walk[1].conflicts()}
    assert found == vertex | swap
    assert len(found) == len(walk[1].conflicts())


def test_waiting_on_a_goal_that_is_left_again_is_paid() -> None:
    there_and_back = Solution(np.array([[[0, 0]], [[0, 1]], [[0, 1]], [[0, 0]], [[0, 1]], [[0, 1]]]))
    assert there_and_back.arrival_times.tolist() == [4]
    assert repr(there_and_back) == "Solution(1 agents, 5 steps, sum of costs 4, makespan 4)"


def test_a_rotation_is_sound_and_a_swap_is_not() -> None:
    square = [(0, 0), (0, 1), (1, 1), (1, 0)]
    turned = square[1:] + square[:1]
    rotation = Solution(np.array([square, turned]))
    assert rotation.violations(Instance(np.zeros((2, 2), bool), square, turned)) == []
    swap = Solution(np.array([[(0, 0), (0, 1)], [(0, 1), (0, 0)]]))
    assert swap.conflicts() == [Conflict("swap", 1, (0, 1), (0, 1))]
    together = Solution(np.zeros((2, 2, 2), int))
    assert together.conflicts() == [Conflict("vertex", time, (0, 1), (0, 0)) for time in (0, 1)]
    assert str(swap.conflicts()[0]) == "swap conflict of agents 0 and 1 at (0, 1), time 1"


def test_violations_name_agent_cell_and_time() -> None:
    instance = Instance(np.array([[0, 0, 1]], bool), [[0, 0]], [[0, 1]])
    path = Solution(np.array([[[0, 1]], [[0, 2]], [[0, 3]], [[0, 0]]]))
    assert path.violations(instance) == [
        "agent 0 starts at (0, 1), not (0, 0)",
        "agent 0 ends at (0, 0), not (0, 1)",
        "agent 0 is at (0, 2) at time 1, which is not a free cell",
        "agent 0 is at (0, 3) at time 2, which is not a free cell",
        "agent 0 jumps in step 2",
    ]
    assert Solution(np.zeros((1, 2, 2), int)).violations(instance) == ["2 paths for 1 agents"]
    with pytest.raises(ValueError, match=r"agent 0 jumps from \(0, 3\) to \(0, 0\) in step 2"):
        _ = path.actions


def test_cells_beyond_32_bits_do_not_come_back_into_the_map() -> None:
    instance = Instance(np.zeros((1, 2), bool), [[0, 0]], [[0, 1]])
    assert Solution(np.array([[[0, 0]], [[2**32, 1]]])).violations(instance)


def test_paths_are_read_only_copies() -> None:
    array = np.zeros((2, 1, 2), int)
    solution = Solution(array)
    array[0] = 7
    assert not solution.paths.any()
    with pytest.raises(ValueError, match="read-only"):
        solution.paths[0] = 1


@pytest.mark.parametrize("shape", [(2, 2), (2, 1, 3), (0, 1, 2), (2, 0, 2)])
def test_paths_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"paths must have shape \(T \+ 1, N, 2\)"):
        Solution(np.zeros(shape, int))


def test_paths_of_another_dtype_are_refused() -> None:
    with pytest.raises(TypeError, match="paths must be integers, got dtype float64"):
        Solution(np.zeros((2, 1, 2)))  # pyright: ignore[reportArgumentType]


def test_conflicts_of_many_robots_need_little_memory() -> None:
    """A thousand robots over 200 steps: pairs of all robots would need 200 MB."""
    columns = np.arange(1000)
    paths = np.zeros((201, 1000, 2), np.int32)
    paths[:, :, 0], paths[:, :, 1] = np.arange(201)[:, None], columns
    assert Solution(paths).conflicts() == []
    paths[100, 999] = paths[100, 0]
    assert [conflict.agents for conflict in Solution(paths).conflicts()] == [(0, 999)]
    tracemalloc.start()
    Solution(paths).conflicts()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6


def test_long_paths_are_audited_in_parts_and_each_fault_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, cells = np.random.default_rng(0), [(0, 0), (0, 1), (1, 0), (1, 1)]
    team = Instance(np.zeros((2, 2), bool), cells, cells)
    for _ in range(200):
        solution = Solution(rng.integers(-1, 3, (rng.integers(1, 9), 4, 2), np.int32))
        whole = solution.violations(team, None), solution.conflicts()
        for size in (1, 4, 9):
            monkeypatch.setattr("mapf_env.solution._CELLS_AT_ONCE", size)
            assert (solution.violations(team, None), solution.conflicts()) == whole
            assert solution.count_violations(team) == len(whole[0])
        monkeypatch.undo()


def test_a_crowd_in_one_cell_is_counted_and_not_listed() -> None:
    """6,000 robots for 20 steps: 378 million violations, which once took 90 s and 5.7 GB."""
    cells = np.argwhere(np.ones((60, 100)))
    instance, crowd = Instance(np.zeros((60, 100), bool), cells, cells), Solution(np.zeros((21, 6000, 2), np.int32))
    tracemalloc.start()
    found, conflicts = crowd.violations(instance), crowd.conflicts(most=3)
    count = crowd.count_violations(instance)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6
    assert count == 2 * 5999 + 21 * 6000 * 5999 // 2
    assert found[0] == "agent 1 starts at (0, 0), not (0, 1)"
    assert (len(found), found[-1]) == (21, f"and {count - 20} more")
    assert [conflict.agents for conflict in conflicts] == [(0, 1), (0, 2), (0, 3)]


def test_many_robots_that_swap_are_counted_too() -> None:
    columns = np.repeat([0, 1], 500)
    cells = np.argwhere(np.ones((10, 100)))
    instance, swap = (
        Instance(np.zeros((10, 100), bool), cells, cells),
        Solution(np.stack([[np.zeros(1000, int)] * 2, [columns, 1 - columns]], axis=-1)),
    )
    kinds = [violation.split()[0] for violation in swap.violations(instance, None)]
    assert kinds.count("swap") == 500 * 500
    assert swap.count_violations(instance) == len(kinds)
    with pytest.raises(ValueError, match="most must be at least 0"):
        swap.violations(instance, most=-1)


def test_a_copy_by_pickle_cannot_be_written_either() -> None:
    solution = Solution(np.zeros((2, 1, 2), np.int32))
    copied = pickle.loads(pickle.dumps(solution))
    assert (copied.paths == solution.paths).all()
    assert not copied.paths.flags.writeable
