"""The rules of motion and perception: pure functions over batches of teams.

B is the number of environments, N of robots in each, F = 2 * fov_radius + 3 the side of a view. Maps are passed as
`bordered(grids, border)` makes them; a border of fov_radius cells keeps every view inside the array. Every function
checks shapes and raises ValueError, or TypeError if cells or actions are not integers.
"""

from __future__ import annotations

from typing import Any, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments
from mapf_env.instance import as_obstacles
from mapf_env.senses import CommWeights

Positions = npt.NDArray[np.int32]
Bordered = npt.NDArray[Any]

_ACTION = np.dtype(np.int64)


def _cells(values: npt.ArrayLike, name: str = "positions") -> Positions:
    return arguments.cells(values, name, "(B, N, 2)")


def bordered(grids: npt.NDArray[np.bool_], border: int, dtype: npt.DTypeLike = np.float32) -> Bordered:
    """Return grids (B, H, W) inside `border` cells of obstacles on each side, as 0 and 1 in the dtype of the views."""
    if border < 1:
        raise ValueError(f"border must be at least 1, got {border}")
    if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.uint8)):
        raise ValueError(f"views are float32 or uint8, got {np.dtype(dtype)}")
    width = ((0, 0), (border, border), (border, border))
    return np.pad(grids.astype(dtype), width, constant_values=1)


def observe(
    obstacles: Bordered,
    positions: npt.ArrayLike,
    goals: npt.ArrayLike,
    fov_radius: int,
    out: npt.NDArray[Any] | None = None,
) -> npt.NDArray[Any]:
    """Return every robot's field of view, (B, N, 3, F, F), in the layout of the authors' code.

    The inner window of 2 * fov_radius + 1 cells per side is the view, centred on the robot; the one-cell ring around it
    carries only the goal when that is out of sight, projected along the line from the robot to it. Channels: obstacles
    (cells outside the map count), the robot's own goal (exactly one cell), all robots in view, itself included.
    Source: Li et al. 2020, r_FOV = 4 gives 3 x 11 x 11; the layout is that of the authors' code.
    """
    positions, goals = _cells(positions), _cells(goals, "goals")
    if out is None:
        side = 2 * fov_radius + 3
        out = np.empty((*positions.shape[:2], 3, side, side), obstacles.dtype)
    _native.observe(obstacles, fov_radius, positions, goals, fov_radius, out)
    return out


def distances(grid: npt.ArrayLike, cells: npt.ArrayLike) -> npt.NDArray[np.int32]:
    """Return the steps from each cell of a map (H, W) to each of M cells (M, 2), as (M, H, W); -1 if unreachable.

    Raises:
        ValueError: If a shape is wrong or a cell lies off the map.
        TypeError: If the grid holds neither bool nor 0 and 1, or cells are not integers.
    """
    return _native.distances(as_obstacles(grid), arguments.cells(cells, "cells", "(M, 2)"))


def distance_tables(obstacles: Bordered, border: int, goals: npt.ArrayLike) -> npt.NDArray[np.uint16]:
    """Return the steps from each cell of the bordered maps to each goal, (B, N, size); 65535 if unreachable."""
    return _native.distance_tables(obstacles, border, _cells(goals, "goals"))


