"""Maps and scenarios in the MovingAI format (Stern et al. 2019), the benchmark files of the field.

The format counts columns x and rows y; this module converts them to (row, col).
"""

from __future__ import annotations

import math
import os
import re
from hashlib import blake2b
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments
from mapf_env.files import PathLike, as_path, decoded, read_bytes, read_text, require_outputs, write_whole
from mapf_env.instance import Instance, Obstacles, SharedMap, as_obstacles

FREE = ".GSE"
"""Characters of cells that robots may enter: ground, swamp, and emitters of the League of Robot Runners."""
BLOCKED = "@OTW"
"""Characters of obstacles: out of bounds, trees and water."""

_STEPS_PER_BUCKET = 4


class _Line(NamedTuple):
    """A non-blank line of a file, without blanks at its ends."""

    number: int
    text: str


class _Entry(NamedTuple):
    """One entry of a scenario."""

    line: int
    map_name: str
    size: tuple[int, int]
    start: tuple[int, int]
    goal: tuple[int, int]


def load_map(path: PathLike) -> Obstacles:
    """Read a `.map` file as a grid (H, W) bool, True where an obstacle is.

    Raises:
        ValueError: If the file is damaged; the message names the file and the line.
        OSError: If the file cannot be read.
    """
    return _grid(path, decoded(read_bytes(path)))


def load_scen(path: PathLike, num_agents: int | None = None, map_path: PathLike | None = None) -> Instance:
    """Read the first `num_agents` entries of a `.scen` file, or all of them, as an instance: entry i is agent i.

    The map is looked for next to the scenario, by the name given there, unless `map_path` says where it is.

    Raises:
        ValueError: If a file is damaged, has fewer entries than agents asked for, or its entries are not a valid
            instance together; the message names the file and the line.
        OSError: If a file cannot be read.
    """
    lines = _lines(read_text(path))
    if not lines or not re.fullmatch(r"version\s+1(\.0*)?", lines[0].text, re.IGNORECASE):
        raise ValueError(
            f"{path}, {_place(lines, 0)}: expected 'version 1', got {_shown(lines, 0)}; is this a MovingAI scenario?"
        )
    available = len(lines) - 1
    count = available if num_agents is None else arguments.integer(num_agents, "num_agents", 1)
    if count < 1:
        raise ValueError(f"{path}, {_place(lines, 0)}: no entries follow; give another file")
    if count > available:
        raise ValueError(
            f"{path}, {_place(lines, -1)}: {count} agents asked for, but only {available} entries; ask for fewer"
        )
    entries = [_entry(path, line) for line in lines[1 : count + 1]]
    for entry in entries:
        if entry.map_name != entries[0].map_name:
            raise ValueError(
                f"{path}, line {entry.line}: the map is {entry.map_name!r}, but line {entries[0].line} says "
                f"{entries[0].map_name!r}; all agents of an instance share one map"
            )
    chosen_map = _beside(path, entries[0]) if map_path is None else as_path(map_path, "map_path")
    shared = _shared_map(chosen_map)
    for entry in entries:
        if entry.size != shared.grid.shape:
            raise ValueError(
                f"{path}, line {entry.line}: the scenario's map has height {entry.size[0]} and width {entry.size[1]}, "
                f"but {chosen_map} has height {shared.grid.shape[0]} and width {shared.grid.shape[1]}: the scenario is "
                "scaled, or made for another map; give the map of that size"
            )
    try:
        return Instance(shared, [entry.start for entry in entries], [entry.goal for entry in entries])
    except ValueError as error:
        agent = int((re.search(r"agents? (\d+)", str(error)) or ["", "0"])[1])
        raise ValueError(
            f"{path} with {chosen_map}: {error} (agent {agent} is on line {entries[agent].line} of the scenario)"
        ) from error


