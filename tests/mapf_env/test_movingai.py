import contextlib
from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapf_env import Instance, load_map, load_scen, save_map, save_scen

MAP = "type octile\nheight 3\nwidth 4\nmap\n..@.\nGS.T\nOW..\n"
GRID = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [1, 1, 0, 0]], dtype=bool)
SCEN = "version 1\n0\ta.map\t4\t3\t0\t0\t2\t1\t2.41421356\n1\ta.map\t4\t3\t1\t1\t3\t2\t2.41421356\n"


@st.composite
def instances(draw):
    """Instances on maps up to 6x7 whose goals lie in the region of their starts."""
    height, width = draw(st.integers(1, 6)), draw(st.integers(1, 7))
    grid = np.array(draw(st.lists(st.booleans(), min_size=height * width, max_size=height * width)))
    grid = grid.reshape(height, width)
    grid[draw(st.integers(0, height - 1)), draw(st.integers(0, width - 1))] = False
    region = sorted(steps_from(grid, draw(st.sampled_from([tuple(cell) for cell in np.argwhere(~grid).tolist()]))))
    robots = draw(st.integers(1, min(len(region), 5)))
    return Instance(grid, draw(st.permutations(region))[:robots], draw(st.permutations(region))[:robots])


def steps_from(grid, start):
    """The distance of every cell that can be reached, by a plain breadth-first search."""
    steps, queue = {start: 0}, deque([start])
    while queue:
        row, col = queue.popleft()
        for cell in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
            inside = 0 <= cell[0] < grid.shape[0] and 0 <= cell[1] < grid.shape[1]
            if inside and not grid[cell] and cell not in steps:
                steps[cell] = steps[row, col] + 1
                queue.append(cell)
    return steps


@pytest.fixture
def files(tmp_path):
    """Write a map and a scenario next to it, and return the scenario's path."""

    def write(scen=SCEN, map_text=MAP):
        (tmp_path / "a.map").write_bytes(map_text.encode())
        (tmp_path / "a.scen").write_bytes(scen.encode())
        return tmp_path / "a.scen"

    return write


@given(instances())
def test_maps_and_scenarios_round_trip(tmp_path_factory, instance):
    folder = tmp_path_factory.mktemp("round")
    save_map(folder / "a.map", instance.grid)
    save_scen(folder / "a.scen", instance, folder / "a.map")
    assert np.array_equal(load_map(folder / "a.map"), instance.grid)
    assert load_scen(folder / "a.scen") == instance
    for count in range(1, instance.num_agents + 1):
        first = load_scen(folder / "a.scen", count)
        assert first == Instance(instance.grid, instance.starts[:count], instance.goals[:count])