def communication_graph(
    positions: npt.ArrayLike,
    radius: float | npt.NDArray[np.float64],
    out: npt.NDArray[np.float32] | None = None,
    *,
    weights: CommWeights = "binary",
) -> npt.NDArray[np.float32]:
    """Return link weights (B, N, N), or (N, N) for positions (N, 2); `radius` is one number or one for each team.

    Two different robots closer than `radius` cells (Euclidean, strictly, as in the authors' code) hear each other:
    their weight is 1, or with `weights="distance"` 1 / distance; all others are 0. `out` is a buffer (B, N, N) to write
    them into, for positions (B, N, 2).
    """
    arguments.choice(weights, get_args(CommWeights), "weights")
    found = arguments.array(positions, "positions")
    single = found.ndim == 2
    cells = arguments.cells(found[None] if single else found, "positions", "(B, N, 2)", " or (N, 2)")
    radii = arguments.array(radius, "radius")
    if radii.dtype.kind not in "fiu":
        raise TypeError(f"radius must be a number, got {radius!r}")
    if radii.shape not in ((), (1,), (len(cells),)):
        raise ValueError(f"radius must be one number or one for each of {len(cells)} teams, got shape {radii.shape}")
    if not (radii >= 0).all():
        raise ValueError(f"the communication radius must not be negative, got {radius}")
    if out is None:
        out = np.empty((*cells.shape[:2], cells.shape[1]), np.float32)
    elif single or not isinstance(out, np.ndarray) or out.dtype != np.float32:
        raise TypeError("out must be a float32 array (B, N, N), for positions (B, N, 2)")
    _native.communication_graph(cells, np.full(len(cells), radii, np.float64), weights == "distance", out)
    return out[0] if single else out


def connecting_radius(positions: npt.ArrayLike, radius: float) -> float:
    """Return the least radius * 1.1^k, k = 0, 1, ..., that connects all robots at `positions` (N, 2).

    Source: the code of Li et al. 2020, which grows the radius in this way when an episode starts and then keeps it.
    """
    return _native.connecting_radius(arguments.cells(positions, "positions", "(N, 2)"), radius)


