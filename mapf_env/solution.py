"""The answer: a path for each robot, its cost, and an audit of what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from mapf_env import arguments
from mapf_env.instance import Instance


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
    def arrivals(self) -> npt.NDArray[np.int64]:
        """(N,) the time from which each robot stays where it ends; a goal that is left again does not count."""
        elsewhere = (self.paths != self.paths[-1]).any(axis=2)
        steps = np.arange(1, len(self.paths) + 1)[:, None]
        return np.where(elsewhere, steps, 0).max(axis=0)

    @property
    def sum_of_costs(self) -> int:
        """The flowtime: the sum of all arrival times."""
        return int(self.arrivals.sum())

    @property
    def makespan(self) -> int:
        """The time of the last arrival."""
        return int(self.arrivals.max())

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

    def conflicts(self) -> list[Conflict]:
        """All vertex and swap conflicts, in the order of time.

        Time and memory grow with T N log(T N) and the number of conflicts, not with the square of N.
        """
        found: list[Conflict] = []
        cells = self.paths.astype(np.int64)
        cells = cells[..., 0] << 32 | cells[..., 1] & 0xFFFFFFFF
        for time, now in enumerate(cells):
            found += [
                Conflict("vertex", time, pair, _cell(self.paths[time, pair[0]])) for pair in _pairs_of_equals(now)
            ]
            if time == 0:
                continue
            before = cells[time - 1]
            moved = np.flatnonzero(before != now)
            ways = np.stack([np.minimum(before, now), np.maximum(before, now)], axis=1)[moved]
            kinds = np.unique(ways, axis=0, return_inverse=True)[1].reshape(-1)
            for i, j in _pairs_of_equals(kinds):
                first, second = int(moved[i]), int(moved[j])
                if before[first] == now[second]:
                    found.append(Conflict("swap", time, (first, second), _cell(self.paths[time, first])))
        return found

    def violations(self, instance: Instance) -> list[str]:
        """All that keeps these paths from solving `instance`, in words; empty if they solve it.

        Raises:
            TypeError: If `instance` is none.
        """
        arguments.instance_of(instance, Instance, "instance")
        if self.paths.shape[1] != instance.num_agents:
            return [f"{self.paths.shape[1]} paths for {instance.num_agents} agents"]
        found = []
        for robot in np.flatnonzero((self.paths[0] != instance.starts).any(axis=1)):
            found.append(f"agent {robot} starts at {_cell(self.paths[0, robot])}, not {_cell(instance.starts[robot])}")
        for robot in np.flatnonzero((self.paths[-1] != instance.goals).any(axis=1)):
            found.append(f"agent {robot} ends at {_cell(self.paths[-1, robot])}, not {_cell(instance.goals[robot])}")
        outside: npt.NDArray[np.bool_] = np.any((self.paths < 0) | (self.paths >= instance.grid.shape), axis=2)
        inside = np.where(outside[..., None], 0, self.paths)
        for time, robot in np.argwhere(outside | instance.grid[inside[..., 0], inside[..., 1]]):
            found.append(f"agent {robot} is at {_cell(self.paths[time, robot])} at time {time}, which is no free cell")
        for time, robot in np.argwhere(np.abs(np.diff(self.paths, axis=0)).sum(axis=2) > 1):
            found.append(f"agent {robot} jumps in step {time}")
        return found + [str(conflict) for conflict in self.conflicts()]

    def __repr__(self) -> str:
        steps, robots = self.paths.shape[0] - 1, self.paths.shape[1]
        return f"Solution({robots} agents, {steps} steps, sum of costs {self.sum_of_costs}, makespan {self.makespan})"


def _pairs_of_equals(values: npt.NDArray[np.integer]) -> list[tuple[int, int]]:
    """All i < j with values[i] == values[j], ascending."""
    order = np.argsort(values, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(values[order])) + 1)
    return sorted(pair for group in groups if len(group) > 1 for pair in combinations(group.tolist(), 2))


def _cell(cell: npt.NDArray[np.int32]) -> tuple[int, int]:
    return int(cell[0]), int(cell[1])
