"""Cases for training, validation and test: random families of maps and teams, or files.

The splits share no random map. Warehouses and empty maps follow from their sizes, so the splits can share those, but
not their starts and goals.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from gnn_policy.settings import check_types
from mapf_env import Instance, Maze, Rooms, Walls, Warehouse, random_maps, random_starts_and_goals
from mapf_env.arguments import lists_settings
from mapf_env.generation import MapStyle, Style
from mapf_env.hashing import mix
from mapf_env.problem_file import load_problems

Split = Literal["train", "validation", "test"]
Task = Literal["one_shot", "lifelong"]
Seeds = npt.NDArray[np.uint64]
Range = tuple[int, int]
Span = tuple[float, float]


@lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """Random cases of one kind. A range (least, most) is drawn from uniformly, for each map or, for robots, each case.

    Raises:
        ValueError: If a range is empty or out of its bounds.
        TypeError: If a setting has the wrong type.
    """

    style: MapStyle = "cells"
    """Obstacles: independent "cells", short "walls" as the authors' generator makes them, or "maze", "room",
    "warehouse" and "empty"."""
    share: float = 1.0
    """Share of the maps, relative to the other families' shares."""
    task: Task = "one_shot"
    """"lifelong": a robot that arrives gets a new goal."""
    height: Range = (20, 20)
    """Rows of a map."""
    width: Range = (20, 20)
    """Columns of a map."""
    num_agents: Range = (10, 10)
    """Robots in a team; fewer where they would fill more than half of a map's free cells, but never less than the
    least."""
    density: Span = (0.1, 0.1)
    """Share of obstacles, for the styles "cells" and "walls"."""
    corridor_width: Range = (1, 1)
    """Cells across a corridor, for the styles "maze" and "warehouse"."""
    loops: Span = (0.1, 0.1)
    """Share of the extra walls of a maze that are removed; 0 leaves one path between any two cells."""
    room_size: Range = (5, 5)
    """Rows and columns of a room."""
    shelf_length: Range = (10, 10)
    """Columns of a shelf of a warehouse."""
    shelf_depth: Range = (2, 2)
    """Rows of a shelf of a warehouse."""
    segments: Range = (2, 2)
    """Steps of two cells that a wall grows, for the style "walls"."""
    straight: Span = (0.0, 0.0)
    """Share of a wall's steps that keep the direction of the step before."""
    ring: bool = False
    """Keep the border of a map of walls free. Segments of 4, straight 0.5 and a ring on maps of odd sizes resemble
    POGEMA's mazes."""

    def __post_init__(self) -> None:
        check_types(self)
        for name in (
            "height",
            "width",
            "num_agents",
            "corridor_width",
            "room_size",
            "shelf_length",
            "shelf_depth",
            "segments",
        ):
            self._check_range(name, 1, np.inf)
        for name in ("density", "loops", "straight"):
            self._check_range(name, 0.0, 1.0)
        if not 0 < self.share < np.inf:
            raise ValueError(f"share must be positive and finite, got {self.share}")

    def _check_range(self, name: str, least: float, most: float) -> None:
        given = getattr(self, name)
        if len(given) != 2 or not least <= given[0] <= given[1] <= most:
            raise ValueError(f"{name} must be two numbers, the least and the most, within {least}..{most}; got {given}")

    def draw(self, seed: int) -> tuple[int, int, float, Style]:
        """Return the height, width, density and style of the map of a seed."""
        rng = np.random.default_rng(seed)
        height, width, corridor_width, room_size, shelf_length, shelf_depth = (
            int(rng.integers(least, most + 1))
            for least, most in (
                self.height,
                self.width,
                self.corridor_width,
                self.room_size,
                self.shelf_length,
                self.shelf_depth,
            )
        )
        density, loops, straight = (float(rng.uniform(*span)) for span in (self.density, self.loops, self.straight))
        segments = int(rng.integers(self.segments[0], self.segments[1] + 1))
        if self.style == "maze":
            return height, width, 0.0, Maze(corridor_width=corridor_width, loops=loops)
        if self.style == "room":
            return height, width, 0.0, Rooms(room_size=room_size)
        if self.style == "warehouse":
            parts = Warehouse(shelf_length=shelf_length, shelf_depth=shelf_depth, corridor_width=corridor_width)
            return height, width, 0.0, parts
        if self.style == "walls":
            return height, width, density, Walls(segments=segments, straight=straight, ring=self.ring)
        return height, width, density if self.style == "cells" else 0.0, self.style


