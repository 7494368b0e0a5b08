"""Observations of robots in given states: teams and maps of any sizes, as one bag."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments
from mapf_env.instance import Instance, as_obstacles
from mapf_env.senses import HISTORY, Senses, require_bytes

Integers = npt.NDArray[np.integer]


class Bag(NamedTuple):
    """Observations of M robots of any number of teams, in the conventions of PyTorch Geometric.

    `perceive` and `BatchedEnv.bag` fill it with NumPy arrays; a network gets the same fields as tensors.
    """

    fov: Any
    """(M, C, S, S) fields of view, float32 or uint8."""
    scalars: Any
    """(M, K) float32, features of each robot, as `Senses.robot_features` names them."""
    edge_index: Any
    """(2, E) int64, the sender and the receiver of each edge, as numbers of robots of the bag; by receiver, then
    sender."""
    edge_weight: Any
    """(E,) float32, weights of the communication graph."""
    edge_attr: Any
    """(E, D) float32, features of the sender as the receiver knows them, as `Senses.edge_features` names them."""
    team: Any
    """(M,) int64, the team of each robot, ascending."""


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """Joint states of T teams of any sizes, R robots in all; team t has the rows offsets[t]:offsets[t + 1]."""

    maps: npt.NDArray[np.int32]
    """(T,) the map of each team, an index into a `MapSet`."""
    offsets: npt.NDArray[np.int64]
    """(T + 1,) the first row of each team; the last entry is R."""
    positions: Integers
    """(R, 2) row and column of each robot."""
    goals: Integers
    """(R, 2) row and column of each robot's goal."""
    moves: npt.NDArray[np.int8]
    """(R, HISTORY) the last executed moves, newest first; -1 before the start."""
    under_way: npt.NDArray[np.int32]
    """(R,) steps since the robot was on its goal, or since the start."""
    seeds: npt.NDArray[np.uint64]
    """(T,) the seed of each team's episode."""
    times: npt.NDArray[np.int32]
    """(T,) steps since the start of the episode."""
    limits: npt.NDArray[np.int32]
    """(T,) steps after which the episode is truncated."""
    comm_radius: npt.NDArray[np.float64]
    """(T,) robots closer than this hear each other."""

    def __len__(self) -> int:
        return len(self.maps)

    @property
    def num_robots(self) -> int:
        """The number of robots R of all teams."""
        return len(self.positions)

    @property
    def team(self) -> npt.NDArray[np.int64]:
        """(R,) the team of each robot, ascending."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))

    def rows(self, chosen: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return the rows of the robots of the chosen teams (B,), by their numbers or as a mask (T,), in order."""
        teams = _numbers(chosen)
        sizes = np.diff(self.offsets)[teams]
        ends = np.cumsum(sizes, dtype=np.int64)
        return np.arange(ends[-1] if len(ends) else 0) + np.repeat(self.offsets[teams] - ends + sizes, sizes)

    def take(self, chosen: npt.ArrayLike) -> States:
        """Return the chosen teams (B,), by their numbers or as a mask (T,), in the order given."""
        teams = _numbers(chosen)
        sizes, robots = np.diff(self.offsets)[teams], self.rows(teams)
        offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes, dtype=np.int64)])
        return States(
            maps=self.maps[teams],
            offsets=offsets,
            **{name: getattr(self, name)[robots] for name in _OF_ROBOTS},
            **{name: getattr(self, name)[teams] for name in _OF_TEAMS},
        )

    @staticmethod
    def concatenate(parts: Sequence[States]) -> States:
        """Return all teams of `parts`, in order; they index the same maps."""
        if not parts:
            raise ValueError("there are no states to concatenate: give at least one part")
        ends = np.cumsum([0, *(part.num_robots for part in parts[:-1])])
        begins = [part.offsets[:-1] + end for part, end in zip(parts, ends, strict=True)]
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in (*_OF_ROBOTS, *_OF_TEAMS)}
        return States(
            maps=np.concatenate([part.maps for part in parts]),
            offsets=np.concatenate([*begins, [sum(part.num_robots for part in parts)]]),
            **joined,
        )

    @staticmethod
    def start_of(
        instances: Sequence[Instance],
        senses: Senses,
        maps: npt.ArrayLike,
        *,
        seeds: npt.ArrayLike | None = None,
        limits: npt.ArrayLike = 128,
    ) -> States:
        """Return the start states of instances.

        Args:
            instances: The T instances.
            senses: Gives the communication radius, which grows to the connecting radius if comm_range says so.
            maps: (T,) the map of each instance: `MapSet.index` of a set that was made of their grids.
            seeds: (T,) seeds of the episodes, by default 0.
            limits: Steps after which episodes are truncated, one number or (T,).
        """
        arguments.instance_of(senses, Senses, "senses")
        given = list(arguments.each_of(instances, Instance, "instances"))
        if not given:
            raise ValueError("there are no instances: give at least one")
        count, sizes = len(given), [each.num_agents for each in given]
        radii = np.full(count, senses.comm_radius, np.float64)
        if senses.comm_range == "connected":
            radii[:] = [_native.connecting_radius(each.starts, senses.comm_radius) for each in given]
        robots = sum(sizes)
        return States(
            maps=_array(maps, "maps"),
            offsets=np.cumsum([0, *sizes], dtype=np.int64),
            positions=np.concatenate([each.starts for each in given]),
            goals=np.concatenate([each.goals for each in given]),
            moves=np.full((robots, HISTORY), -1, np.int8),
            under_way=np.zeros(robots, np.int32),
            seeds=np.zeros(count, np.uint64) if seeds is None else _array(seeds, "seeds"),
            times=np.zeros(count, np.int32),
            limits=_array([limits] * count if np.ndim(limits) == 0 else limits, "limits"),
            comm_radius=radii,
        )

    def stuck(self) -> npt.NDArray[np.bool_]:
        """(R,) the robots that are off their goal, on a cell where they stood at one of their last HISTORY steps."""
        return is_stuck(self.positions, self.goals, self.moves)


