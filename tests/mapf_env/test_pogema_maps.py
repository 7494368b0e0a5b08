"""POGEMA's maps are read as POGEMA reads them, and robots are placed as POGEMA places them."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import oracles
import strategies
from mapf_env import Instance, PogemaMap, load_pogema_maps, parse_pogema_map
from mapf_env.problem_file import load_problem

MAPS = """"one": |-
  ..#
  ...

# a comment
two map: |
    @.!
    $#.
'three': |-
  aB
  bA
"""
HALL = "\n".join(["." * 6] * 5)
SPLIT = "..#...\n..#...\n###...\n......\n......"
MARKED = "@@!$\n@.!$\n@@#$"


def cells(mask: np.ndarray) -> list[tuple[int, int]]:
    return [(int(row), int(col)) for row, col in np.argwhere(mask)]


@pytest.fixture
def maps(tmp_path: Path) -> dict[str, PogemaMap]:
    (tmp_path / "maps.yaml").write_text(MAPS)
    return load_pogema_maps(tmp_path / "maps.yaml")


def test_a_file_of_maps_is_read_in_its_order(maps: dict[str, PogemaMap]) -> None:
    assert list(maps) == ["one", "two map", "three"]
    assert maps["one"].grid.tolist() == [[False, False, True], [False, False, False]]
    assert not maps["one"].marked


def test_marks_say_where_robots_start_and_goals_lie(maps: dict[str, PogemaMap]) -> None:
    two = maps["two map"]
    assert two.marked
    assert cells(two.grid) == [(1, 1)]
    assert cells(two.start_cells) == [(0, 0), (0, 1), (1, 2)]
    assert cells(two.goal_cells) == [(0, 1), (1, 0), (1, 2)]


def test_letters_are_starts_and_their_capitals_goals(maps: dict[str, PogemaMap]) -> None:
    free = np.zeros((2, 2), bool)
    assert maps["three"].drawn_instance() == Instance(free, [(0, 0), (1, 0)], [(1, 1), (0, 1)])
    with pytest.raises(ValueError, match="no robots are drawn on this map"):
        maps["one"].drawn_instance()


def test_a_file_without_names_is_one_map(tmp_path: Path) -> None:
    (tmp_path / "hall.txt").write_text("#..\r\n..#\r\n")
    (name, only), *others = load_pogema_maps(tmp_path / "hall.txt").items()
    assert (name, others) == ("hall", [])
    assert only.grid.tolist() == [[True, False, False], [False, False, True]]


@given(strategies.grids())
def test_drawn_maps_are_read_back(grid: oracles.Grid) -> None:
    drawn = "\n".join("".join("#" if cell else "." for cell in row) for row in grid)
    assert (parse_pogema_map(drawn).grid == grid).all()


@pytest.mark.parametrize(
    ("drawing", "seed", "starts", "goals"),
    [
        (HALL, 0, [(0, 2), (4, 2), (1, 4)], [(1, 5), (3, 3), (0, 4)]),
        (SPLIT, 4, [(1, 5), (0, 0), (1, 4)], [(3, 4), (1, 0), (1, 3)]),
        (MARKED, 1, [(2, 0), (0, 0)], [(2, 3), (0, 3)]),
    ],
)
def test_robots_are_placed_as_pogema_places_them(
    drawing: str, seed: int, starts: list[tuple[int, int]], goals: list[tuple[int, int]]
) -> None:
    """The expected cells are those that POGEMA 1.4.0 gives for these maps and seeds."""
    found = parse_pogema_map(drawing)
    assert found.instance(len(starts), seed) == Instance(found.grid, starts, goals)


@pytest.mark.parametrize(
    ("drawing", "seed", "goals"),
    [
        (
            HALL,
            0,
            [[(1, 4), (3, 2), (4, 4), (0, 5), (1, 3)], [(2, 2), (4, 0), (4, 4), (1, 2), (1, 5)], [(2, 5), (2, 1)]],
        ),
        (
            SPLIT,
            4,
            [[(3, 3), (1, 3), (2, 5), (3, 4), (3, 2)], [(0, 0), (0, 1), (1, 1), (1, 0), (0, 0)], [(4, 2), (1, 4)]],
        ),
        (MARKED, 1, [[(0, 3), (1, 1), (0, 3), (2, 3)], [(2, 3), (1, 3), (2, 3), (1, 1)]]),
    ],
)
def test_goals_of_lifelong_play_are_drawn_as_pogema_draws_them(
    drawing: str, seed: int, goals: list[list[tuple[int, int]]]
) -> None:
    """The expected cells are those that POGEMA 1.4.0 gives, except that it may repeat a goal on marked maps."""
    found = parse_pogema_map(drawing).goal_sequences(len(goals), seed, 30)
    assert found.shape == (len(goals), 30, 2)
    for sequence, expected in zip(found, goals, strict=True):
        assert oracles.cells(sequence[: len(expected)]) == expected
        assert (sequence[1:] != sequence[:-1]).any(axis=1).all()
    shorter = parse_pogema_map(drawing).goal_sequences(len(goals), seed, 4)
    assert (shorter == found[:, :4]).all()


@given(strategies.grids(), st.integers(0, 2**32), st.integers(1, 6))
def test_placed_robots_are_an_instance_or_too_many(grid: oracles.Grid, seed: int, robots: int) -> None:
    drawn = "\n".join("".join("#" if cell else "." for cell in row) for row in grid)
    room = sum(len(region) // 2 for region in oracles.regions(np.array(grid)))
    if robots > room:
        with pytest.raises(ValueError, match=f"POGEMA places at most {room} robots on this map: {robots} are too many"):
            parse_pogema_map(drawn).instance(robots, seed)
        return
    instance = parse_pogema_map(drawn).instance(robots, seed)
    assert instance.num_agents == robots
    assert not set(oracles.cells(instance.starts)) & set(oracles.cells(instance.goals))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "line 1: the map has no cells"),
        ("one: |-\n", "line 1: the map has no cells"),
        ("one: |-\ntwo: |-\n  .\n", "line 1: the map has no cells"),
        ("one: |-\n  ..\n  .\n", "line 3: the row has 1 cells, that of line 2 has 2; make them equal"),
        ("one: |-\n  .. .\n", "line 2: unknown character ' '"),
        ("one: |-\n  .é\n", "line 2: unknown character 'é'"),
        ("one: |-\n  .\none: |\n  .\n", "line 3: line 1 has a map 'one' already"),
        ("one: |-\n  .\n##\n", "line 3: expected 'name: |-' or an indented row of a map, got '##'"),
        ("size: 5\none: |-\n  .\n", "line 1: expected 'name: |-'"),
        ("one: |-\n\t..\n", "line 2: expected 'name: |-'"),
        ("  ..\none: |-\n  .\n", "line 1: expected 'name: |-'"),
        ("one: !!python/object:os.system |-\n  .\n", "line 1: unknown character"),
        ("one: &a |-\n  .\ntwo: *a\n", "line 1: unknown character"),
        ("one: |-\n  aA\n  a.\n", "line 3: the letter a is drawn twice"),
        ("one: |-\n  aAb\n", "line 2: the letter b needs B on the same map"),
        ("aAB", "line 1: the letter B needs b on the same map"),
    ],
)
def test_damaged_files_are_refused_with_their_line(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "maps.yaml"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(ValueError, match=f"^{re.escape(f'{file}, {message}')}[^\n]*$"):
        load_pogema_maps(file)


def test_a_drawing_that_is_not_a_map_is_refused() -> None:
    for drawing, message in ((" \n", "line 1: the map has no cells"), ("..\n?.", r"line 2: unknown character '\?'")):
        with pytest.raises(ValueError, match=message):
            parse_pogema_map(drawing)
    with pytest.raises(TypeError, match="drawing must be a str, got int"):
        parse_pogema_map(3)  # pyright: ignore[reportArgumentType]


def test_marked_cells_that_are_too_few_or_cut_off_are_refused() -> None:
    with pytest.raises(ValueError, match="POGEMA places at most 1 robots on this map: 2 are too many"):
        parse_pogema_map("@!$").instance(2, 0)
    with pytest.raises(ValueError, match="agent 0 cannot reach its goal"):
        parse_pogema_map("@#$").instance(1, 0)


def test_commands_take_a_file_of_maps_and_place_robots_as_pogema_does(tmp_path: Path) -> None:
    file = tmp_path / "maps.yaml"
    file.write_text(f"hall: |-\n  {HALL.replace(chr(10), chr(10) + '  ')}\n" + MAPS)
    options: dict[str, Any] = {"map": None, "seed": 0}
    hall = parse_pogema_map(HALL)
    assert load_problem(file, agents=3, index=None, **options) == hall.instance(3, 0)
    assert load_problem(file, agents=4, index=0, map=None, seed=8) == hall.instance(4, 8)
    assert load_problem(file, agents=None, index=3, **options).num_agents == 2, "the robots that are drawn"
    with pytest.raises(ValueError, match="give --agents"):
        load_problem(file, agents=None, index=0, **options)
    with pytest.raises(ValueError, match=r"maps\.yaml holds 4 maps, counted from 0: there is no --index 4"):
        load_problem(file, agents=1, index=4, **options)