@given(instances())
def test_scenarios_follow_the_format(tmp_path_factory, instance):
    folder = tmp_path_factory.mktemp("fields")
    save_map(folder / "a.map", instance.grid)
    save_scen(folder / "a.scen", instance, folder / "a.map")
    version, *lines = (folder / "a.scen").read_text().splitlines()
    assert version == "version 1"
    for line, start, goal in zip(lines, instance.starts.tolist(), instance.goals.tolist(), strict=True):
        bucket, name, width, height, start_x, start_y, goal_x, goal_y, length = line.split("\t")
        assert name == "a.map"
        assert (int(height), int(width)) == instance.grid.shape
        assert [int(start_y), int(start_x)] == start
        assert [int(goal_y), int(goal_x)] == goal
        assert float(length) == steps_from(instance.grid, tuple(start))[tuple(goal)]
        assert int(bucket) == int(float(length) // 4)


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_reads_every_character_and_line_end(files, line_end):
    scen = files(SCEN.replace("\n", line_end), MAP.replace("\n", line_end))
    assert np.array_equal(load_map(scen.parent / "a.map"), GRID)
    assert load_scen(scen) == Instance(GRID, [(0, 0), (1, 1)], [(1, 2), (2, 3)])


def test_x_is_the_column_and_y_the_row(files):
    instance = load_scen(files(), num_agents=1)
    assert instance.starts.tolist() == [[0, 0]]
    assert instance.goals.tolist() == [[1, 2]]


def test_blank_lines_at_the_end_and_spaces_between_fields_are_fine(files):
    scen = files(SCEN.replace("\t", " ") + "\n \n", MAP + "\n")
    assert load_scen(scen).num_agents == 2


DIALECTS = {
    "blanks at the ends of lines": lambda text: text.replace("\n", " \t\n"),
    "blanks at the beginnings of lines": lambda text: " " + text.replace("\n", "\n  ").rstrip(" "),
    "blank lines between the lines": lambda text: text.replace("\n", "\n \n\n"),
    "a blank line after the head": lambda text: text.replace("map\n", "map\n\n").replace("version 1", "version 1\n"),
    "no line end at the end": lambda text: text.rstrip("\n"),
    "line ends of Windows": lambda text: text.replace("\n", "\r\n"),
    "line ends of old Macs": lambda text: text.replace("\n", "\r"),
    "a byte order mark": lambda text: "\ufeff" + text,
    "a byte order mark where files were joined": lambda text: text.replace("\n", "\n\ufeff"),
    "version 1.00": lambda text: text.replace("version 1", "version 1.00"),
    "version 1.0 in capitals": lambda text: text.replace("version 1", "VERSION\t1.0"),
    "tiles": lambda text: text.replace("octile", "tile"),
    "width before height": lambda text: text.replace("height 3\nwidth 4", "width 4\nheight 3"),
    "a head in capitals": lambda text: text.replace("height", "HEIGHT").replace("map\n..", "Map\n.."),
    "emitters": lambda text: text.replace("GS", "ES"),
    "tabs with blanks": lambda text: text.replace("\t", " \t "),
    "blanks for tabs": lambda text: text.replace("\t", "   "),
    "some blanks for tabs": lambda text: text.replace("\t2", " 2"),
}


@pytest.mark.parametrize("dialect", DIALECTS.values(), ids=DIALECTS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_harmless_dialects_are_read(files, dialect, encoding):
    scen = files()
    for name, text in (("a.map", MAP), ("a.scen", SCEN)):
        (scen.parent / name).write_bytes(dialect(text).encode(encoding))
    assert np.array_equal(load_map(scen.parent / "a.map"), GRID)
    assert load_scen(scen) == Instance(GRID, [(0, 0), (1, 1)], [(1, 2), (2, 3)])
    assert load_scen(scen, 1).num_agents == 1


def test_scenarios_on_one_map_share_it(files):
    scen = files()
    first, second = load_scen(scen), load_scen(scen, 1)
    assert first.shared_map is second.shared_map
    assert first.grid is second.grid
    (scen.parent / "a.map").write_text(MAP.replace("..@.", "...."))
    third = load_scen(scen)
    assert third.shared_map is not first.shared_map
    assert not third.grid[0].any()
    grid = load_map(scen.parent / "a.map")
    grid[0, 0] = True  # a copy of the caller's
    assert not third.grid[0, 0]
    (scen.parent / "a.map").write_text(MAP)
    (scen.parent / "a.map").write_bytes(MAP.replace("\n", "\r\n").encode())
    assert load_scen(scen).shared_map is first.shared_map, "another file, the same map"


def test_entries_after_the_first_n_are_not_read(files):
    assert load_scen(files(SCEN + "damaged\n"), num_agents=2).num_agents == 2


def test_the_map_is_found_by_path_by_name_or_as_given(files, tmp_path):
    scen = files(SCEN.replace("a.map", "maps/dao/a.map"))
    assert np.array_equal(load_scen(scen).grid, GRID)
    (tmp_path / "maps/dao").mkdir(parents=True)
    save_map(tmp_path / "maps/dao/a.map", np.zeros((3, 4), bool))
    assert not load_scen(scen).grid.any()
    assert np.array_equal(load_scen(scen, map_path=tmp_path / "a.map").grid, GRID)
    files(SCEN.replace("a.map", "maps\\dao\\a.map"))
    assert not load_scen(scen).grid.any()


def test_a_scenario_finds_a_map_saved_in_another_folder(tmp_path):
    for folder in ("maps", "scens"):
        (tmp_path / folder).mkdir()
    instance = Instance(GRID, [(0, 0)], [(2, 3)])
    save_map(tmp_path / "maps/one map.map", GRID)
    save_scen(tmp_path / "scens/a.scen", instance, tmp_path / "maps/one map.map")
    assert load_scen(tmp_path / "scens/a.scen") == instance


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: expected 'type octile', got the end of the file"),
        ("PNG", "line 1: expected 'type octile', got 'PNG'; is this a MovingAI map"),
        (MAP.replace("octile", "hexagon"), "line 1: expected 'type octile', got 'type hexagon'"),
        ("type octile\n", "line 2: expected 'height' and a positive whole number, got the end of the file"),
        (MAP.replace("height 3", "height three"), "line 2: expected 'height' and a positive whole number"),
        (MAP.replace("height 3", "height 0"), "line 2: expected 'height' and a positive whole number, got 'height 0'"),
        (MAP.replace("height 3", "height -3"), "line 2: expected 'height'"),
        (MAP.replace("height 3", "height " + 5000 * "9"), "line 2: expected 'height'"),
        (MAP.replace("width 4", "width"), "line 3: expected 'width' and a positive whole number, got 'width'"),
        (MAP.replace("width 4", "width 4.0"), "line 3: expected 'width'"),
        (MAP.replace("\nmap\n", "\n"), "line 4: expected 'map', got '..@.'"),
        (MAP.removesuffix("OW..\n"), "line 6: the map ends after 2 rows, but line 2 says height 3"),
        (MAP.replace("height 3", "height 999999999"), "the map ends after 3 rows"),
        (MAP + "....\n", "line 8: more than the 3 rows"),
        (MAP.replace("GS.T", "GS."), "line 6: the row has 3 cells, but line 3 says width 4; restore"),
        (MAP.replace("GS.T", "GS.T."), "line 6: the row has 5 cells"),
        (MAP.replace("GS.T\n", "\n"), "line 7: the map ends after 2 rows, but line 2 says height 3"),
        (MAP.replace("width 4", "height 4"), "line 3: expected 'width' and a positive whole number, got 'height 4'"),
        (MAP.replace("height 3\nwidth 4", "width 4\nheight 0"), "line 3: expected 'height' and a positive"),
        (
            MAP.replace("height 3\nwidth 4", "width 5\n\nheight 3"),
            "line 6: the row has 4 cells, but line 2 says width 5",
        ),
        (
            MAP.replace("GS.T", "GSxT"),
            "line 6, column 3: unknown character 'x'; free cells are . G S E and obstacles @ O T W",
        ),
        (MAP.replace("GS.T", "GS T"), "line 6, column 3: unknown character ' '"),
        (MAP.replace("..@.", "..é."), "line 5, column 3: unknown character 'é'"),
        (MAP.replace("..@.", "..\0."), r"line 5, column 3: unknown character '\x00'"),
    ],
)
def test_damaged_maps(tmp_path, text, message):
    path = tmp_path / "b.map"
    path.write_bytes(text.encode())
    with pytest.raises(ValueError) as error:  # noqa: PT011
        load_map(path)
    assert str(path) in str(error.value)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: expected 'version 1', got the end of the file; is this a MovingAI scenario"),
        (SCEN.replace("version 1", "version 2"), "line 1: expected 'version 1', got 'version 2'"),
        ("version 1\n", "line 1: no entries follow"),
        (SCEN.replace("\t2.41421356\n1", "\n1"), "line 2: expected 9 fields separated by tabs"),
        (SCEN.replace("version 1\n", "version 1\n\n").replace("\t3\t2\t", "\t2\t1\t"), "(agent 0 is on line 3 of"),
        (SCEN.replace("version 1", "version 1.5"), "line 1: expected 'version 1', got 'version 1.5'"),
        (SCEN[:60], "line 3: expected 9 fields"),
        (SCEN.replace("\n1\ta", "\none\ta"), "line 3: the bucket must be a whole number from 0, got 'one'"),
        (SCEN.replace("\t0\t0\t2", "\tx\t0\t2"), "line 2: the start x must be a whole number from 0, got 'x'"),
        (SCEN.replace("\t0\t0\t2", "\t0\t-1\t2"), "line 2: the start y must be a whole number from 0, got '-1'"),
        (SCEN.replace("\t2\t1\t", "\t2.5\t1\t"), "line 2: the goal x must be a whole number from 0, got '2.5'"),
        (SCEN.replace("\t2\t1\t", "\t2\t" + 5000 * "1" + "\t"), "line 2: the goal y must be"),
        (SCEN.replace("2.41421356", "far"), "line 2: the length must be a number from 0, got 'far'"),
        (SCEN.replace("2.41421356", "nan"), "line 2: the length must be a number from 0, got 'nan'"),
        (SCEN.replace("\n0\ta.map", "\n0\t"), "line 2: the map's name is missing"),
        (SCEN.replace("1\ta.map", "1\tb.map"), "line 3: the map is 'b.map', but line 2 says 'a.map'"),
        (SCEN.replace("\t4\t3\t1", "\t3\t4\t1"), "line 3: the scenario's map has height 4 and width 3, but"),
        (SCEN.replace("\t4\t3\t", "\t8\t6\t"), "has height 3 and width 4: the scenario is scaled, or made for another"),
        (SCEN.replace("\t0\t0\t2", "\t4\t0\t2"), "the start (0, 4) of agent 0 lies outside the 3x4 map"),
        (SCEN.replace("\t0\t0\t2", "\t2\t0\t2"), "the start (0, 2) of agent 0 lies on an obstacle"),
        (SCEN.replace("\t0\t0\t2", "\t3\t0\t2"), "agent 0 cannot reach its goal (1, 2) from (0, 3)"),
        (SCEN.replace("\t1\t1\t3", "\t0\t0\t3"), "agents 0 and 1 share the start (0, 0)"),
        (SCEN.replace("\t3\t2\t", "\t2\t1\t"), "agents 0 and 1 share the goal (1, 2)"),
    ],
)
def test_damaged_scenarios(files, text, message):
    path = files(text)
    with pytest.raises(ValueError) as error:  # noqa: PT011
        load_scen(path)
    assert str(path) in str(error.value)
    assert message in str(error.value)


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("bytes") / "a"
    for load, head in ((load_map, b"type octile\nheight 2\nwidth 2\nmap\n"), (load_scen, b"version 1\n")):
        for content in (data, head + data):
            path.write_bytes(content)
            with contextlib.suppress(ValueError, FileNotFoundError):
                load(path)