def _numbers(chosen: npt.ArrayLike) -> npt.NDArray[np.intp]:
    teams = arguments.array(chosen, "chosen")
    if teams.dtype == np.bool_:
        return np.flatnonzero(teams)
    if teams.size and teams.dtype.kind not in "iu":
        raise TypeError(f"chosen must be numbers of teams or a mask, got dtype {teams.dtype}")
    return teams.astype(np.intp, copy=False)


_OF_TEAMS = ("seeds", "times", "limits", "comm_radius")
_OF_ROBOTS = ("positions", "goals", "moves", "under_way")

# Moves back in time as one number each, a sum of which is 0 where the robot is where it was; the last one is of -1.
_SHIFTS = np.array([-64, -1, 64, 1, 0, 0], np.int16)


def is_stuck(positions: Integers, goals: Integers, moves: npt.NDArray[np.int8]) -> npt.NDArray[np.bool_]:
    """Return the robots (...) that are off their goal and on a cell where they stood in one of their last steps.

    A robot that was stopped is stuck in the next step; one that moves back and forth or in a circle is stuck as soon as
    it comes back; one on its way never is. A robot finds this out by itself, without map or messages.

    Args:
        positions: (..., 2)
        goals: (..., 2)
        moves: (..., HISTORY) the last executed moves, newest first; -1 before the start.
    """
    back = np.cumsum(_SHIFTS[moves], axis=-1, dtype=np.int16) == 0
    return (back & (moves >= 0)).any(-1) & (positions != goals).any(-1)


class MapSet:
    """Maps of any sizes inside borders of obstacles, each stored once, as `perceive` reads them.

    Args:
        grids: (H, W) maps, True is an obstacle; equal ones share their memory.
        border: Cells of obstacles around each map, at least the radius of the views.
        dtype: The dtype of the views, "uint8" or "float32".

    Raises:
        ValueError: If the border is too small, the dtype unknown, or a map has no cells.
        TypeError: If a grid has the wrong dtype.
    """

    index: npt.NDArray[np.int32]
    """(G,) the map of each given grid, for `States.maps`."""

    def __init__(self, grids: Iterable[npt.ArrayLike], border: int, dtype: str = "uint8") -> None:
        self.border = border = arguments.integer(border, "border", 1, arguments.MOST_INT)
        arguments.choice(dtype, ("uint8", "float32"), "dtype")
        self.dtype = np.dtype(dtype)
        if not isinstance(grids, Iterable):
            raise TypeError(f"grids must be a sequence of maps (H, W), got {type(grids).__name__}")
        known: dict[tuple[tuple[int, ...], bytes], int] = {}
        index, bordered = [], []
        for grid in grids:
            obstacles = as_obstacles(grid)
            number = known.setdefault((obstacles.shape, obstacles.tobytes()), len(known))
            index.append(number)
            if number == len(bordered):
                bordered.append(np.pad(obstacles.astype(self.dtype), border, constant_values=1))
        self.index = np.array(index, np.int32)
        self._sizes = np.array([each.shape for each in bordered], np.int32).reshape(-1, 2) - 2 * border
        ends = np.cumsum([0, *(each.size for each in bordered)], dtype=np.int64)
        self._offsets = ends[:-1].copy()
        self._cells = np.concatenate([each.ravel() for each in bordered]) if bordered else np.empty(0, self.dtype)
        for array in (self.index, self._sizes, self._offsets, self._cells):
            array.flags.writeable = False

    def __len__(self) -> int:
        return len(self._sizes)

    def grid(self, number: int) -> npt.NDArray[np.bool_]:
        """Return a copy of the map (H, W) of that number."""
        height, width = self._sizes[number].tolist()
        sides, first, border = (height + 2 * self.border, width + 2 * self.border), self._offsets[number], self.border
        bordered = self._cells[first : first + sides[0] * sides[1]].reshape(sides)
        return bordered[border : border + height, border : border + width] != 0


