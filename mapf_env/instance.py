"""The problem: robots with starts and goals on one grid."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments

Cells = npt.NDArray[np.int32]
Obstacles = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False, slots=True, weakref_slot=True)
class SharedMap:
    """The read-only arrays that all instances on one map share; made by `SharedMap.of`."""

    grid: Obstacles
    """(H, W)"""
    regions: npt.NDArray[np.int32]
    """(H, W) numbers the connected regions."""

    @staticmethod
    def of(grid: npt.ArrayLike) -> SharedMap:
        """Return the shared map with these obstacles, the same object as long as it is referenced.

        Raises:
            ValueError: If `grid` is not a map.
            TypeError: If it has the wrong dtype.
        """
        obstacles = as_obstacles(grid)
        return SharedMap.known((obstacles.shape, blake2b(obstacles.data).digest()), lambda: _shared(obstacles))

    @staticmethod
    def known(key: Hashable, make: Callable[[], SharedMap]) -> SharedMap:
        """Return the map stored under `key`, a collision-free name of its content, or store a new one."""
        found = _KNOWN.get(key)
        if found is None:
            _KNOWN[key] = found = make()
        return found


_KNOWN: WeakValueDictionary[Hashable, SharedMap] = WeakValueDictionary()


def _shared(obstacles: Obstacles) -> SharedMap:
    regions = _native.regions(obstacles)
    obstacles.flags.writeable = regions.flags.writeable = False
    return SharedMap(obstacles, regions)


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Instance:
    """A multi-agent path finding problem that is known to be well formed.

    Every start and goal is a free cell of the map, no two robots share a start or a goal, and each goal can be reached
    from its start. A robot may start on its own goal. The arrays are read-only copies, and instances on
    equal maps share that of the map.

    Args:
        grid: (H, W) bool, True is an obstacle. Integers 0 and 1 are accepted.
        starts: (N, 2) integers, the row and column of each robot.
        goals: (N, 2) integers, the row and column of each robot's goal.

    Raises:
        ValueError: If the problem is ill formed; the message names the robot, the cell and the rule.
        TypeError: If an array has the wrong dtype.
    """

    grid: Obstacles
    starts: Cells
    goals: Cells
    shared_map: SharedMap = field(init=False)
    """The map and the arrays that depend on it alone."""

    def __init__(self, grid: npt.ArrayLike | SharedMap, starts: npt.ArrayLike, goals: npt.ArrayLike) -> None:
        shared = grid if isinstance(grid, SharedMap) else SharedMap.of(grid)
        self._set(shared, _team(starts, "starts"), _team(goals, "goals"))

    def _set(self, shared: SharedMap, starts: Cells, goals: Cells) -> None:
        grid, regions = shared.grid, shared.regions
        if starts.shape != goals.shape:
            raise ValueError(f"{len(starts)} starts but {len(goals)} goals: give one goal for each robot")
        _require_free(grid, starts, "start")
        _require_free(grid, goals, "goal")
        _require_distinct(starts, "start")
        _require_distinct(goals, "goal")
        cut_off = np.flatnonzero(regions[tuple(starts.T)] != regions[tuple(goals.T)])
        if len(cut_off):
            robot = cut_off[0]
            raise ValueError(
                f"agent {robot} cannot reach its goal {_cell(goals[robot])} from {_cell(starts[robot])}: "
                "obstacles separate them; move one of the two or open the map"
            )
        starts.flags.writeable = goals.flags.writeable = False
        for name, value in (("grid", grid), ("starts", starts), ("goals", goals), ("shared_map", shared)):
            object.__setattr__(self, name, value)

    @property
    def num_agents(self) -> int:
        """The number of robots N."""
        return len(self.starts)

    def at(self, positions: npt.ArrayLike) -> Instance:
        """Return the same problem from another state: robots start at `positions` (N, 2), goals are unchanged.

        Raises:
            ValueError: If the positions are not distinct free cells from which the goals can be reached.
        """
        seen_from_here = object.__new__(Instance)
        seen_from_here._set(self.shared_map, _team(positions, "positions"), self.goals)
        return seen_from_here

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Instance):
            return NotImplemented
        return (
            np.array_equal(self.grid, other.grid)
            and np.array_equal(self.starts, other.starts)
            and np.array_equal(self.goals, other.goals)
        )

    def __hash__(self) -> int:
        return hash((self.grid.shape, self.grid.tobytes(), self.starts.tobytes(), self.goals.tobytes()))

    def __repr__(self) -> str:
        height, width = self.grid.shape
        return f"Instance({height}x{width}, {int(self.grid.sum())} obstacles, {self.num_agents} agents)"

    def __reduce__(self) -> tuple[Any, ...]:
        return Instance, (self.grid, self.starts, self.goals)


def as_obstacles(grid: npt.ArrayLike) -> Obstacles:
    """Return a contiguous copy of `grid` as (H, W) bool; raises TypeError or ValueError if it is not a map."""
    return as_bool(arguments.shaped(grid, "grid", "(H, W)", " with at least one cell", filled=True), "grid")


def as_bool(array: npt.NDArray[Any], name: str) -> Obstacles:
    """Return a contiguous copy of maps as bool; raises TypeError or ValueError if a cell is neither 0 nor 1."""
    if array.dtype != np.bool_:
        if array.dtype.kind not in "iu":
            raise TypeError(f"{name} must be bool (True is an obstacle) or integers 0 and 1, got dtype {array.dtype}")
        if array.size and (array.min() < 0 or array.max() > 1):
            raise ValueError(
                f"{name} must hold 0 (free) and 1 (obstacle) only, got values {array.min()}..{array.max()}"
            )
    return np.array(array, dtype=np.bool_, order="C")


def _team(cells: npt.ArrayLike, name: str) -> Cells:
    return arguments.cells(cells, name, "(N, 2)", ": a row and a column for each of N >= 1 agents", filled=True)


def _require_free(grid: Obstacles, cells: Cells, name: str) -> None:
    height, width = grid.shape
    outside = np.flatnonzero(((cells < 0) | (cells >= (height, width))).any(axis=1))
    if len(outside):
        robot = outside[0]
        raise ValueError(f"the {name} {_cell(cells[robot])} of agent {robot} lies outside the {height}x{width} map")
    blocked = np.flatnonzero(grid[tuple(cells.T)])
    if len(blocked):
        robot = blocked[0]
        raise ValueError(f"the {name} {_cell(cells[robot])} of agent {robot} lies on an obstacle; choose a free cell")


def _require_distinct(cells: Cells, name: str) -> None:
    flat = cells[:, 0].astype(np.int64) << 32 | cells[:, 1]
    order = np.argsort(flat, kind="stable")
    twins = np.flatnonzero(flat[order[1:]] == flat[order[:-1]])
    if len(twins):
        first, second = order[twins[0]], order[twins[0] + 1]
        raise ValueError(
            f"agents {first} and {second} share the {name} {_cell(cells[first])}; every agent needs a {name} of its own"
        )


def _cell(cell: Cells) -> str:
    return f"({cell[0]}, {cell[1]})"
