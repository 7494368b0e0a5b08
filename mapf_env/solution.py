"""Solutions: a path for each robot, their cost, and an audit that finds what is wrong with them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from itertools import chain, islice
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from mapf_env import arguments
from mapf_env.instance import Cells, Instance

T = TypeVar("T")

_CELLS_AT_ONCE = 1 << 20
"""Number of cells that an audit processes at a time, which bounds its memory."""


class Action(IntEnum):
    """The five moves, in the paper's order."""

    UP = 0
    LEFT = 1
    DOWN = 2
    RIGHT = 3
    IDLE = 4


MOVES: npt.NDArray[np.int32] = np.array([(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)], dtype=np.int32)
"""(5, 2) row and column change of each action."""
MOVES.flags.writeable = False


@dataclass(frozen=True, slots=True)
class Conflict:
    """Two robots in one cell at a time (vertex), or exchanging cells during the step that ends then (swap)."""

    kind: Literal["vertex", "swap"]
    time: int
    agents: tuple[int, int]
    cell: tuple[int, int]

    def __str__(self) -> str:
        first, second = self.agents
        return f"{self.kind} conflict of agents {first} and {second} at {self.cell}, time {self.time}"


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Solution:
    """Paths of N robots over T steps.

    Args:
        paths: (T + 1, N, 2) integers, the cell of each robot at times 0..T.

    Raises:
        ValueError: If `paths` has another shape.
        TypeError: If `paths` does not hold integers.
    """

    paths: npt.NDArray[np.int32]

    def __post_init__(self) -> None:
        array = arguments.cells(self.paths, "paths", "(T + 1, N, 2)", filled=True)
        array.flags.writeable = False
        object.__setattr__(self, "paths", array)

    def __reduce__(self) -> tuple[Any, ...]:
        return Solution, (self.paths,)

    @property
    def arrival_times(self) -> npt.NDArray[np.int64]:
        """(N,) the time from which each robot stays on its last cell; a goal that is left again does not count."""
        elsewhere = (self.paths != self.paths[-1]).any(axis=2)
        steps = np.arange(1, len(self.paths) + 1)[:, None]
        return np.where(elsewhere, steps, 0).max(axis=0)

    @property
    def sum_of_costs(self) -> int:
        """The flowtime: the sum of all arrival times."""
        return int(self.arrival_times.sum())

    @property
    def makespan(self) -> int:
        """The time of the last arrival."""
        return int(self.arrival_times.max())

    @property
    def actions(self) -> npt.NDArray[np.int8]:
        """(T, N) the `Action` of each robot in each step.

        Raises:
            ValueError: If a robot jumps, that is, moves by more than one of the five moves.
        """
        steps = np.diff(self.paths, axis=0)
        is_action = (steps[:, :, None, :] == MOVES).all(axis=3)
        jumps = np.argwhere(~is_action.any(axis=2))
        if len(jumps):
            time, robot = jumps[0]
            raise ValueError(
                f"agent {robot} jumps from {_cell(self.paths[time, robot])} to {_cell(self.paths[time + 1, robot])} "
                f"in step {time}"
            )
        return is_action.argmax(axis=2).astype(np.int8)

    def conflicts(self, most: int | None = None) -> list[Conflict]:
        """Return vertex and swap conflicts in the order of time: all of them, or the first `most`.

        Time and memory grow with T N log(T N) and the number of conflicts returned, not with the square of N.
        """
        limit = None if most is None else arguments.integer(most, "most", 0)
        return list(islice(chain.from_iterable(each.listed() for each in self._clashes()), limit))

    def violations(self, instance: Instance, most: int | None = 20) -> list[str]:
        """Return the reasons, in words, why these paths do not solve `instance`; empty if they solve it.

        If there are more than `most` violations, the list holds the first ones and ends with a line that counts the
        rest. None lists all of them.

        Raises:
            ValueError: If `most` is negative.
            TypeError: If `instance` is not an `Instance`.
        """
        limit = None if most is None else arguments.integer(most, "most", 0)
        count, first = 0, list[str]()
        for found in self._faults(instance):
            count += found.number
            first += islice(found.listed(), None if limit is None else limit - len(first))
        return first if len(first) == count else [*first, f"and {count - len(first)} more"]

    def count_violations(self, instance: Instance) -> int:
        """Count the violations that keep these paths from solving `instance`; 0 if they solve it.

        Raises:
            TypeError: If `instance` is not an `Instance`.
        """
        return sum(found.number for found in self._faults(instance))

    def _faults(self, instance: Instance) -> Iterator[_Found[str]]:
        arguments.instance_of(instance, Instance, "instance")
        paths = self.paths
        if paths.shape[1] != instance.num_agents:
            yield _Found(1, lambda: [f"{paths.shape[1]} paths for {instance.num_agents} agents"])
            return
        for cells, expected, verb in ((paths[0], instance.starts, "starts"), (paths[-1], instance.goals, "ends")):
            wrong = np.flatnonzero((cells != expected).any(axis=1))
            yield _Found(len(wrong), partial(_misplaced, wrong, cells, expected, verb))
        for time, part in self._parts(overlap=0):
            outside: npt.NDArray[np.bool_] = np.any((part < 0) | (part >= instance.grid.shape), axis=2)
            inside = np.where(outside[..., None], 0, part)
            wrong = np.argwhere(outside | instance.grid[inside[..., 0], inside[..., 1]])
            yield _Found(len(wrong), partial(_off_the_floor, wrong, part, time))
        for time, part in self._parts(overlap=1):
            wrong = np.argwhere(np.abs(np.diff(part.astype(np.int64), axis=0)).sum(axis=2) > 1)
            yield _Found(len(wrong), partial(_jumps, wrong, time))
        for clash in self._clashes():
            yield _Found(clash.number, partial(map, str, clash.listed()))

    def _clashes(self) -> Iterator[_Found[Conflict]]:
        """Return the conflicts of each time, vertex conflicts first."""
        for first, part in self._parts(overlap=1):
            cells = part.astype(np.int64)
            cells = cells[..., 0] << 32 | cells[..., 1] & 0xFFFFFFFF
            shared, exchanged = _share_a_cell(cells), _may_exchange_cells(cells)
            shared[0] &= first == 0  # else it was the last time of the part before
            for k in np.flatnonzero(shared | exchanged).tolist():
                if shared[k]:
                    yield _clash("vertex", first + k, _in_the_same_cell(cells[k]), part[k])
                if exchanged[k]:
                    yield _clash("swap", first + k, _in_exchange(cells[k - 1], cells[k]), part[k])

    def _parts(self, overlap: int) -> Iterator[tuple[int, Cells]]:
        """Yield the paths in parts of bounded memory, each with its first time; `overlap` times belong to two parts."""
        steps = max(1, _CELLS_AT_ONCE // self.paths.shape[1])
        for first in range(0, max(1, len(self.paths) - overlap), steps):
            yield first, self.paths[first : first + steps + overlap]

    def __repr__(self) -> str:
        steps, robots = self.paths.shape[0] - 1, self.paths.shape[1]
        return f"Solution({robots} agents, {steps} steps, sum of costs {self.sum_of_costs}, makespan {self.makespan})"


class _Found(NamedTuple, Generic[T]):
    """A number of violations, and a call that lists them one by one."""

    number: int
    listed: Callable[[], Iterable[T]]


def _misplaced(robots: npt.NDArray[np.intp], cells: Cells, expected: Cells, verb: str) -> Iterator[str]:
    for robot in robots:
        yield f"agent {robot} {verb} at {_cell(cells[robot])}, not {_cell(expected[robot])}"


def _off_the_floor(wrong: npt.NDArray[np.intp], part: Cells, first: int) -> Iterator[str]:
    for time, robot in wrong:
        yield f"agent {robot} is at {_cell(part[time, robot])} at time {first + time}, which is not a free cell"


def _jumps(wrong: npt.NDArray[np.intp], first: int) -> Iterator[str]:
    for time, robot in wrong:
        yield f"agent {robot} jumps in step {first + time}"


def _share_a_cell(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Mark the times (T,) at which one of the cells (T, N) occurs twice."""
    ordered = np.sort(cells, axis=1)
    return (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)


def _may_exchange_cells(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Mark all times (T,) at which two robots have exchanged cells (T, N), and rarely another one."""
    scattered = cells.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    scattered ^= scattered >> np.uint64(29)
    ways = scattered[1:] + scattered[:-1]  # the same in both directions
    waiting = cells[1:] == cells[:-1]
    ways[waiting] = np.arange(np.count_nonzero(waiting), dtype=np.uint64)  # unlike any other
    return np.concatenate([[False], _share_a_cell(ways.view(np.int64))])


def _in_the_same_cell(now: npt.NDArray[np.int64]) -> dict[int, list[int]]:
    """Map each robot that shares its cell of `now` (N,) to all robots there, ascending."""
    groups = (group.tolist() for group in _groups_of_equals(now))
    return {robot: group for group in groups for robot in group}


def _in_exchange(before: npt.NDArray[np.int64], now: npt.NDArray[np.int64]) -> dict[int, list[int]]:
    """Map each robot to those that went from its cell of `now` (N,) to its cell of `before`, ascending."""
    moved = np.flatnonzero(before != now)
    ways = np.stack([np.minimum(before, now), np.maximum(before, now)], axis=1)[moved]
    kinds = np.unique(ways, axis=0, return_inverse=True)[1].reshape(-1)
    partners: dict[int, list[int]] = {}
    for group in _groups_of_equals(kinds):
        robots = moved[group]
        onward = before[robots] < now[robots]
        one, other = robots[onward].tolist(), robots[~onward].tolist()
        partners |= dict.fromkeys(one, other) | dict.fromkeys(other, one)
    return partners


def _groups_of_equals(values: npt.NDArray[np.integer]) -> list[npt.NDArray[np.intp]]:
    """Find the indices of values that occur more than once, value by value, ascending."""
    order = np.argsort(values, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(values[order])) + 1)
    return [group for group in groups if len(group) > 1]


def _clash(
    kind: Literal["vertex", "swap"], time: int, partners: dict[int, list[int]], cells: Cells
) -> _Found[Conflict]:
    """Return the conflicts of each robot with its partners, each pair once."""

    def listed() -> Iterator[Conflict]:
        for robot in sorted(partners):
            for partner in partners[robot][bisect_right(partners[robot], robot) :]:
                yield Conflict(kind, time, (robot, partner), _cell(cells[robot]))

    return _Found(sum(len(each) - bisect_right(each, robot) for robot, each in partners.items()), listed)


def _cell(cell: npt.NDArray[np.int32]) -> tuple[int, int]:
    return int(cell[0]), int(cell[1])
