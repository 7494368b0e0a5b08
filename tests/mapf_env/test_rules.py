"""The rules of motion and perception, each compared with slow plain Python."""

from itertools import combinations, permutations, product
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

import oracles
import strategies
from mapf_env import communication_graph, rules

Crowd = tuple[oracles.Grid, list[oracles.Cell]]
TIMES = np.zeros(1, np.int64)


def shield(grid: oracles.Grid, teams: npt.ArrayLike, actions: npt.ArrayLike, seed: int = 0) -> npt.NDArray[np.int8]:
    """The shield on B teams (B, N, 2) that share a map."""
    positions = np.asarray(teams, np.int32)
    count = len(positions)
    maps = rules.bordered(np.broadcast_to(grid, (count, *grid.shape)), 1, np.uint8)
    seeds = np.arange(seed, seed + count, dtype=np.uint64)
    return rules.shield(maps, 1, positions, actions, seeds, np.zeros(count, np.int64))


def ring(height: int, width: int) -> list[oracles.Cell]:
    """The outermost cells of a rectangle, clockwise."""
    top = [(0, col) for col in range(width)]
    right = [(row, width - 1) for row in range(1, height)]
    bottom = [(height - 1, col) for col in range(width - 2, -1, -1)]
    left = [(row, 0) for row in range(height - 2, 0, -1)]
    return top + right + bottom + left


def towards(here: oracles.Cell, there: oracles.Cell) -> int:
    """The action that leads from one cell to its neighbour."""
    return next(action for action in oracles.STEP if oracles.moved(here, action) == there)


@given(strategies.crowds(), st.data(), strategies.seeds)
def test_the_shield_only_stops_whom_it_must(crowd: Crowd, data: st.DataObject, seed: int) -> None:
    grid, team = crowd
    wanted = data.draw(strategies.joint_actions(len(team)))
    executed = shield(grid, [team], [wanted], seed)
    assert oracles.shield_faults(grid, team, wanted, executed[0].tolist()) == []
    assert (shield(grid, [team], executed, seed) == executed).all(), "the shield is idempotent"
    assert (shield(grid, [team], executed, seed + 1) == executed).all(), "whatever the draw"


