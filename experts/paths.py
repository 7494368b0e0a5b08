"""Path files: a line for each robot, as other MAPF tools write them.

`Agent 0: (4,7)->(4,8)->(5,8)->` is robot 0 at times 0, 1 and 2, in (row, column). A robot stays where its line ends.
Logs of LaCAM are read too: after `solution=`, the line `2:(7,4),(1,0),` has the cells of all robots at time 2, in
(column, row).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from mapf_env import arguments
from mapf_env.files import PathLike, read_text, write_whole
from mapf_env.instance import Cells
from mapf_env.solution import Solution

_AGENT = re.compile(r"agent\s*([0-9]{1,9})\s*:", re.IGNORECASE)
_TIME = re.compile(r"([0-9]{1,9})\s*:")
_CELL = re.compile(r"\(\s*([0-9]{1,9})\s*,\s*([0-9]{1,9})\s*\)\s*(?:->|,)?\s*")
_MOST_CELLS = 1 << 27
"""Limit on the size of a table of paths, 1 GiB: a few long paths among many short ones could fill the memory."""


def save_paths(path: PathLike, solution: Solution) -> None:
    """Write the solution's paths, each up to the robot's arrival.

    Raises:
        TypeError: If an argument has the wrong type.
        OSError: If the file cannot be written; an existing one is then unchanged.
    """
    arguments.instance_of(solution, Solution, "solution")
    lines = []
    for agent, arrival in enumerate(solution.arrival_times):
        cells = solution.paths[: arrival + 1, agent].tolist()
        lines.append(f"Agent {agent}: " + "".join(f"({row},{col})->" for row, col in cells))
    write_whole(path, "\n".join([*lines, ""]))


def load_paths(path: PathLike) -> Solution:
    """Read a path file, or a log of LaCAM. `Solution.violations(instance)` checks if the paths solve an instance.

    Raises:
        ValueError: If a line is damaged, a robot is missing, or a table of all cells would be too large; the message
            names the file and the line.
        OSError: If the file cannot be read.
    """
    numbered = ((number, line.strip()) for number, line in enumerate(read_text(path).split("\n"), start=1))
    lines = [(number, line) for number, line in numbered if line]
    heading = next((k for k, (_, line) in enumerate(lines) if line.replace(" ", "") == "solution="), None)
    if heading is None:
        rows = _rows(path, lines, _AGENT, "agent", "Agent 0: (row,col)->(row,col)->")
    else:
        rows = _rows(path, lines[heading + 1 :], _TIME, "time", "0:(x,y),(x,y),")
    if not rows:
        raise ValueError(f"{path}: the file holds no paths")
    longest, number = max(map(len, rows)), len(rows)
    if longest * number > _MOST_CELLS:
        raise ValueError(
            f"{path}: {number} lines of up to {longest} cells make a table of {longest * number} cells, more than "
            f"{_MOST_CELLS}: leave out robots, or steps in which all wait"
        )
    if heading is None:
        table = np.empty((longest, number, 2), np.int32)
        for agent, cells in enumerate(rows):
            table[: len(cells), agent], table[len(cells) :, agent] = cells, cells[-1]
        return Solution(table)
    for (line, _), cells in zip(lines[heading + 1 :], rows, strict=True):
        if len(cells) != len(rows[0]):
            raise ValueError(
                f"{path}, line {line}: {len(cells)} cells, but time 0 has {len(rows[0])}; restore the line"
            )
    return Solution(np.stack(rows)[..., ::-1])  # which LaCAM writes as column and row


def _rows(
    path: PathLike, lines: Sequence[tuple[int, str]], beginning: re.Pattern[str], name: str, expected: str
) -> list[Cells]:
    """Return the cells (T, 2) of each line; the lines must be numbered from 0."""
    rows: list[Cells] = []
    for number, line in lines:
        match = beginning.match(line)
        rest = "" if match is None else line[match.end() :]
        cells = _CELL.findall(rest)
        if not cells or _CELL.sub("", rest).strip():
            raise ValueError(f"{path}, line {number}: expected {expected!r}, got {line[:40]!r}; correct the line")
        if match is not None and int(match[1]) != len(rows):
            raise ValueError(f"{path}, line {number}: expected {name} {len(rows)}, got {match[1]}; keep their order")
        rows.append(np.array(cells, np.int32))
    return rows
