"""A symmetry commutes with everything: with moving, with perceiving and with the map itself."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gnn_policy import symmetry
from mapf_env import rules

few = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])

STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]


def turned_by_numpy(array, g):
    """The last two axes under symmetry g: a reflection of the columns for g >= 4, then g % 4 quarter turns."""
    return np.rot90(np.flip(array, -1) if g >= 4 else array, g % 4, axes=(-2, -1))


def cell_by_numpy(cell, g, shape):
    """Where a marked cell ends up."""
    marked = np.zeros(shape, bool)
    marked[tuple(cell)] = True
    return tuple(int(each) for each in np.argwhere(turned_by_numpy(marked, g))[0])


def kept(shape):
    return [g for g in range(8) if turned_by_numpy(np.zeros(shape), g).shape == shape]


@st.composite
def teams(draw):
    """A map (rectangular or square), positions and goals of N robots."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(st.sampled_from([(6, 6), (3, 9), (8, 5), (1, 6), (12, 12)]))
    grid = generator.random(shape) < 0.2
    cells = np.argwhere(np.ones(shape, bool))
    robots = draw(st.integers(1, 5))
    return grid, generator.permutation(cells)[:robots], generator.permutation(cells)[:robots]


def test_a_square_has_eight_symmetries_and_a_rectangle_four():
    for height, width in ((5, 5), (4, 7), (7, 4)):
        assert symmetry.symmetries(height, width).tolist() == kept((height, width))
        patterns = {
            symmetry.turn_maps(np.arange(height * width).reshape(height, width), g).tobytes()
            for g in kept((height, width))
        }
        assert len(patterns) == (8 if height == width else 4)


@few
@given(team=teams())
def test_maps_and_cells_turn_alike(team):
    grid, positions, _ = team
    height, width = grid.shape
    for g in kept(grid.shape):
        assert np.array_equal(symmetry.turn_maps(grid, g), turned_by_numpy(grid, g))
        cells = symmetry.turn_cells(positions, np.array(g), height, width)
        assert [tuple(cell) for cell in cells.tolist()] == [cell_by_numpy(c, g, grid.shape) for c in positions]


@few
@given(team=teams(), radius=st.integers(1, 4))
def test_a_turned_world_is_observed_as_the_turned_observation(team, radius):
    grid, positions, goals = team
    height, width = grid.shape

    def observed(grid, positions, goals):
        obstacles = rules.bordered(np.ascontiguousarray(grid)[None], radius)
        return rules.observe(obstacles, positions[None].astype(np.int32), goals[None].astype(np.int32), radius)[0]

    straight = observed(grid, positions, goals)
    for g in kept(grid.shape):
        turn = np.array(g)
        turned = observed(
            symmetry.turn_maps(grid, g),
            symmetry.turn_cells(positions, turn, height, width),
            symmetry.turn_cells(goals, turn, height, width),
        )
        assert np.array_equal(turned, turned_by_numpy(straight, g))


@pytest.mark.parametrize("shape", [(6, 6), (4, 7)])
def test_moving_then_turning_equals_turning_then_moving(shape):
    for g in kept(shape):
        for action, (down, right) in enumerate(STEPS):
            here = (2, 3)
            moved_then_turned = cell_by_numpy((here[0] + down, here[1] + right), g, shape)
            turned = cell_by_numpy(here, g, shape)
            other = STEPS[symmetry.ACTIONS[g, action]]
            assert moved_then_turned == (turned[0] + other[0], turned[1] + other[1])


def test_a_symmetry_of_its_own_for_each_state():
    cells = np.tile(np.array([[[0, 1], [2, 3]]]), (8, 1, 1))
    turned = symmetry.turn_cells(cells, np.arange(8)[:, None], 5, 5)
    for g in range(8):
        assert [tuple(cell) for cell in turned[g].tolist()] == [cell_by_numpy(c, g, (5, 5)) for c in ((0, 1), (2, 3))]