def perceive(states: States, maps: MapSet, senses: Senses, *, message_loss: float = 0.0, threads: int = 1) -> Bag:
    """Return the observations of the robots of teams in given states.

    The communication radius of each team is that of its state; `senses` gives everything else. Messages are lost by the
    seed and the time of the state, exactly as in the environments.

    Args:
        states: The joint states.
        maps: The maps that they index, inside borders of at least `senses.fov_radius`; the views have their dtype.
        senses: The settings of perception.
        message_loss: Probability that an edge fails.
        threads: Threads that share the teams; results do not depend on it.

    Raises:
        ValueError: If an index, shape or cell does not fit; the message names the team and the robot.
        TypeError: If an array has the wrong dtype.
    """
    arguments.instance_of(states, States, "states")
    arguments.instance_of(maps, MapSet, "maps")
    arguments.instance_of(senses, Senses, "senses")
    arguments.share(message_loss, "message_loss")
    arrays = [_array(getattr(states, name), name) for name in _ARRAYS]
    workers = arguments.integer(threads, "threads", 1, arguments.MOST_THREADS)
    _require_dtype(senses, maps.dtype.name)
    kernel: Any = _native.perceive  # of which there is one for each dtype
    return Bag(*kernel(maps._cells, maps._offsets, maps._sizes, maps.border, *arrays, senses, message_loss, workers))


_ARRAYS = {
    "maps": (np.dtype(np.int32), "iu", 1),
    "offsets": (np.dtype(np.int64), "iu", 1),
    "positions": (np.dtype(np.int32), "iu", 2),
    "goals": (np.dtype(np.int32), "iu", 2),
    "moves": (np.dtype(np.int8), "iu", 2),
    "under_way": (np.dtype(np.int32), "iu", 1),
    "seeds": (np.dtype(np.uint64), "iu", 1),
    "times": (np.dtype(np.int32), "iu", 1),
    "limits": (np.dtype(np.int32), "iu", 1),
    "comm_radius": (np.dtype(np.float64), "iuf", 1),
}
"""The arrays of states in the order of the native core: dtype, accepted kinds, axes."""


def _array(given: Any, name: str) -> npt.NDArray[Any]:
    """Return an array of states as the native core reads it."""
    dtype, kinds, axes = _ARRAYS[name]
    if type(given) is np.ndarray and given.dtype == dtype and given.ndim == axes and given.flags.c_contiguous:
        return given
    found = arguments.array(given, f"states.{name}")
    if found.ndim != axes:
        raise ValueError(f"states.{name} must have {axes} axes, got shape {found.shape}")
    if found.dtype.kind not in kinds:
        raise TypeError(f"states.{name} must be {dtype.name}, got dtype {found.dtype}")
    if "f" not in kinds and found.size:
        least, most = np.iinfo(dtype).min, np.iinfo(dtype).max
        if int(found.min()) < least or int(found.max()) > most:
            raise ValueError(f"states.{name} must fit into {dtype.name}, got {found.min()}..{found.max()}")
    return np.ascontiguousarray(found, dtype)


@lru_cache(maxsize=64)
def _require_dtype(senses: Senses, dtype: str) -> None:
    """Raise ValueError if views of that dtype cannot hold the values of a channel; the answer is cached."""
    if dtype == "uint8":
        require_bytes(senses)