@dataclass(frozen=True, slots=True, eq=False)
class Cases:
    """The C cases of a split, on its K maps."""

    instances: list[Instance]
    grids: list[npt.NDArray[np.bool_]]
    """The K maps."""
    map_of: npt.NDArray[np.int32]
    """(C,) the map of each case."""
    family_of: npt.NDArray[np.int32]
    """(C,) the family of each case."""
    lifelong: npt.NDArray[np.bool_]
    """(C,) cases in which a robot that arrives gets a new goal."""

    def __len__(self) -> int:
        return len(self.instances)

    def by_task(self) -> dict[Task, Cases]:
        """Return the cases of each task that occurs, on the same maps."""
        chosen = {task: np.flatnonzero(self.lifelong == (task == "lifelong")) for task in get_args(Task)}
        return {task: self._take(numbers) for task, numbers in chosen.items() if len(numbers)}

    def _take(self, numbers: npt.NDArray[np.intp]) -> Cases:
        instances = [self.instances[number] for number in numbers]
        return Cases(instances, self.grids, self.map_of[numbers], self.family_of[numbers], self.lifelong[numbers])


def make_cases(split: Split, *, seed: int, maps: int, cases_per_map: int, families: Sequence[Family]) -> Cases:
    """Return the cases of a split, `cases_per_map` on each of its maps, map after map.

    The families take turns according to their shares. The maps depend only on the seed, the split and the families'
    map settings: teams of every size meet the same maps.

    Raises:
        ValueError: If there would be no case, or the maps have no room for the robots.
    """
    if not families:
        raise ValueError(f"the {split} split needs at least one family of cases, got none")
    if maps < 1 or cases_per_map < 1:
        raise ValueError(
            f"the {split} split needs at least one map and one case per map, got {maps} and {cases_per_map}"
        )
    stream = mix(np.array([seed], np.uint64), np.array([get_args(Split).index(split)], np.uint64))
    map_seeds = mix(np.repeat(stream, maps), np.arange(maps, dtype=np.uint64))
    family_of = _turns(np.array([each.share for each in families]), maps)
    grids = _draw_maps([families[f] for f in family_of], map_seeds)
    map_of = np.repeat(np.arange(maps, dtype=np.int32), cases_per_map)
    numbers = np.tile(np.arange(cases_per_map, dtype=np.uint64), maps)
    case_seeds = mix(np.repeat(map_seeds, cases_per_map), numbers)
    robots = [_robots(families[family_of[m]], grids[m], int(s)) for m, s in zip(map_of, case_seeds, strict=True)]
    lifelong = np.array([family.task == "lifelong" for family in families])[family_of[map_of]]
    return Cases(_place(grids, map_of, robots, case_seeds), grids, map_of, family_of[map_of], lifelong)


def _turns(shares: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.int32]:
    """Return the family (count,) of each map: always the one that is furthest behind its share."""
    shares = shares / shares.sum()
    given = np.zeros(len(shares))
    turns = np.empty(count, np.int32)
    for number in range(count):
        turns[number] = np.argmax(shares * (number + 1) - given)
        given[turns[number]] += 1
    return turns


def _draw_maps(families: Sequence[Family], seeds: Seeds) -> list[npt.NDArray[np.bool_]]:
    alike: dict[Hashable, list[int]] = defaultdict(list)
    for number, (family, seed) in enumerate(zip(families, seeds, strict=True)):
        alike[family.draw(int(seed))].append(number)
    grids: list[npt.NDArray[np.bool_] | None] = [None] * len(families)
    for (height, width, density, style), numbers in alike.items():  # pyright: ignore[reportGeneralTypeIssues]
        drawn = random_maps(seeds[numbers], height=height, width=width, density=density, style=style)
        for number, grid in zip(numbers, drawn, strict=True):
            grids[number] = grid
    return [grid for grid in grids if grid is not None]