def test_more_agents_than_entries(files):
    with pytest.raises(ValueError, match=r"a\.scen, line 3: 3 agents asked for, but only 2 entries; ask for fewer"):
        load_scen(files(), num_agents=3)


@pytest.mark.parametrize("count", [0, -1])
def test_too_few_agents(files, count):
    with pytest.raises(ValueError, match=f"num_agents must be at least 1, got {count}"):
        load_scen(files(), num_agents=count)


def test_the_error_for_a_missing_map_names_the_expected_place(files, tmp_path):
    scen = files()
    (tmp_path / "a.map").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"a\.scen, line 2 names the map 'a\.map', which is not next to it: put it there or"
    ):
        load_scen(scen)


def test_a_scenario_is_only_written_for_its_own_map(tmp_path):
    instance = Instance(GRID, [(0, 0)], [(2, 3)])
    with pytest.raises(FileNotFoundError, match="write it first, with save_map"):
        save_scen(tmp_path / "a.scen", instance, tmp_path / "a.map")
    save_map(tmp_path / "a.map", ~GRID)
    with pytest.raises(ValueError, match="is not the instance's map"):
        save_scen(tmp_path / "a.scen", instance, tmp_path / "a.map")
    save_map(tmp_path / "a.map", GRID)
    with pytest.raises(ValueError, match=r"a\.map would overwrite the input"):
        save_scen(tmp_path / "a.map", instance, tmp_path / "a.map")
    save_map(tmp_path / "a\tb.map", GRID)
    with pytest.raises(ValueError, match="holds a tab or a line break"):
        save_scen(tmp_path / "a.scen", instance, tmp_path / "a\tb.map")
    assert not (tmp_path / "a.scen").exists()


def test_an_invalid_map_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="grid must have shape"):
        save_map(tmp_path / "a.map", np.zeros((0, 3), bool))
    with pytest.raises(TypeError, match="grid must be bool"):
        save_map(tmp_path / "a.map", np.zeros((2, 3)))
    assert not list(tmp_path.iterdir())
