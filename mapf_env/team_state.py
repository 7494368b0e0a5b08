"""The state of B teams, in arrays that the native core changes in place."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import isqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from mapf_env.config import EnvConfig
from mapf_env.senses import HISTORY

MOST_TABLE_BYTES = 2**30
"""Memory for the tables of steps to the goals of all robots of a `BatchedEnv`."""


def table_shape(num_envs: int, config: EnvConfig) -> tuple[int, int]:
    """Return the rows and columns of each robot's table of steps to its goal.

    It covers the whole map inside its border if the tables of all robots then fit into `MOST_TABLE_BYTES`, and else as
    much of it around the robot as fits; where the robot comes to its edge, the table is moved.

    Raises:
        ValueError: If not even what the robots see fits.
    """
    rows, cols = config.height + 2 * config.fov_radius, config.width + 2 * config.fov_radius
    robots, least = num_envs * config.num_agents, 2 * config.fov_radius + 1
    cells = MOST_TABLE_BYTES // (2 * robots)
    if rows * cols <= cells:
        return rows, cols
    side = isqrt(cells)
    if side < least:
        raise ValueError(
            f"{robots} robots that know the map need {2 * robots * least**2:,} bytes for the ways to their goals, more "
            f"than {MOST_TABLE_BYTES:,}: take fewer environments at once, fewer robots or a smaller fov_radius, or "
            "senses and a shield that need no map"
        )
    if rows <= cols:
        rows = min(rows, side)
        return rows, min(cols, cells // rows)
    cols = min(cols, side)
    return min(rows, cells // cols), cols


@dataclass(eq=False, slots=True)
class TeamState:
    """The arrays of B environments of at most N robots; `size` is a map's number of cells, its border included."""

    streams: npt.NDArray[np.uint64]
    """(B,) the seed of each environment's stream of episodes."""
    episodes: npt.NDArray[np.uint64]
    """(B,) number of episodes of its stream that have begun."""
    seeds: npt.NDArray[np.uint64]
    """(B,) the seed of the episode."""
    grids: npt.NDArray[np.bool_]
    """(B, H, W) the maps."""
    obstacles: npt.NDArray[Any]
    """(B, H + 2 r, W + 2 r) the maps inside their borders, in the views' dtype."""
    team_sizes: npt.NDArray[np.int32]
    """(B,) number of robots that are there."""
    positions: npt.NDArray[np.int32]
    """(B, N, 2)"""
    goals: npt.NDArray[np.int32]
    """(B, N, 2)"""
    moves: npt.NDArray[np.int8]
    """(B, N, HISTORY) the last executed moves, newest first; -1 before the start."""
    under_way: npt.NDArray[np.int32]
    """(B, N) steps since the robot was on its goal, or since reset."""
    arrivals: npt.NDArray[np.int32]
    """(B, N) number of arrivals of the robot."""
    comm_radius: npt.NDArray[np.float64]
    """(B,)"""
    regions: npt.NDArray[np.int32]
    """(B, size) the connected region of each cell; empty unless goals change."""
    distances: npt.NDArray[np.uint16]
    """(B, N, rows, cols) steps to the goal from the cells around each robot; empty unless they are needed."""
    corners: npt.NDArray[np.int32]
    """(B, N, 2) row and column of the bordered map at which each table begins."""
    times: npt.NDArray[np.int64]
    """(B,) steps since reset."""
    max_cycles: npt.NDArray[np.int32]
    """(B,) steps after which the episode is truncated."""
    started: npt.NDArray[np.bool_]
    """(B,) the environment has been reset."""
    ended: npt.NDArray[np.bool_]
    """(B,) the environment must be reset."""
    rewards: npt.NDArray[np.float32]
    """(B, N) of the last step, and so are the following."""
    terminated: npt.NDArray[np.bool_]
    """(B,)"""
    truncated: npt.NDArray[np.bool_]
    """(B,)"""
    replaced: npt.NDArray[np.bool_]
    """(B, N)"""
    arrived: npt.NDArray[np.bool_]
    """(B, N)"""
    on_goal: npt.NDArray[np.bool_]
    """(B, N)"""
    action_mask: npt.NDArray[np.int8]
    """(B, N, 5) as it was last computed."""

    @staticmethod
    def empty(num_envs: int, config: EnvConfig) -> TeamState:
        """Return the state before the first reset."""
        B, N, border = num_envs, config.num_agents, 2 * config.fov_radius
        padded = config.height + border, config.width + border
        size = padded[0] * padded[1]
        return TeamState(
            streams=np.zeros(B, np.uint64),
            episodes=np.zeros(B, np.uint64),
            seeds=np.zeros(B, np.uint64),
            grids=np.ones((B, config.height, config.width), np.bool_),
            obstacles=np.ones((B, *padded), config.dtype),
            team_sizes=np.zeros(B, np.int32),
            positions=np.zeros((B, N, 2), np.int32),
            goals=np.zeros((B, N, 2), np.int32),
            moves=np.full((B, N, HISTORY), -1, np.int8),
            under_way=np.zeros((B, N), np.int32),
            arrivals=np.zeros((B, N), np.int32),
            comm_radius=np.full(B, config.comm_radius, np.float64),
            regions=np.zeros((B, size if config.task == "lifelong" else 0), np.int32),
            distances=np.zeros((B, N, *(table_shape(B, config) if config.needs_distances else (0, 0))), np.uint16),
            corners=np.zeros((B, N, 2), np.int32),
            times=np.zeros(B, np.int64),
            max_cycles=np.full(B, config.max_cycles, np.int32),
            started=np.zeros(B, np.bool_),
            ended=np.ones(B, np.bool_),
            rewards=np.zeros((B, N), np.float32),
            terminated=np.zeros(B, np.bool_),
            truncated=np.zeros(B, np.bool_),
            replaced=np.zeros((B, N), np.bool_),
            arrived=np.zeros((B, N), np.bool_),
            on_goal=np.zeros((B, N), np.bool_),
            action_mask=np.zeros((B, N, 5), np.int8),
        )

    def writeable(self) -> TeamState:
        """Return the same state with writable copies of read-only arrays, such as those unpickled out of band."""
        arrays = (getattr(self, each.name) for each in fields(self))
        return TeamState(*(array if array.flags.writeable else array.copy() for array in arrays))
