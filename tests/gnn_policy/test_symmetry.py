"""A symmetry commutes with everything: with moving, with perceiving and with the map itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnn_policy import symmetry
from mapf_env import HISTORY, MapSet, Senses, States, perceive

few = settings(max_examples=40)

STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]
ALL = Senses(
    fov_radius=2,
    extra_channels=("cost_to_go", "other_goals", "previous_positions", "greedy_cells", "robots_on_goals"),
    robot_features=("greedy_moves", "last_moves", "on_goal", "steps_left", "steps_to_go", "under_way", "stuck"),
    edge_features=("relative_position", "goal_direction", "greedy_moves", "last_moves", "on_goal", "priority"),
    memory=3,
)


def turned_by_numpy(array, g):
    """The last two axes under symmetry g: a reflection of the columns for g >= 4, then g % 4 quarter turns."""
    return np.rot90(np.flip(array, -1) if g >= 4 else array, g % 4, axes=(-2, -1))


def cell_by_numpy(cell, g, shape):
    """The place of a marked cell after the symmetry."""
    marked = np.zeros(shape, bool)
    marked[tuple(cell)] = True
    return tuple(int(each) for each in np.argwhere(turned_by_numpy(marked, g))[0])


def step_by_numpy(step, g):
    """A difference of (row, col) after the symmetry."""
    row, col = cell_by_numpy((10 + step[0], 10 + step[1]), g, (21, 21))
    return row - 10, col - 10


def action_by_numpy(action, g):
    return STEPS.index(step_by_numpy(STEPS[action], g))


@st.composite
def teams(draw):
    """A map (rectangular or square) and the state of N robots, who have a history."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(st.sampled_from([(6, 6), (3, 9), (8, 5), (1, 6), (12, 12)]))
    robots = draw(st.integers(1, 5))
    cells = generator.permutation(np.argwhere(np.ones(shape, bool)))
    grid = generator.random(shape) < 0.2
    grid[tuple(cells[:robots].T)] = False
    goals = generator.permutation(np.argwhere(~grid))[:robots]
    ages = generator.integers(0, HISTORY + 1, (robots, 1))
    moves = np.where(np.arange(HISTORY) < ages, generator.integers(5, size=(robots, HISTORY)), -1)
    state = States(
        maps=np.zeros(1, np.int32),
        offsets=np.array([0, robots]),
        positions=cells[:robots].astype(np.int32),
        goals=goals.astype(np.int32),
        moves=moves.astype(np.int8),
        under_way=generator.integers(0, 30, robots).astype(np.int32),
        seeds=generator.integers(2**63, size=1, dtype=np.uint64),
        times=np.array([4], np.int32),
        limits=np.array([9], np.int32),
        comm_radius=np.array([3.5]),
    )
    return grid, state


def turned_state(state, g, shape):
    positions, goals = (
        symmetry.turn_cells(cells, np.array(g), np.array(shape)) for cells in (state.positions, state.goals)
    )
    rest = {
        name: getattr(state, name)
        for name in ("maps", "offsets", "under_way", "seeds", "times", "limits", "comm_radius")
    }
    return States(positions=positions, goals=goals, moves=symmetry.turn_actions(state.moves, np.array(g)), **rest)


@pytest.mark.parametrize("shape", [(5, 5), (4, 7), (7, 4), (1, 3), (1, 1)])
def test_every_map_has_eight_symmetries(shape):
    grid = np.arange(shape[0] * shape[1]).reshape(shape)
    patterns = set()
    for g in range(8):
        turned = symmetry.turn_map(grid, g)
        assert np.array_equal(turned, turned_by_numpy(grid, g))
        patterns.add((turned.shape, turned.tobytes()))
    assert len(patterns) == {(1, 1): 1, (1, 3): 4}.get(shape, 8)


@few
@given(team=teams())
def test_maps_and_cells_turn_alike(team):
    grid, state = team
    for g in range(8):
        assert np.array_equal(symmetry.turn_map(grid, g), turned_by_numpy(grid, g))
        cells = symmetry.turn_cells(state.positions, np.array(g), np.array(grid.shape))
        assert [tuple(cell) for cell in cells.tolist()] == [cell_by_numpy(c, g, grid.shape) for c in state.positions]


@few
@given(team=teams())
def test_a_turned_world_is_perceived_as_the_turned_perception(team):
    """Views turn, directions turn with them, and everything else stays."""
    grid, state = team
    straight = perceive(state, MapSet([grid], 2, "float32"), ALL)
    for g in range(8):
        world = MapSet([symmetry.turn_map(grid, g)], 2, "float32")
        turned = perceive(turned_state(state, g, grid.shape), world, ALL)
        np.testing.assert_allclose(turned.fov, turned_by_numpy(straight.fov, g), atol=1e-6)
        assert np.array_equal(turned.edge_index, straight.edge_index)
        assert np.array_equal(turned.edge_weight, straight.edge_weight)
        becomes = [action_by_numpy(action, g) for action in range(5)]
        blocks = [slice(5 * k, 5 * k + 5) for k in range(4)]  # greedy moves, then the last three moves
        for block in blocks:
            assert np.array_equal(turned.scalars[:, block][:, becomes], straight.scalars[:, block])
            shifted = slice(block.start + 4, block.stop + 4)  # of edges they come after two directions
            assert np.array_equal(turned.edge_attr[:, shifted][:, becomes], straight.edge_attr[:, shifted])
        assert np.array_equal(turned.scalars[:, 20:], straight.scalars[:, 20:])
        assert np.array_equal(turned.edge_attr[:, 24:], straight.edge_attr[:, 24:])
        axes = np.array([step_by_numpy((1, 0), g), step_by_numpy((0, 1), g)])
        for part in (slice(0, 2), slice(2, 4)):
            np.testing.assert_allclose(turned.edge_attr[:, part], straight.edge_attr[:, part] @ axes, atol=1e-6)


@few
@given(team=teams())
def test_robots_that_come_back_do_so_after_any_symmetry(team):
    grid, state = team
    for g in range(8):
        assert np.array_equal(turned_state(state, g, grid.shape).stuck(), state.stuck())


@pytest.mark.parametrize("shape", [(6, 6), (4, 7)])
def test_moving_then_turning_equals_turning_then_moving(shape):
    for g in range(8):
        for action, (down, right) in enumerate(STEPS):
            here = (2, 3)
            moved_then_turned = cell_by_numpy((here[0] + down, here[1] + right), g, shape)
            turned = cell_by_numpy(here, g, shape)
            other = STEPS[symmetry.turn_actions(np.array(action), np.array(g))]
            assert moved_then_turned == (turned[0] + other[0], turned[1] + other[1])


def test_each_state_has_its_own_symmetry_and_shape():
    cells = np.tile(np.array([[[0, 1], [2, 3]]]), (16, 1, 1))
    shapes = np.repeat([[5, 5], [4, 6]], 8, axis=0)
    turned = symmetry.turn_cells(cells, np.arange(16)[:, None] % 8, shapes[:, None])
    for row in range(16):
        expected = [cell_by_numpy(cell, row % 8, shapes[row]) for cell in ((0, 1), (2, 3))]
        assert [tuple(cell) for cell in turned[row].tolist()] == expected
    moves = symmetry.turn_actions(np.tile([0, 1, 4, -1], (8, 1)), np.arange(8)[:, None])
    for g in range(8):
        assert moves[g].tolist() == [action_by_numpy(0, g), action_by_numpy(1, g), 4, -1], "no move stays no move"
