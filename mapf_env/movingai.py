"""Maps and scenarios in the MovingAI format (Stern et al. 2019), the benchmark files of the field.

The format counts columns x and rows y; this module turns them into (row, col) at its border.
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments
from mapf_env.files import PathLike, as_path, write_whole
from mapf_env.instance import Instance, Obstacles, as_obstacles

FREE = ".GS"
"""Characters of cells that robots may enter: ground and swamp."""
BLOCKED = "@OTW"
"""Characters of obstacles: out of bounds, trees and water."""

_STEPS_PER_BUCKET = 4


class _Entry(NamedTuple):
    """One line of a scenario."""

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
    lines = _lines(path)
    _require_line(path, lines, 1, "type octile")
    height, width = _size(path, lines, 2, "height"), _size(path, lines, 3, "width")
    _require_line(path, lines, 4, "map")
    rows = lines[4:]
    if len(rows) < height:
        raise ValueError(
            f"{path}, line {len(lines)}: the map ends after {len(rows)} rows, but line 2 says height {height}; "
            "restore the missing rows or correct the height"
        )
    if len(rows) > height:
        raise ValueError(
            f"{path}, line {5 + height}: more than the {height} rows that line 2 promises; "
            "remove the surplus or correct the height"
        )
    for number, row in enumerate(rows, start=5):
        unknown = re.search(f"[^{FREE}{BLOCKED}]", row)
        if unknown:
            raise ValueError(
                f"{path}, line {number}, column {unknown.start() + 1}: unknown character {unknown.group()!r}; "
                f"free cells are {' '.join(FREE)} and obstacles {' '.join(BLOCKED)}"
            )
        if len(row) != width:
            raise ValueError(
                f"{path}, line {number}: the row has {len(row)} cells, but line 3 says width {width}; "
                "restore the row or correct the width"
            )
    cells = np.frombuffer("".join(rows).encode("ascii"), dtype=np.uint8).reshape(height, width)
    return np.isin(cells, np.frombuffer(BLOCKED.encode("ascii"), dtype=np.uint8))


def load_scen(path: PathLike, num_agents: int | None = None, map_path: PathLike | None = None) -> Instance:
    """Read the first `num_agents` entries of a `.scen` file, or all of them, as an instance: entry i is agent i.

    The map is looked for beside the scenario, by the name given there, unless `map_path` says where it is.

    Raises:
        ValueError: If a file is damaged, has fewer entries than agents asked for, or its entries are no valid instance
            together; the message names the file and the line.
        OSError: If a file cannot be read.
    """
    lines = _lines(path)
    if not lines or not re.fullmatch(r"version\s+1(\.0)?", lines[0].strip()):
        raise ValueError(f"{path}, line 1: expected 'version 1', got {_shown(lines, 1)}; is this a MovingAI scenario?")
    available = len(lines) - 1
    count = available if num_agents is None else arguments.integer(num_agents, "num_agents", 1)
    if count < 1:
        raise ValueError(f"{path}, line 1: no entries follow; give another file")
    if count > available:
        raise ValueError(
            f"{path}, line {len(lines)}: {count} agents asked for, but only {available} entries; ask for fewer"
        )
    entries = [_entry(path, number, line) for number, line in enumerate(lines[1 : count + 1], start=2)]
    for number, entry in enumerate(entries, start=2):
        if entry.map_name != entries[0].map_name:
            raise ValueError(
                f"{path}, line {number}: the map is {entry.map_name!r}, but line 2 says {entries[0].map_name!r}; "
                "all agents of an instance share one map"
            )
    chosen_map = _beside(path, entries[0].map_name) if map_path is None else as_path(map_path, "map_path")
    grid = load_map(chosen_map)
    for number, entry in enumerate(entries, start=2):
        if entry.size != grid.shape:
            raise ValueError(
                f"{path}, line {number}: the scenario's map has height {entry.size[0]} and width {entry.size[1]}, "
                f"but {chosen_map} has height {grid.shape[0]} and width {grid.shape[1]}; give the scenario's own map"
            )
    try:
        return Instance(grid, [entry.start for entry in entries], [entry.goal for entry in entries])
    except ValueError as error:
        raise ValueError(f"{path} with {chosen_map}: {error} (agent i is on line i + 2 of the scenario)") from error


def save_map(path: PathLike, grid: npt.ArrayLike) -> None:
    """Write the grid (H, W) as a `.map` file, free cells as '.', obstacles as '@'.

    Raises:
        ValueError: If the grid is no map.
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
        ValueError: If the file at `map_path` holds another map than the instance's, or its name fits no scenario.
        OSError: If the map cannot be read or the scenario not written; an existing one is then unchanged.
    """
    arguments.instance_of(instance, Instance, "instance")
    if not as_path(map_path, "map_path").is_file():
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


def _lines(path: PathLike) -> list[str]:
    """The lines of a text file without their ends, and without blank lines at the file's end."""
    lines = as_path(path).read_text(encoding="utf-8-sig", errors="replace").split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    return lines


def _shown(lines: list[str], number: int) -> str:
    """Line `number` as an error message shows it."""
    return repr(lines[number - 1][:40]) if number <= len(lines) else "the end of the file"


def _require_line(path: PathLike, lines: list[str], number: int, expected: str) -> None:
    if number > len(lines) or lines[number - 1].split() != expected.split():
        raise ValueError(
            f"{path}, line {number}: expected {expected!r}, got {_shown(lines, number)}; is this a MovingAI map?"
        )


def _size(path: PathLike, lines: list[str], number: int, name: str) -> int:
    fields = lines[number - 1].split() if number <= len(lines) else []
    if len(fields) != 2 or fields[0] != name or not _is_number(fields[1]) or int(fields[1]) == 0:
        raise ValueError(
            f"{path}, line {number}: expected '{name}' and a positive whole number, got {_shown(lines, number)}; "
            "correct the header"
        )
    return int(fields[1])


def _is_number(text: str) -> bool:
    return re.fullmatch("[0-9]{1,9}", text) is not None


def _entry(path: PathLike, number: int, line: str) -> _Entry:
    fields = line.split("\t") if "\t" in line else line.split()
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
    return _Entry(map_name, (height, width), (start_y, start_x), (goal_y, goal_x))


def _is_length(text: str) -> bool:
    try:
        value = float(text)
    except ValueError:
        return False
    return math.isfinite(value) and value >= 0


def _beside(path: PathLike, map_name: str) -> Path:
    """The map that a scenario names: by its path from there, or, as MovingAI's own tools do, by its last part alone."""
    parts = PurePosixPath(map_name.replace("\\", "/"))
    folder = Path(path).parent
    for candidate in (folder / map_name, folder / parts, folder / parts.name):
        if os.path.isfile(candidate):  # False for what can be no file's name too
            return candidate
    raise FileNotFoundError(
        f"{path}, line 2 names the map {map_name!r}, which is not beside it: put it there or give map_path"
    )