def lose_messages(
    graph: npt.NDArray[np.float32], loss: float, seeds: npt.NDArray[np.uint64], times: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """Return the graph (B, N, N) without the edges that fail.

    Each direction of an edge fails independently with probability `loss`.
    The draw depends only on the environment's seed and time, both (B,), and the two robots.
    """
    heard = np.array(graph, np.float32, order="C")
    _native.lose_messages(heard, loss, seeds, times)
    return heard


class Edges(NamedTuple):
    """The communication graphs of B teams as lists of E edges, for networks that pass messages along edges."""

    team: npt.NDArray[np.intp]
    """(E,) the environment, ascending."""
    receiver: npt.NDArray[np.intp]
    """(E,) the robot that hears, 0..N-1."""
    sender: npt.NDArray[np.intp]
    """(E,) the robot that is heard."""
    weight: npt.NDArray[np.float32]
    """(E,)"""
    offset: npt.NDArray[np.int32]
    """(E, 2) rows and columns from the receiver to the sender."""


def communication_edges(graph: npt.ArrayLike, positions: npt.ArrayLike) -> Edges:
    """Return the edges of dense graphs (B, N, N) between robots at `positions` (B, N, 2).

    Raises:
        ValueError: If the shapes do not fit.
        TypeError: If positions are not integers or weights are not numbers.
    """
    graph, positions = (
        arguments.shaped(graph, "graph", "(B, N, N)"),
        arguments.cells(positions, "positions", "(B, N, 2)"),
    )
    if graph.shape != (*positions.shape[:2], positions.shape[1]):
        raise ValueError(f"the graph {graph.shape} and the positions {positions.shape} are not of the same robots")
    if graph.dtype.kind not in "fiub":
        raise TypeError(f"graph must hold weights, got dtype {graph.dtype}")
    team, receiver, sender = np.nonzero(graph)
    offset = positions[team, sender] - positions[team, receiver]
    return Edges(team, receiver, sender, graph[team, receiver, sender], offset)


def shield(
    obstacles: Bordered,
    border: int,
    positions: npt.ArrayLike,
    actions: npt.ArrayLike,
    seeds: npt.NDArray[np.uint64],
    times: npt.NDArray[np.int64],
) -> npt.NDArray[np.int8]:
    """Return the actions (B, N) that the paper's collision shield lets through; the others become idle.

    A move off the map, into an obstacle or into the cell of a robot that stays, and both moves of a swap become idle;
    of several robots that enter one cell, one goes, drawn by the environment's seed and time, both (B,). The rules are
    applied to their fixed point: what is returned never collides, and a joint action without conflicts is unchanged.
    Source: Li et al. 2020, section 2 (collision shielding).
    """
    return _native.shield(obstacles, border, _cells(positions), as_actions(actions), seeds, times)


def pibt_shield(
    obstacles: Bordered,
    border: int,
    positions: npt.ArrayLike,
    wanted: npt.ArrayLike,
    under_way: npt.NDArray[np.int32],
    seeds: npt.NDArray[np.uint64],
    times: npt.NDArray[np.int64],
    *,
    goals: npt.ArrayLike | None = None,
    distances: npt.NDArray[np.uint16] | None = None,
) -> npt.NDArray[np.int8]:
    """Return the actions (B, N) of one step of priority inheritance with backtracking; they never collide.

    `wanted` is a score for each action, (B, N, 5), of which the greatest is preferred (ties in the actions' order). Or
    it is one action for each robot, (B, N), which stands for this order: that action, idle, then the others in an order
    drawn from the environment's seed and time. Robots choose in the order of `under_way` (B, N), the longest under way
    first, ties in an order drawn from the seed; a robot in the way of one with higher priority moves aside if it can.
    Source: Okumura, Machida, Defago and Tamura 2022.

    With `goals` (B, N, 2) and their `distances` of `distance_tables`, two robots that face each other in a corridor
    change places: one backs out to where the corridor branches and pulls the other along. Source: Okumura 2023,
    "Improving LaCAM for scalable eventually optimal multi-agent pathfinding".

    Raises:
        ValueError: If shapes do not fit together, or only one of `goals` and `distances` is given.
    """
    if (goals is None) != (distances is None):
        raise ValueError("swaps need both goals and distances (see rules.distance_tables): give both or neither")
    array = arguments.numbers(wanted, "wanted")
    if array.ndim == 3:
        scores, actions = as_scores(array), np.zeros((0, 0), np.int64)
    else:
        scores, actions = np.zeros((0, 0, 0), np.float32), as_actions(array)
    there = None if goals is None else _cells(goals, "goals")
    return _native.pibt_shield(
        obstacles, border, _cells(positions), scores, actions, under_way, seeds, times, there, distances
    )


def draw_goals(
    obstacles: Bordered,
    border: int,
    positions: npt.ArrayLike,
    goals: npt.ArrayLike,
    on_goal: npt.NDArray[np.bool_],
    arrivals: npt.NDArray[np.int32],
    seeds: npt.NDArray[np.uint64],
) -> Positions:
    """Return goals (B, N, 2) with new ones for the robots that are `on_goal` (B, N).

    A new goal is uniform over the free cells that the robot can reach, except for all robots' goals and its own cell;
    if there is none, it keeps its goal. The draw depends on the environment's seed, the robot and the number of
    its `arrivals` (B, N).
    """
    drawn = _cells(goals, "goals")
    _native.draw_goals(obstacles, border, _cells(positions), drawn, arrivals, on_goal, seeds)
    return drawn


def as_scores(scores: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Return `scores` of all five actions as contiguous float32; raises TypeError if they are not numbers."""
    array = arguments.numbers(scores, "scores of actions")
    if array.dtype.kind not in "fiu":
        raise TypeError(f"scores of actions must be numbers, got dtype {array.dtype}")
    return np.ascontiguousarray(array, dtype=np.float32)


def as_actions(actions: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return `actions` as int64; raises TypeError if they are not integers."""
    array = arguments.numbers(actions, "actions")
    if array.dtype.kind not in "iu":
        raise TypeError(f"actions must be integers 0..4 (up, left, down, right, idle), got dtype {array.dtype}")
    if array.dtype == np.uint64:
        array = np.minimum(array, np.uint64(np.iinfo(_ACTION).max))
    return array if array.dtype == _ACTION else array.astype(_ACTION)


def move(positions: npt.ArrayLike, actions: npt.ArrayLike) -> Positions:
    """Return the positions (B, N, 2) after the shielded actions (B, N)."""
    return _native.move(_cells(positions), as_actions(actions))


def action_mask(obstacles: Bordered, border: int, positions: npt.ArrayLike) -> npt.NDArray[np.int8]:
    """Return (B, N, 5), 1 for each action that neither leaves the map nor enters an obstacle."""
    return _native.action_mask(obstacles, border, _cells(positions))
