"""Maps of POGEMA (Skrynnik et al. 2025), and the robots that POGEMA places on them.

POGEMA draws `.` for a free cell and `#` for an obstacle. A letter `a` is the start of a robot, `A` is its goal.
Three more signs mark free cells: robots start on `@` or `.`, goals lie on `$` or `.`, and `!` is neither. Note the
difference from `parse_map` and MovingAI's files, where `@` is an obstacle.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments
from mapf_env.files import PathLike, as_path, read_text
from mapf_env.instance import Cells, Instance, Obstacles

_HEADER = re.compile(r"""(?:"([^"\\]{1,200})"|'([^']{1,200})'|([\w./+-][\w ./+-]{0,199}?))\s*:\s*\|[-+]?\s*""")
"""The line of a YAML file that begins a map: a name, a colon and the sign for a block of text."""

_Row = tuple[int, str]
"""The number of a line and what it draws."""


@dataclass(frozen=True, slots=True, eq=False)
class PogemaMap:
    """A map with the cells on which POGEMA places robots; made by `parse_pogema_map` and `load_pogema_maps`."""

    grid: Obstacles
    """(H, W) True is an obstacle."""
    start_cells: Obstacles
    """(H, W) True where robots may start."""
    goal_cells: Obstacles
    """(H, W) True where goals may lie."""
    starts: Cells
    """(N, 2) the starts that are drawn as letters, in the order of the letters; N = 0 if there are none."""
    goals: Cells
    """(N, 2) the goals of these robots."""

    @property
    def marked(self) -> bool:
        """True if starts and goals lie on marked cells only."""
        return not np.array_equal(self.start_cells & self.goal_cells, ~self.grid)

    def drawn_instance(self) -> Instance:
        """Return the instance of the robots that are drawn as letters.

        Raises:
            ValueError: If there are none, or a goal cannot be reached from its start.
        """
        if not len(self.starts):
            raise ValueError("no robots are drawn on this map: place some with `instance(num_agents, seed)`")
        return Instance(self.grid, self.starts, self.goals)

    def instance(self, num_agents: int, seed: int) -> Instance:
        """Place robots exactly as POGEMA 1.4 does for this number of agents and seed.

        On a marked map, starts and goals are the first cells of two shuffled lists. On other maps all free cells are
        shuffled; in each connected region every other cell of that list is a start, and the next one its goal.

        Raises:
            ValueError: If the map has too few cells, or obstacles separate a robot from its goal.
        """
        count = arguments.integer(num_agents, "num_agents", 1, arguments.MOST_INT)
        rng = np.random.default_rng(arguments.seed(seed))
        if self.marked:
            starts, goals = _shuffled(rng, self.start_cells), _shuffled(rng, self.goal_cells)
        else:
            starts, goals = _pairs(_shuffled(rng, ~self.grid), _native.regions(self.grid))
        room = min(len(starts), len(goals))
        if room < count:
            raise ValueError(f"POGEMA places at most {room} robots on this map: {count} are too many")
        return Instance(self.grid, starts[:count], goals[:count])

    def goal_sequences(self, num_agents: int, seed: int, length: int) -> Cells:
        """Return the goals (N, length, 2) that POGEMA 1.4 gives each robot of `instance` in turn in lifelong play.

        Each robot draws from its own stream: uniformly from the marked goal cells, on other maps from all cells of its
        region, and again while the draw is the goal that it has just reached. Robots may share a goal.

        Raises:
            ValueError: If an instance is impossible, or a robot has only one cell to go to.
        """
        instance = self.instance(num_agents, seed)
        steps = arguments.integer(length, "length", 1, arguments.MOST_INT)
        rng = np.random.default_rng(seed)
        streams = rng.integers(np.iinfo(np.int32).max, size=num_agents)
        choices = self._goal_choices(instance, seed)
        sequences = [
            _sequence(np.random.default_rng(stream), cells, goal, steps)
            for stream, cells, goal in zip(streams.tolist(), choices, instance.goals, strict=True)
        ]
        return np.stack(sequences)

    def _goal_choices(self, instance: Instance, seed: int) -> list[Cells]:
        """The cells (M, 2) among which each robot draws its goals, in POGEMA's order."""
        if self.marked:
            rng = np.random.default_rng(seed)
            _shuffled(rng, self.start_cells)
            return [np.array(_shuffled(rng, self.goal_cells), np.int32)] * instance.num_agents
        regions = _native.regions(self.grid)
        cells = {region: np.argwhere(regions == region).astype(np.int32) for region in np.unique(regions).tolist()}
        return [cells[int(regions[tuple(start)])] for start in instance.starts]


def parse_pogema_map(drawing: str) -> PogemaMap:
    """Read one map drawn as text; blank lines, and spaces at the ends of lines, are ignored.

    Raises:
        ValueError: If there are no cells, the rows differ in length, a character is unknown, or letters do not pair.
    """
    return _map_of(_rows(arguments.instance_of(drawing, str, "drawing").splitlines()), "the drawing, ", 1)


