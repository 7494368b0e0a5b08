"""Path files: a line for each robot, as other MAPF tools write them.

`Agent 0: (4,7)->(4,8)->(5,8)->` is robot 0 at times 0, 1 and 2, in (row, column). A robot stays where its line ends.
"""

from __future__ import annotations

import re

import numpy as np

from mapf_env import arguments
from mapf_env.files import PathLike, as_path, write_whole
from mapf_env.solution import Solution

_LINE = re.compile(r"Agent (\d{1,9}):((?:\s*\(\d{1,9},\d{1,9}\)(?:->)?)+)\s*")
_CELL = re.compile(r"\((\d+),(\d+)\)")


def save_paths(path: PathLike, solution: Solution) -> None:
    """Write the solution's paths, each up to the robot's arrival.

    Raises:
        TypeError: If an argument has the wrong type.
        OSError: If the file cannot be written; an existing one is then unchanged.
    """
    arguments.instance_of(solution, Solution, "solution")
    lines = []
    for agent, arrival in enumerate(solution.arrivals):
        cells = solution.paths[: arrival + 1, agent].tolist()
        lines.append(f"Agent {agent}: " + "".join(f"({row},{col})->" for row, col in cells))
    write_whole(path, "\n".join([*lines, ""]))


def load_paths(path: PathLike) -> Solution:
    """Read a path file. Whether the paths solve anything, `Solution.violations(instance)` tells.

    Raises:
        ValueError: If a line is damaged or a robot is missing; the message names the file and the line.
        OSError: If the file cannot be read.
    """
    lines = as_path(path).read_text(encoding="utf-8-sig", errors="replace").splitlines()
    tracks: list[list[tuple[int, int]]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise ValueError(f"{path}, line {number}: expected 'Agent 0: (row,col)->(row,col)->', got {line[:40]!r}")
        if int(match[1]) != len(tracks):
            raise ValueError(f"{path}, line {number}: expected agent {len(tracks)}, got {match[1]}; keep their order")
        tracks.append([(int(row), int(col)) for row, col in _CELL.findall(match[2])])
    if not tracks:
        raise ValueError(f"{path}: the file holds no paths")
    steps = max(map(len, tracks))
    padded = [track + track[-1:] * (steps - len(track)) for track in tracks]
    return Solution(np.array(padded, dtype=np.int32).transpose(1, 0, 2))