def _robots(family: Family, grid: npt.NDArray[np.bool_], seed: int) -> int:
    least, most = family.num_agents
    wanted = int(np.random.default_rng(seed).integers(least, most + 1)) if least < most else least
    return max(min(wanted, int((~grid).sum()) // 2), least)


def _place(
    grids: Sequence[npt.NDArray[np.bool_]], map_of: npt.NDArray[np.int32], robots: Sequence[int], seeds: Seeds
) -> list[Instance]:
    alike: dict[Hashable, list[int]] = defaultdict(list)
    for number, (own_map, count) in enumerate(zip(map_of, robots, strict=True)):
        alike[grids[own_map].shape, count].append(number)
    instances: list[Instance | None] = [None] * len(robots)
    for (_, count), numbers in alike.items():  # pyright: ignore[reportGeneralTypeIssues]
        maps = np.stack([grids[own_map] for own_map in map_of[numbers]])
        starts, goals = random_starts_and_goals(seeds[numbers], maps, count)
        for row, number in enumerate(numbers):
            instances[number] = Instance(grids[map_of[number]], starts[row], goals[row])
    return [each for each in instances if each is not None]


def cases_of_files(
    split: Split,
    files: Sequence[str],
    *,
    seed: int,
    cases_per_map: int,
    num_agents: int,
    task: Task = "one_shot",
    whole: bool = False,
) -> Cases:
    """Return the cases of a split of the user's own maps, scenarios and sets of instances.

    If there are at least three maps, one in ten of them, but at least one, is kept for each of validation and test.
    Otherwise the splits share the maps: on a map without instances each split draws its own starts and goals; of given
    instances one in ten goes to each of validation and test. With `whole` nothing is kept apart.

    Raises:
        ValueError: If a file is damaged, or the files leave a split without a case.
        OSError: If a file cannot be read.
    """
    maps: dict[Hashable, _OwnMap] = {}
    for file in files:
        for grid, instances in load_problems(file):
            found = maps.setdefault((grid.shape, grid.tobytes()), _OwnMap(grid, []))
            found.instances.extend(instances)
    number = get_args(Split).index(split)
    grids = [found.grid for found in maps.values()]
    by_map = len(maps) >= 3 and not whole
    mine = [k for k in range(len(maps)) if not by_map or _turn(k, len(maps)) == number]
    instances, map_of = [], []
    for k in mine:
        given = list(maps.values())[k].instances
        if given and not by_map and not whole:
            given = [each for i, each in enumerate(given) if _turn(i, len(given)) == number]
        elif not given:
            stream = mix(np.array([seed], np.uint64), np.array([3 * k + number], np.uint64))
            seeds = mix(np.repeat(stream, cases_per_map), np.arange(cases_per_map, dtype=np.uint64))
            given = _place(grids, np.full(cases_per_map, k, np.int32), [num_agents] * cases_per_map, seeds)
        instances += given
        map_of += [k] * len(given)
    if not instances:
        raise ValueError(
            f"{', '.join(files)} leave no case for the {split} split: give more instances, or maps (.map), on which "
            "starts and goals are drawn"
        )
    lifelong = np.full(len(instances), task == "lifelong")
    return Cases(instances, grids, np.array(map_of, np.int32), np.zeros(len(instances), np.int32), lifelong)


@dataclass(frozen=True, slots=True, eq=False)
class _OwnMap:
    """A map and the instances that files give for it."""

    grid: npt.NDArray[np.bool_]
    instances: list[Instance]


def _turn(number: int, count: int) -> int:
    """Return the split of one of `count` things: the last tenth is for test, the tenth before for validation."""
    held_out = max(count // 10, 1)
    return 2 if number >= count - held_out else 1 if number >= count - 2 * held_out else 0
