"""Maps drawn as text, for tests, notebooks and your own maps."""

from __future__ import annotations

import re

import numpy as np

from mapf_env import arguments
from mapf_env.instance import Instance, Obstacles


def parse_map(drawing: str) -> Obstacles:
    """Return the grid (H, W) of a drawing: `#` or `@` is an obstacle, `.` or a letter a free cell.

    Blank lines around the drawing and spaces at the ends of its lines are ignored.

    Raises:
        ValueError: If there are no cells, the lines differ in length, or a cell is another character.
    """
    return np.isin(_characters(drawing), ["#", "@"])


def parse_instance(drawing: str) -> Instance:
    """Return the instance of a drawing.

    `A` to `Z` are robots, `a` to `z` their goals, `#` or `@` obstacles, `.` free cells.
    The goal of a robot without a drawn goal is its start. Robots are numbered in the order of their letters.

    Raises:
        ValueError: If a letter occurs twice, a goal has no robot, or the problem is ill formed.
    """
    cells = _characters(drawing)
    places: dict[str, tuple[int, int]] = {}
    for row, col in np.argwhere(np.char.isalpha(cells)).tolist():
        letter = str(cells[row, col])
        if letter in places:
            raise ValueError(f"the letter {letter} stands at {places[letter]} and at {(row, col)}; draw it once")
        places[letter] = (row, col)
    robots = sorted(letter for letter in places if letter.isupper())
    strays = sorted(letter for letter in places if letter.islower() and letter.upper() not in places)
    if strays:
        raise ValueError(f"the goal {strays[0]} has no robot {strays[0].upper()}; draw one")
    starts = [places[robot] for robot in robots]
    goals = [places.get(robot.lower(), places[robot]) for robot in robots]
    return Instance(parse_map(drawing), np.reshape(starts, (-1, 2)).astype(int), np.reshape(goals, (-1, 2)).astype(int))


def _characters(drawing: str) -> np.ndarray[tuple[int, int], np.dtype[np.str_]]:
    lines = [line.strip() for line in arguments.instance_of(drawing, str, "drawing").strip().splitlines()]
    if not lines:
        raise ValueError("the drawing has no cells; draw at least one line")
    for number, line in enumerate(lines, start=1):
        if len(line) != len(lines[0]):
            raise ValueError(f"line {number} has {len(line)} cells, line 1 has {len(lines[0])}; make them equal")
        unknown = re.search("[^#@.A-Za-z]", line)
        if unknown:
            raise ValueError(f"line {number}: unknown character {unknown.group()!r}; draw # @ . and letters")
    return np.array([list(line) for line in lines])