@pytest.mark.parametrize(
    ("height", "width", "num_agents", "blocked"),
    [(1, 3, 2, []), (1, 4, 3, []), (2, 2, 2, []), (2, 2, 3, []), (2, 2, 4, []), (2, 3, 4, []), (3, 3, 3, [(1, 1)])],
)
def test_every_joint_action_of_a_small_team(
    height: int, width: int, num_agents: int, blocked: list[oracles.Cell]
) -> None:
    grid = np.zeros((height, width), bool)
    for cell in blocked:
        grid[cell] = True
    teams = list(combinations(sorted(oracles.free_cells(grid)), num_agents))
    trials = list(product(teams, product(range(5), repeat=num_agents)))
    if len(trials) > 8000:
        trials = trials[:: len(trials) // 8000]
    executed = shield(grid, [team for team, _ in trials], [wanted for _, wanted in trials]).tolist()
    for (team, wanted), done in zip(trials, executed, strict=True):
        assert oracles.shield_faults(grid, team, wanted, done) == []


@given(strategies.crowds(), st.data())
def test_harmless_joint_actions_pass_unchanged(crowd: Crowd, data: st.DataObject) -> None:
    grid, team = crowd
    wanted = oracles.harmless(grid, team, data.draw(strategies.joint_actions(len(team))))
    assert shield(grid, [team], [wanted])[0].tolist() == wanted


@pytest.mark.parametrize("turn", [1, -1])
@pytest.mark.parametrize(("height", "width"), [(2, 2), (2, 3), (3, 3), (4, 5), (6, 2)])
def test_rotations_pass_unchanged_in_any_order_of_robots(height: int, width: int, turn: int) -> None:
    cells = ring(height, width)
    wanted = [towards(cell, cells[(i + turn) % len(cells)]) for i, cell in enumerate(cells)]
    generator = np.random.default_rng(0)
    for order in (generator.permutation(len(cells)) for _ in range(20)):
        team, actions = [cells[i] for i in order], [wanted[i] for i in order]
        assert shield(np.zeros((height, width), bool), [team], [actions])[0].tolist() == actions


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_a_chain_follows_its_head_or_stops_with_it(order: tuple[int, ...]) -> None:
    grid = np.zeros((1, 6), bool)
    team = [(0, col) for col in order]
    right = [oracles.RIGHT] * 4
    assert shield(grid, [team], [right])[0].tolist() == right
    grid[0, 4] = True
    assert shield(grid, [team], [right])[0].tolist() == [oracles.IDLE] * 4
    halted = [oracles.IDLE if col == 1 else oracles.RIGHT for col in order]
    expected = [oracles.IDLE if col <= 1 else oracles.RIGHT for col in order]
    assert shield(np.zeros((1, 6), bool), [team], [halted])[0].tolist() == expected


def test_a_broken_rotation_stops_as_a_whole() -> None:
    cells = ring(2, 2)
    wanted = [towards(cell, cells[(i + 1) % 4]) for i, cell in enumerate(cells)]
    for stopped in range(4):
        actions = [oracles.IDLE if i == stopped else action for i, action in enumerate(wanted)]
        assert shield(np.zeros((2, 2), bool), [cells], [actions])[0].tolist() == [oracles.IDLE] * 4


def test_of_several_robots_that_enter_a_free_cell_each_goes_equally_often() -> None:
    grid, team = np.zeros((3, 3), bool), [(0, 1), (1, 0), (2, 1), (1, 2)]
    wanted = [oracles.DOWN, oracles.RIGHT, oracles.UP, oracles.LEFT]
    executed = shield(grid, [team] * 4000, [wanted] * 4000)
    goes = executed != oracles.IDLE
    assert (goes.sum(axis=1) == 1).all()
    assert (np.abs(goes.sum(axis=0) - 1000) < 140).all()  # five standard deviations of 27


def test_the_winner_of_a_tie_changes_with_time() -> None:
    maps = rules.bordered(np.zeros((64, 1, 3), bool), 1)
    positions = np.tile(np.array([[0, 0], [0, 2]], np.int32), (64, 1, 1))
    wanted = [[oracles.RIGHT, oracles.LEFT]] * 64
    executed = rules.shield(maps, 1, positions, wanted, np.full(64, 7, np.uint64), np.arange(64))
    assert 10 < (executed[:, 0] == oracles.RIGHT).sum() < 54
    again = rules.shield(maps, 1, positions, wanted, np.full(64, 7, np.uint64), np.arange(64))
    assert (again == executed).all()


@given(strategies.crowds())
def test_masks_forbid_exactly_moves_off_the_map_and_into_obstacles(crowd: Crowd) -> None:
    grid, team = crowd
    free = oracles.free_cells(grid)
    maps = rules.bordered(grid[None], 2)
    mask = rules.action_mask(maps, 2, np.array([team], np.int32))[0]
    assert mask.tolist() == [[int(oracles.moved(cell, action) in free) for action in range(5)] for cell in team]


@given(strategies.crowds(), st.data())
def test_moves_lead_where_they_say(crowd: Crowd, data: st.DataObject) -> None:
    team = crowd[1]
    actions = data.draw(strategies.joint_actions(len(team)))
    after = rules.move(np.array([team], np.int32), np.array([actions], np.int8))[0]
    assert oracles.cells(after) == [oracles.moved(cell, action) for cell, action in zip(team, actions, strict=True)]


@given(strategies.crowds(max_side=9), st.data(), st.integers(1, 6), st.sampled_from([np.float32, np.uint8]))
def test_views_are_the_papers(crowd: Crowd, data: st.DataObject, radius: int, dtype: type[Any]) -> None:
    grid, team = crowd
    goals = data.draw(st.permutations(sorted(oracles.free_cells(grid))))[: len(team)]
    maps = rules.bordered(grid[None], radius, dtype)
    views = rules.observe(maps, np.array([team], np.int32), np.array([goals], np.int32), radius)
    assert views.dtype == dtype
    assert views.shape == (1, len(team), 3, 2 * radius + 3, 2 * radius + 3)
    for robot in range(len(team)):
        expected = oracles.field_of_view(grid, team, goals, robot, radius)
        assert np.array_equal(views[0, robot], expected), f"robot {robot} of {team}, goals {goals}"


@pytest.mark.parametrize("radius", [1, 2, 4, 5])
def test_every_goal_on_a_large_map_is_projected_as_defined(radius: int) -> None:
    """Halves occur: from (9, 11), a goal 4 to the side and 8 down meets the ring of radius 5 at 2.5 to the side."""
    grid, robot = np.zeros((24, 27), bool), (9, 11)
    goals = [[cell] for cell in sorted(oracles.free_cells(grid))]
    maps = np.broadcast_to(rules.bordered(grid[None], radius), (len(goals), 24 + 2 * radius, 27 + 2 * radius))
    team = np.tile(np.array([[robot]], np.int32), (len(goals), 1, 1))
    views = rules.observe(np.ascontiguousarray(maps), team, np.array(goals, np.int32), radius)
    for goal, view in zip(goals, views[:, 0, 1], strict=True):
        assert np.array_equal(view, oracles.field_of_view(grid, [robot], goal, 0, radius)[1]), f"goal {goal}"
        assert view.sum() == 1


def test_a_wider_border_than_needed_changes_nothing() -> None:
    grid = np.array([[0, 1, 0], [0, 0, 0]], bool)[None]
    team, goals = np.array([[[0, 0], [1, 2]]], np.int32), np.array([[[0, 2], [0, 0]]], np.int32)
    narrow = rules.observe(rules.bordered(grid, 2), team, goals, 2)
    wide = np.empty_like(narrow)
    rules._native.observe(rules.bordered(grid, 5), 5, team, goals, 2, wide)
    assert (narrow == wide).all()


RADII = st.one_of(
    st.floats(0, 12),
    st.integers(0, 12).map(float),
    st.integers(1, 60).map(lambda square: square**0.5),
    st.sampled_from([float("inf"), 1e200, 5e-324]),
)


@given(strategies.crowds(max_side=8), RADII)
def test_robots_hear_each_other_strictly_within_the_radius(crowd: Crowd, radius: float) -> None:
    team = crowd[1]
    graph = communication_graph(np.array(team), radius)
    assert graph.dtype == np.float32
    assert np.array_equal(graph, oracles.communication_graph(team, radius))
    assert np.array_equal(rules.communication_graph(np.array([team, team], np.int32), radius)[1], graph)


def test_the_graph_takes_lists_and_names_wrong_arguments() -> None:
    assert communication_graph([[0, 0], [0, 3]], 5.0).tolist() == [[0, 1], [1, 0]]
    with pytest.raises(ValueError, match="the communication radius must not be negative, got nan"):
        communication_graph([[0, 0]], float("nan"))
    with pytest.raises(TypeError, match="positions must be integers, got dtype float64"):
        communication_graph([[0.5, 0.5]], 5.0)
    with pytest.raises(ValueError, match=r"positions must have shape"):
        communication_graph([0, 0], 5.0)


def test_results_can_be_written_into_the_callers_buffers() -> None:
    grid, team = np.zeros((1, 2, 3), bool), np.array([[[0, 0], [1, 1]]], np.int32)
    fov, graph = np.full((1, 2, 3, 5, 5), 9, np.uint8), np.full((1, 2, 2), 9, np.float32)
    maps = rules.bordered(grid, 1, np.uint8)
    assert rules.observe(maps, team, team, 1, out=fov) is fov
    assert rules.communication_graph(team, 5.0, out=graph) is graph
    assert (fov == rules.observe(maps, team, team, 1)).all()
    assert graph.tolist() == [[[0, 1], [1, 0]]]


def test_wrong_arguments_are_refused() -> None:
    maps = rules.bordered(np.zeros((1, 2, 3), bool), 1)
    team, seeds = np.array([[[0, 0], [1, 1]]], np.int32), np.zeros(1, np.uint64)
    outside = np.array([[[0, 0], [1, 3]]], np.int32)
    for call in (
        lambda: rules.observe(maps, outside, team, 1),
        lambda: rules.shield(maps, 1, outside, [[4, 4]], seeds, TIMES),
        lambda: rules.action_mask(maps, 1, outside),
    ):
        with pytest.raises(ValueError, match=r"positions of agent 1 in environment 0, \(1, 3\), lies outside the map"):
            call()
    with pytest.raises(ValueError, match=r"goals of agent 1 in environment 0, \(1, 3\), lies outside the map"):
        rules.observe(maps, team, outside, 1)
    with pytest.raises(ValueError, match=r"action 5 of agent 1 in environment 0 is none of 0\.\.4"):
        rules.shield(maps, 1, team, [[4, 5]], seeds, TIMES)
    with pytest.raises(ValueError, match=r"action -1 of agent 0 in environment 0 is none of 0\.\.4"):
        rules.shield(maps, 1, team, [[-1, 4]], seeds, TIMES)
    with pytest.raises(ValueError, match=r"actions must have shape \(1, 2\), got \(1, 3\)"):
        rules.shield(maps, 1, team, [[4, 4, 4]], seeds, TIMES)
    for actions in ([[0.0, 1.0]], [[True, False]], [["up", "up"]], [[None, 0]]):
        with pytest.raises(TypeError, match=r"actions must be integers 0\.\.4"):
            rules.shield(maps, 1, team, actions, seeds, TIMES)
    with pytest.raises(ValueError, match="one seed and time for each environment"):
        rules.shield(maps, 1, team, [[4, 4]], np.zeros(2, np.uint64), TIMES)
    with pytest.raises(ValueError, match="border of at least the field of view's radius"):
        rules._native.observe(maps, 1, team, team, 2, np.empty((1, 2, 3, 7, 7), np.float32))
    with pytest.raises(ValueError, match="out must have shape"):
        rules.observe(maps, team, team, 1, out=np.empty((1, 2, 3, 7, 7), np.float32))
    with pytest.raises(ValueError, match="out must have shape"):
        rules.communication_graph(team, 1.0, out=np.empty((1, 2, 3), np.float32))
    with pytest.raises(ValueError, match=r"action 258 of agent 1 in environment 0 is none of 0\.\.4"):
        rules.move(team, [[0, 258]])
    with pytest.raises(TypeError, match="actions must be integers"):
        rules.move(team, [[0, 2.9]])
    with pytest.raises(TypeError, match="positions must be integers, got dtype float64"):
        rules.observe(maps, team + 0.5, team, 1)
    with pytest.raises(ValueError, match="lies outside the map"):
        rules.observe(maps, team.astype(np.int64) + 2**32, team, 1)
    with pytest.raises(ValueError, match="must have a border of obstacles"):
        rules.distance_tables(np.zeros((1, 4, 5), np.float32), 1, team)
    with pytest.raises(ValueError, match="positions must have shape"):
        rules.move(team, np.zeros((1, 3), np.int8))
    with pytest.raises(ValueError, match="border must be at least 1"):
        rules.bordered(np.zeros((1, 2, 3), bool), 0)
    with pytest.raises(ValueError, match="views are float32 or uint8, got float64"):
        rules.bordered(np.zeros((1, 2, 3), bool), 1, np.float64)
    with pytest.raises(TypeError):
        rules.observe(maps, team, team, 1, out=np.empty((1, 2, 3, 5, 5), np.float64))
