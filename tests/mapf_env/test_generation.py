"""Properties of random maps and instances."""

from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import oracles
import strategies
from mapf_env import (
    Instance,
    Maze,
    Rooms,
    Walls,
    Warehouse,
    random_instance,
    random_map,
    random_maps,
    random_starts_and_goals,
)
from mapf_env.generation import MapStyle

Style = Literal["cells", "walls"]
STYLES: tuple[Style, ...] = ("cells", "walls")


@given(strategies.seeds, st.integers(1, 12), st.integers(1, 12), st.floats(0, 0.999))
def test_cells_reach_every_density_exactly_and_stay_connected(
    seed: int, height: int, width: int, density: float
) -> None:
    if round(density * height * width) == height * width:
        with pytest.raises(ValueError, match=r"leave no free cell .*: lower the density"):
            random_map(height=height, width=width, density=density, seed=seed)
        return
    grid = random_map(height=height, width=width, density=density, seed=seed)
    assert grid.shape == (height, width)
    assert grid.sum() == round(density * height * width)
    assert len(oracles.regions(grid)) == 1


@given(strategies.seeds, st.integers(8, 25), st.integers(8, 25), st.sampled_from([0.0, 0.05, 0.1, 0.2]))
def test_walls_reach_usual_densities_exactly_and_lie_on_even_lines(
    seed: int, height: int, width: int, density: float
) -> None:
    grid = random_map(height=height, width=width, density=density, style="walls", seed=seed)
    assert grid.sum() == round(density * height * width)
    assert len(oracles.regions(grid)) == 1
    assert not grid[1::2, 1::2].any()


def test_walls_in_bad_places_are_removed_and_built_again() -> None:
    for seed in range(40):  # a quarter of these maps have no room at the first attempt
        assert random_map(density=0.4, style="walls", seed=seed).sum() == 160


def test_walls_are_longer_than_cells() -> None:
    def touching(style: Style) -> float:
        grids = random_maps(range(200), style=style)
        return float((grids[:, 1:] & grids[:, :-1]).sum() + (grids[:, :, 1:] & grids[:, :, :-1]).sum()) / 200

    assert touching("walls") > 3 * touching("cells")


@pytest.mark.parametrize(
    "settings",
    [
        {"density": 0.99},
        {"density": 0.99, "style": "walls"},
        {"height": 1, "width": 2, "density": 0.5},
        {"height": 1, "width": 2, "density": 0.99},
        {"height": 1, "width": 1},
        {"height": 2, "width": 2, "density": 0.75, "style": "walls"},
        {"height": 64, "width": 64, "density": 0.7, "style": "walls"},
        {"density": 0.1, "num_agents": 361},
        {"num_agents": 10**9},
    ],
)
def test_no_room_ends_with_an_error(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"(lower the density|fewer agents)"):
        random_instance(seed=0, **settings)


def test_crowds_to_the_last_cell_are_placed() -> None:
    for seed in range(50):
        instance = random_instance(height=3, width=3, density=0, num_agents=9, seed=seed)
        assert len(set(oracles.cells(instance.starts))) == len(set(oracles.cells(instance.goals))) == 9
        assert (instance.starts != instance.goals).any(axis=1).all()


@given(strategies.settings(max_agents=40), strategies.seeds)
def test_robots_get_distinct_starts_and_distinct_goals_off_their_starts(settings: dict[str, Any], seed: int) -> None:
    names = ("height", "width", "density", "num_agents", "style")
    instance = random_instance(seed=seed, **{name: settings[name] for name in names})
    starts, goals = oracles.cells(instance.starts), oracles.cells(instance.goals)
    assert len(set(starts)) == len(set(goals)) == instance.num_agents == settings["num_agents"]
    assert not any(start == goal for start, goal in zip(starts, goals, strict=True))
    assert set(starts + goals) <= oracles.regions(instance.grid)[0]


@pytest.mark.parametrize("style", STYLES)
def test_the_map_depends_on_its_own_arguments_only(style: Style) -> None:
    grid = random_map(style=style, seed=3)
    for num_agents in (1, 10, 60):
        assert (random_instance(style=style, num_agents=num_agents, seed=3).grid == grid).all()
    assert (random_maps([9, 3], style=style)[1] == grid).all()
    assert (random_maps([9, 3], style=style)[0] != grid).any()


@pytest.mark.parametrize("style", STYLES)
def test_equal_seeds_give_equal_instances_and_others_differ(style: Style) -> None:
    instances = [random_instance(style=style, seed=seed) for seed in range(50)]
    assert instances == [random_instance(style=style, seed=seed) for seed in range(50)]
    assert len(set(instances)) == 50
    assert random_instance() != random_instance()