def save_map(path: PathLike, grid: npt.ArrayLike) -> None:
    """Write the grid (H, W) as a `.map` file, free cells as '.', obstacles as '@'.

    Raises:
        ValueError: If the grid is not a map.
        TypeError: If the grid has the wrong dtype.
        OSError: If the file cannot be written; an existing one is then unchanged.
    """
    obstacles = as_obstacles(grid)
    height, width = obstacles.shape
    characters = np.where(obstacles, ord("@"), ord(".")).astype(np.uint8)
    rows = [row.tobytes().decode("ascii") for row in characters]
    write_whole(path, "\n".join(["type octile", f"height {height}", f"width {width}", "map", *rows, ""]))


def save_scen(path: PathLike, instance: Instance, map_path: PathLike) -> None:
    """Write the instance as a `.scen` file whose map is `map_path`, a file that `save_map` has written before.

    The map's path is written relative to the scenario, so `load_scen(path)` finds it. The column of optimal lengths
    holds the shortest distance over the four moves, where MovingAI's own files count diagonal moves too.

    Raises:
        ValueError: If the file at `map_path` holds another map than the instance's, is `path` itself, or has a name
            that a scenario cannot hold.
        OSError: If the map cannot be read or the scenario not written; an existing one is then unchanged.
    """
    arguments.instance_of(instance, Instance, "instance")
    require_outputs([path], [as_path(map_path, "map_path")])
    if not as_path(map_path).is_file():
        raise FileNotFoundError(f"no map at {map_path}: write it first, with save_map(map_path, instance.grid)")
    if not np.array_equal(load_map(map_path), instance.grid):
        raise ValueError(
            f"{map_path} is not the instance's map; save the instance's grid under another name and give that"
        )
    name = Path(os.path.relpath(map_path, as_path(path).parent)).as_posix()
    if re.search(r"[\t\r\n]", name):
        raise ValueError(
            f"the map's name {name!r} holds a tab or a line break, which a scenario cannot; rename the map"
        )
    height, width = instance.grid.shape
    lines = ["version 1"]
    for start, goal in zip(instance.starts, instance.goals, strict=True):
        length = int(_native.distances(instance.grid, goal[None])[0, start[0], start[1]])
        cells = (start[1], start[0], goal[1], goal[0])
        lines.append("\t".join(map(str, (length // _STEPS_PER_BUCKET, name, width, height, *cells, f"{length:.8f}"))))
    write_whole(path, "\n".join([*lines, ""]))


def _shared_map(path: Path) -> SharedMap:
    """Return the map of a file; files of equal content share one."""
    content = read_bytes(path)
    return SharedMap.known(blake2b(content).digest(), lambda: SharedMap.of(_grid(path, decoded(content))))


def _grid(path: PathLike, text: str) -> Obstacles:
    lines = _lines(text)
    _require_line(path, lines, 0, "type octile", "type tile")
    sizes: dict[str, int] = {}
    lines_of: dict[str, int] = {}
    for k in (1, 2):
        name, size = _size(path, lines, k, [each for each in ("height", "width") if each not in sizes])
        sizes[name], lines_of[name] = size, lines[k].number
    height, width = sizes["height"], sizes["width"]
    _require_line(path, lines, 3, "map")
    rows = lines[4:]
    if len(rows) < height:
        raise ValueError(
            f"{path}, {_place(lines, -1)}: the map ends after {len(rows)} rows, but line {lines_of['height']} says "
            f"height {height}; restore the missing rows or correct the height"
        )
    if len(rows) > height:
        raise ValueError(
            f"{path}, line {rows[height].number}: more than the {height} rows that line {lines_of['height']} promises; "
            "remove the surplus or correct the height"
        )
    for number, row in rows:
        unknown = re.search(f"[^{FREE}{BLOCKED}]", row)
        if unknown:
            raise ValueError(
                f"{path}, line {number}, column {unknown.start() + 1}: unknown character {unknown.group()!r}; "
                f"free cells are {' '.join(FREE)} and obstacles {' '.join(BLOCKED)}"
            )
        if len(row) != width:
            raise ValueError(
                f"{path}, line {number}: the row has {len(row)} cells, but line {lines_of['width']} says "
                f"width {width}; restore the row or correct the width"
            )
    cells = np.frombuffer("".join(row.text for row in rows).encode("ascii"), dtype=np.uint8).reshape(height, width)
    return np.isin(cells, np.frombuffer(BLOCKED.encode("ascii"), dtype=np.uint8))


def _lines(text: str) -> list[_Line]:
    """Return the non-blank lines of a text, without blanks at their ends."""
    numbered = ((number, line.strip()) for number, line in enumerate(text.split("\n"), start=1))
    return [_Line(number, line) for number, line in numbered if line]


def _place(lines: list[_Line], k: int) -> str:
    """Return the place of the k-th line, or where it would be, as an error message names it."""
    if k < len(lines):
        return f"line {lines[k].number}"
    return f"line {lines[-1].number + 1 if lines else 1}"


def _shown(lines: list[_Line], k: int) -> str:
    """Return the k-th line as an error message shows it."""
    return repr(lines[k].text[:40]) if k < len(lines) else "the end of the file"


def _require_line(path: PathLike, lines: list[_Line], k: int, *expected: str) -> None:
    if k >= len(lines) or lines[k].text.lower().split() not in [each.split() for each in expected]:
        raise ValueError(
            f"{path}, {_place(lines, k)}: expected {expected[0]!r}, got {_shown(lines, k)}; is this a MovingAI map?"
        )


def _size(path: PathLike, lines: list[_Line], k: int, names: list[str]) -> tuple[str, int]:
    fields = lines[k].text.lower().split() if k < len(lines) else []
    if len(fields) != 2 or fields[0] not in names or not _is_number(fields[1]) or int(fields[1]) == 0:
        name = fields[0] if fields and fields[0] in names else names[0]
        raise ValueError(
            f"{path}, {_place(lines, k)}: expected '{name}' and a positive whole number, got {_shown(lines, k)}; "
            "correct the header"
        )
    return fields[0], int(fields[1])


def _is_number(text: str) -> bool:
    return re.fullmatch("[0-9]{1,9}", text) is not None


def _entry(path: PathLike, line: _Line) -> _Entry:
    number, text = line
    fields = [field.strip() for field in text.split("\t")]
    if len(fields) != 9:
        fields = text.split()
    if len(fields) != 9:
        raise ValueError(
            f"{path}, line {number}: expected 9 fields separated by tabs (bucket, map, width, height, start x, "
            f"start y, goal x, goal y, length), got {len(fields)}; restore or remove the line"
        )
    bucket, map_name, *numbers, length = fields
    names = ("width", "height", "start x", "start y", "goal x", "goal y")
    for name, text in zip(("bucket", *names), (bucket, *numbers), strict=True):
        if not _is_number(text):
            raise ValueError(
                f"{path}, line {number}: the {name} must be a whole number from 0, got {text[:40]!r}; correct it"
            )
    if not _is_length(length):
        raise ValueError(f"{path}, line {number}: the length must be a number from 0, got {length[:40]!r}; correct it")
    if not map_name:
        raise ValueError(f"{path}, line {number}: the map's name is missing; write it in the second field")
    width, height, start_x, start_y, goal_x, goal_y = map(int, numbers)
    return _Entry(number, map_name, (height, width), (start_y, start_x), (goal_y, goal_x))


def _is_length(text: str) -> bool:
    try:
        value = float(text)
    except ValueError:
        return False
    return math.isfinite(value) and value >= 0


def _beside(path: PathLike, entry: _Entry) -> Path:
    """Return the map that a scenario names: by its relative path, or by its file name alone as MovingAI's tools do."""
    map_name = entry.map_name
    parts = PurePosixPath(map_name.replace("\\", "/"))
    folder = Path(path).parent
    for candidate in (folder / map_name, folder / parts, folder / parts.name):
        if os.path.isfile(candidate):  # False for what can be no file's name too
            return candidate
    raise FileNotFoundError(
        f"{path}, line {entry.line} names the map {map_name!r}, which is not next to it: put it there or give map_path"
    )