def load_pogema_maps(path: PathLike) -> dict[str, PogemaMap]:
    """Read a file of POGEMA's maps: each map under its name, in the order of the file.

    Of YAML the file has what POGEMA's benchmark uses: a name that begins a block of text, and below it the indented
    rows of the map; lines that begin with a hash and a blank are comments. A file without names is one map, which gets
    the name of the file.

    Raises:
        ValueError: If the file is damaged; the message names the file and the line.
        OSError: If the file cannot be read.
    """
    file = as_path(path)
    lines = read_text(file).split("\n")
    if not any(_HEADER.fullmatch(line) for line in lines):
        return {file.stem: _map_of(_rows(lines), f"{path}, ", 1)}
    blocks: dict[str, tuple[int, list[_Row]]] = {}
    rows: list[_Row] | None = None
    for number, line in enumerate(lines, start=1):
        header = _HEADER.fullmatch(line)
        if header:
            name = next(group for group in header.groups() if group is not None)
            if name in blocks:
                raise ValueError(
                    f"{path}, line {number}: line {blocks[name][0]} has a map {name!r} already; rename one of them"
                )
            rows = []
            blocks[name] = number, rows
        elif line.startswith(" ") and line.strip() and rows is not None:
            rows.append((number, line.strip()))
        elif line.strip() and not line.startswith("# "):
            raise ValueError(
                f"{path}, line {number}: expected 'name: |-' or an indented row of a map, got {line[:40]!r}; "
                "correct or remove the line"
            )
    return {name: _map_of(rows, f"{path}, ", number) for name, (number, rows) in blocks.items()}


def _rows(lines: Sequence[str]) -> list[_Row]:
    return [(number, line.strip()) for number, line in enumerate(lines, start=1) if line.strip()]


def _map_of(rows: list[_Row], where: str, first_line: int) -> PogemaMap:
    """The map that the rows draw; messages begin with `where`."""
    if not rows:
        raise ValueError(f"{where}line {first_line}: the map has no cells; draw at least one row")
    width = len(rows[0][1])
    for number, row in rows:
        unknown = re.search(r"[^.#@$!A-Za-z]", row)
        if unknown:
            raise ValueError(
                f"{where}line {number}: unknown character {unknown.group()!r}; "
                "POGEMA draws maps with . # @ $ ! and letters"
            )
        if len(row) != width:
            raise ValueError(
                f"{where}line {number}: the row has {len(row)} cells, that of line {rows[0][0]} has {width}; "
                "make them equal"
            )
    cells = np.frombuffer("".join(row for _, row in rows).encode("ascii"), np.uint8).reshape(len(rows), width)
    letters: dict[str, tuple[int, int]] = {}
    for row, col in np.argwhere(cells >= ord("A")).tolist():
        letter = chr(cells[row, col])
        if letter in letters:
            raise ValueError(
                f"{where}line {rows[row][0]}: the letter {letter} is drawn twice on this map; draw it once"
            )
        letters[letter] = row, col
    alone = sorted(letter for letter in letters if letter.swapcase() not in letters)
    if alone:
        line = rows[letters[alone[0]][0]][0]
        raise ValueError(
            f"{where}line {line}: the letter {alone[0]} needs {alone[0].swapcase()} on the same map: "
            "a is a start and A its goal"
        )
    robots = sorted(letter for letter in letters if letter.islower())
    grid = cells == ord("#")
    return PogemaMap(
        grid,
        _free_but(grid, cells, "$!"),
        _free_but(grid, cells, "@!"),
        np.array([letters[robot] for robot in robots], np.int32).reshape(-1, 2),
        np.array([letters[robot.upper()] for robot in robots], np.int32).reshape(-1, 2),
    )


def _free_but(grid: Obstacles, cells: npt.NDArray[np.uint8], signs: str) -> Obstacles:
    return ~grid & ~np.isin(cells, np.frombuffer(signs.encode("ascii"), np.uint8))


def _shuffled(rng: np.random.Generator, mask: Obstacles) -> list[tuple[int, int]]:
    """The cells of the mask, shuffled from row-major order."""
    order: list[int] = np.flatnonzero(mask).tolist()
    rng.shuffle(order)  # the draws of an array's shuffle are not promised to be those of a list's
    return [divmod(cell, mask.shape[1]) for cell in order]


def _pairs(
    order: list[tuple[int, int]], regions: npt.NDArray[np.int32]
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Starts and goals: the cells of each region in turns, robots in the order of their starts."""
    starts: list[tuple[int, int]] = []
    goals: dict[int, tuple[int, int]] = {}
    waiting: dict[int, int] = {}
    for cell in order:
        region = int(regions[cell])
        robot = waiting.pop(region, None)
        if robot is not None:
            goals[robot] = cell
        else:
            waiting[region] = len(starts)
            starts.append(cell)
    return [starts[robot] for robot in sorted(goals)], [goals[robot] for robot in sorted(goals)]


def _sequence(rng: np.random.Generator, cells: Cells, goal: Cells, length: int) -> Cells:
    """Draws from the cells (M, 2), none of them equal to the one before."""
    if len(cells) < 2:
        raise ValueError("a robot has only one cell for its goals: lifelong play needs two or more")
    kept, last = [], goal
    while len(kept) < length:
        for cell in cells[rng.integers(len(cells), size=length)]:
            if (cell != last).any():
                kept.append(cell)
                last = cell
    return np.stack(kept[:length])