def test_styles_differ() -> None:
    assert (random_map(style="cells", seed=1) != random_map(style="walls", seed=1)).any()


def test_placement_is_uniform_over_the_free_cells() -> None:
    grid = np.zeros((4, 4), bool)
    grid[1, 1] = grid[2, 3] = True
    starts, goals = random_starts_and_goals(range(7000), np.broadcast_to(grid, (7000, 4, 4)), 3)
    for robot in range(3):
        for cells in (starts[:, robot], goals[:, robot]):
            count = np.zeros((4, 4), int)
            np.add.at(count, tuple(cells.T), 1)
            assert (count[grid] == 0).all()
            assert count[~grid].min() > 400  # 500 expected, standard deviation 22
            assert count[~grid].max() < 600


@pytest.mark.parametrize("style", STYLES)
def test_robots_starts_are_independent_of_the_map_of_the_same_seed(style: Style) -> None:
    """Robots start next to obstacles as often as by chance: map and placement have separate random streams."""
    seeds = np.arange(4000)
    grids = random_maps(seeds, style=style)
    padded = np.pad(grids, ((0, 0), (1, 1), (1, 1))).astype(float)
    neighbours = padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1] + padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]
    chance = (neighbours * ~grids).sum() / (~grids).sum()
    for cells in random_starts_and_goals(seeds, grids, 10):
        seen = neighbours[np.arange(len(seeds))[:, None], cells[..., 0], cells[..., 1]].mean(axis=0)
        assert np.abs(seen - chance).max() < 0.06  # five standard errors


def test_a_given_map_is_kept_and_its_largest_region_used() -> None:
    grid = np.array([[0, 0, 0, 1, 0], [0, 0, 0, 1, 0]], bool)
    for seed in range(20):
        instance = random_instance(grid=grid, num_agents=6, seed=seed)
        assert (instance.grid == grid).all()
        assert instance.starts[:, 1].max() <= 2
        assert instance.goals[:, 1].max() <= 2
    with pytest.raises(ValueError, match="the largest connected free region has 6 cells, too few for 7 agents"):
        random_instance(grid=grid, num_agents=7, seed=0)


def test_global_random_state_is_neither_read_nor_written() -> None:
    state = np.random.get_state()  # noqa: NPY002
    first = random_instance(seed=5)
    np.random.seed(1)  # noqa: NPY002
    assert random_instance(seed=5) == first
    random_instance()
    assert random_map(seed=5) is not None
    drawn = np.random.rand()  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    assert np.random.rand() == drawn  # noqa: NPY002
    np.random.set_state(state)  # noqa: NPY002


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"density": 1.0}, r"density must lie in \[0, 1\), got 1.0"),
        ({"density": -0.1}, r"density must lie in \[0, 1\)"),
        ({"density": float("nan")}, r"density must lie in \[0, 1\)"),
        ({"height": 0}, "height must be at least 1, got 0"),
        ({"width": -3}, "width must be at least 1, got -3"),
        ({"style": "cave"}, "style must be one of cells, .*, empty, or a Maze, Rooms, Walls or Warehouse, got 'cave'"),
        ({"num_agents": 0}, "num_agents must be at least 1, got 0"),
        ({"seed": -1}, "seed must .*-1"),
        ({"seed": 2**64}, "seed must .*18446744073709551616"),
        ({"grid": np.ones((2, 2), bool)}, "the largest connected free region has 0 cells"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        random_instance(**settings)


def test_bad_seeds_are_refused() -> None:
    for seeds in ([0.5], [-1]):
        with pytest.raises(ValueError, match=r"seeds must be a vector of non-negative integers below 2\*\*64, got"):
            random_maps(seeds)
    for seeds in ([[1]], 3):
        with pytest.raises(ValueError, match=r"seeds must have shape \(B,\): a vector of non-negative integers, got"):
            random_maps(seeds)
    with pytest.raises(ValueError, match="give one seed for each grid"):
        random_starts_and_goals([1, 2], np.zeros((3, 4, 4), bool), 2)


def test_large_maps() -> None:
    for style in STYLES:
        density = 0.4 if style == "cells" else 0.2
        grid = random_map(height=256, width=256, density=density, style=style, seed=0)
        assert grid.sum() == round(density * 256 * 256)
    assert isinstance(random_instance(height=256, width=256, num_agents=1000, seed=0), Instance)


@given(
    st.integers(1, 25), st.integers(1, 25), strategies.seeds, st.sampled_from(["maze", "room", "warehouse", "empty"])
)
def test_the_other_styles_are_connected(height: int, width: int, seed: int, style: MapStyle) -> None:
    grid = random_map(height=height, width=width, style=style, seed=seed)
    assert grid.shape == (height, width)
    assert len(oracles.regions(grid)) == 1
    assert (grid == random_map(height=height, width=width, style=style, seed=seed)).all()
    if style == "empty":
        assert not grid.any()


def test_the_other_styles_look_as_they_are_called() -> None:
    maze, room, warehouse = (random_map(height=23, width=29, style=s, seed=1) for s in ("maze", "room", "warehouse"))
    assert not (~maze[:-1, :-1] & ~maze[1:, :-1] & ~maze[:-1, 1:] & ~maze[1:, 1:]).any(), "no open square"
    assert maze[1::2, 1::2].all()
    assert not maze[::2, ::2].any()
    assert room[5, 5]
    assert room[5].sum() == 29 - 5, "five doors along a wall"
    assert warehouse[1:3, 2:12].all()
    assert not warehouse[::3].any()
    for style in ("maze", "room"):
        assert (random_map(style=style, seed=1) != random_map(style=style, seed=2)).any()  # pyright: ignore[reportArgumentType]


parts = st.one_of(
    st.builds(Maze, corridor_width=st.integers(1, 5), loops=st.sampled_from([0.0, 0.1, 1.0])),
    st.builds(Rooms, room_size=st.integers(1, 8)),
    st.builds(
        Warehouse, shelf_length=st.integers(1, 7), shelf_depth=st.integers(1, 4), corridor_width=st.integers(1, 4)
    ),
)


@given(st.integers(1, 25), st.integers(1, 25), strategies.seeds, parts)
def test_parts_of_any_size_leave_the_map_connected(
    height: int, width: int, seed: int, style: Maze | Rooms | Warehouse
) -> None:
    grid = random_map(height=height, width=width, style=style, seed=seed)
    assert len(oracles.regions(grid)) == 1


@given(
    strategies.seeds,
    st.integers(3, 25),
    st.integers(3, 25),
    st.floats(0, 0.3),
    st.integers(1, 8),
    st.sampled_from([0.0, 0.5, 1.0]),
)
def test_walls_inside_a_ring_leave_the_border_free_and_reach_the_density(
    seed: int, height: int, width: int, density: float, segments: int, straight: float
) -> None:
    style = Walls(segments=segments, straight=straight, ring=True)
    pillars = ((height - 1) // 2) * ((width - 1) // 2)
    if round(density * height * width) > pillars:  # more than the pillars alone may leave no room for links
        density = pillars / (height * width)
    grid = random_map(height=height, width=width, density=density, style=style, seed=seed)
    assert grid.sum() == round(density * height * width)
    assert len(oracles.regions(grid)) == 1
    assert not grid[::2, ::2].any()
    for border in (grid[0], grid[-1], grid[:, 0], grid[:, -1]):
        assert not border.any()


def test_walls_grow_as_long_and_as_straight_as_their_parts_say() -> None:
    def walls(style: Walls) -> tuple[float, float]:
        """Pillars of a wall, and the share of pillars with two links whose links lie opposite each other."""
        grids = random_maps(range(100), height=21, width=21, density=0.1, style=style)
        pillars = grids[:, 1::2, 1::2].sum()
        links = grids.sum() - pillars
        up, down = grids[:, :-2:2, 1::2], grids[:, 2::2, 1::2]
        left, right = grids[:, 1::2, :-2:2], grids[:, 1::2, 2::2]
        passed = grids[:, 1::2, 1::2] & (up.astype(int) + down + left + right == 2)
        straight = passed & ((up & down) | (left & right))
        return float(pillars / (pillars - links)), float(straight.sum() / passed.sum())

    lengths = [walls(Walls(segments=segments, ring=True))[0] for segments in (1, 2, 4, 8)]
    assert lengths == sorted(lengths)
    assert lengths[3] > 2 * lengths[0]
    assert 0.2 < walls(Walls(segments=4, ring=True))[1] < 0.45, "a third of the ways on are straight"
    assert walls(Walls(segments=4, straight=1.0, ring=True))[1] > 0.9


def test_walls_with_the_parts_that_their_docstring_names_resemble_mazes_of_pogema() -> None:
    """The statistics are means over the 128 maps of POGEMA's set 02-mazes, the densities its 10 to 90 % quantiles."""
    style = Walls(segments=4, straight=0.5, ring=True)
    ways, pillars = [], []
    for density in (0.12, 0.26, 0.34, 0.37, 0.38):
        grids = random_maps(range(50), height=19, width=19, density=density, style=style)
        free = np.pad(~grids, ((0, 0), (1, 1), (1, 1))).astype(int)
        neighbours = free[:, :-2, 1:-1] + free[:, 2:, 1:-1] + free[:, 1:-1, :-2] + free[:, 1:-1, 2:]
        ways.append([float((neighbours[~grids] == number).mean()) for number in (1, 2, 3, 4)])
        pillars.append(grids[:, 1::2, 1::2].mean())
    ends_corridors_and_junctions = np.mean(ways, axis=0).tolist()
    assert ends_corridors_and_junctions == pytest.approx([0.02, 0.50, 0.29, 0.19], abs=0.03)
    assert np.mean(pillars) == pytest.approx(0.77, abs=0.03)


@given(strategies.seeds, st.integers(1, 4), st.integers(2, 5), st.integers(2, 5))
def test_a_maze_without_loops_is_a_tree_of_corridors(seed: int, corridor: int, rows: int, cols: int) -> None:
    period = corridor + 1
    height, width = rows * period - 1, cols * period - 1
    grid = random_map(height=height, width=width, style=Maze(corridor_width=corridor, loops=0.0), seed=seed)
    nodes, links = {(row, col) for row in range(rows) for col in range(cols)}, 0
    for row, col in nodes:
        top, left = row * period, col * period
        assert not grid[top : top + corridor, left : left + corridor].any()
        right, below = grid[top : top + corridor, left + corridor :], grid[top + corridor :, left : left + corridor]
        for wall in (right[:, :1], below[:1]):
            assert wall.all() or not wall.any(), "a passage is as wide as a corridor"
        links += col + 1 < cols and not grid[top, left + corridor]
        links += row + 1 < rows and not grid[top + corridor, left]
    assert links == len(nodes) - 1
    open_maze = random_map(height=height, width=width, style=Maze(corridor_width=corridor, loops=1.0), seed=seed)
    pillars = np.zeros((height, width), bool)
    pillars[corridor::period, corridor::period] = True
    assert (open_maze == pillars).all(), "all walls are opened"


def test_parts_have_the_requested_sizes() -> None:
    rooms = random_map(height=11, width=15, style=Rooms(room_size=3), seed=0)
    inner = np.zeros((11, 15), bool)
    inner[3::4], inner[:, 3::4] = True, True
    assert not rooms[~inner].any()
    assert rooms[inner].sum() == inner.sum() - (2 * 4 + 3 * 3), "a door in each wall between two rooms"
    shelves = random_map(height=14, width=24, style=Warehouse(shelf_length=4, shelf_depth=3, corridor_width=2))
    drawn = np.zeros((14, 24), bool)
    for top in (2, 7):
        for left in (4, 10, 16):
            drawn[top : top + 3, left : left + 4] = True
    assert (shelves == drawn).all()


def test_names_of_styles_stand_for_the_usual_parts() -> None:
    for name, style in (("maze", Maze()), ("room", Rooms()), ("walls", Walls()), ("warehouse", Warehouse())):
        assert (random_map(style=name, seed=4) == random_map(style=style, seed=4)).all()  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("kind", "settings", "error", "message"),
    [
        (Maze, {"corridor_width": 0}, ValueError, r"the corridor_width of Maze must lie in 1\.\.9999, got 0"),
        (Maze, {"loops": 1.5}, ValueError, r"the loops of a Maze must lie in \[0, 1\], got 1.5"),
        (Maze, {"loops": float("nan")}, ValueError, "the loops of a Maze must lie"),
        (Walls, {"segments": 0}, ValueError, r"the segments of Walls must lie in 1\.\.9999, got 0"),
        (Walls, {"straight": -0.1}, ValueError, r"the straight of Walls must lie in \[0, 1\], got -0.1"),
        (Walls, {"ring": 1}, TypeError, "the ring of Walls must be True or False, got 1"),
        (Rooms, {"room_size": 10**10}, ValueError, "the room_size of Rooms must lie"),
        (Rooms, {"room_size": 2.5}, TypeError, "the room_size of Rooms must be an integer, got 2.5"),
        (Warehouse, {"shelf_depth": -1}, ValueError, "the shelf_depth of Warehouse must lie"),
    ],
)
def test_parts_out_of_range_are_refused(
    kind: Any, settings: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        kind(**settings)
