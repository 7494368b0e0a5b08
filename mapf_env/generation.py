"""Random maps and instances, reproducible from a seed on every platform."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments
from mapf_env.instance import Instance, Obstacles, as_bool, as_obstacles

MapStyle = Literal["cells", "walls", "maze", "room", "warehouse", "empty"]
STYLES: tuple[MapStyle, ...] = ("cells", "walls", "maze", "room", "warehouse", "empty")
"""In the native core's order."""


@arguments.lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class Maze:
    """Corridors between walls one cell thick; the style "maze" with its parts chosen.

    Raises:
        ValueError: If a part is out of its range.
        TypeError: If a number of cells is not an integer.
    """

    corridor_width: int = 1
    """Cells, 1..9999."""
    loops: float = 0.1
    """Fraction of extra walls removed; 0 gives a perfect maze (one path between any two cells)."""

    def __post_init__(self) -> None:
        _check_parts(self)
        arguments.share(self.loops, "the loops of a Maze")


@arguments.lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class Walls:
    """Walls one cell thick that grow in steps of two cells; the style "walls" with its parts chosen.

    They fill a map up to its density and always leave the free cells connected. With `Walls(segments=4, straight=0.5,
    ring=True)` on 17 to 21 cells per side, odd sizes, and densities of 0.1 to 0.4 the maps resemble POGEMA's mazes.

    Raises:
        ValueError: If a part is out of its range.
        TypeError: If a part has the wrong type.
    """

    segments: int = 2
    """Steps of two cells by which a wall grows, 1..9999; a step that meets another wall is skipped."""
    straight: float = 0.0
    """Share of these steps that keep the direction of the step before; the others take a random one of the four."""
    ring: bool = False
    """Keep the border of the map free, so that a corridor leads around it."""

    def __post_init__(self) -> None:
        _check_parts(self)
        arguments.share(self.straight, "the straight of Walls")
        arguments.flag(self.ring, "the ring of Walls")


@arguments.lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class Rooms:
    """Square rooms between walls one cell thick, with a door between any two neighbours; the style "room".

    Raises:
        ValueError: If the size is out of its range.
        TypeError: If it is not an integer.
    """

    room_size: int = 5
    """Rows and columns of a room, 1..9999."""

    def __post_init__(self) -> None:
        _check_parts(self)


@arguments.lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class Warehouse:
    """Shelves in rows, the same for every seed; the style "warehouse".

    Raises:
        ValueError: If a part is out of its range.
        TypeError: If a number of cells is not an integer.
    """

    shelf_length: int = 10
    """Columns of a shelf, 1..9999."""
    shelf_depth: int = 2
    """Rows of a shelf, 1..9999."""
    corridor_width: int = 1
    """Cells between two shelves and along the upper and lower edge, half of those at the sides, 1..9999."""

    def __post_init__(self) -> None:
        _check_parts(self)


Style = MapStyle | Maze | Rooms | Walls | Warehouse
_STYLE_OF: dict[type, MapStyle] = {Maze: "maze", Rooms: "room", Walls: "walls", Warehouse: "warehouse"}
Seeds = npt.NDArray[np.uint64]


def random_maps(
    seeds: npt.ArrayLike, *, height: int = 20, width: int = 20, density: float = 0.1, style: Style = "cells"
) -> Obstacles:
    """Return random maps (B, H, W), True is an obstacle, one for each of B seeds; their free cells are connected.

    Args:
        seeds: (B,) unsigned integers.
        height: Rows H.
        width: Columns W.
        density: Share of obstacles; maps of the styles "cells" and "walls" have exactly round(density * H * W) of them,
            the others as many as the style makes.
        style: "cells" blocks independent cells, "walls" builds short walls between cells with even coordinates as the
            authors' generator does, "empty" has no obstacles. "walls", "maze", "room" and "warehouse" are short
            for `Walls()`, `Maze()`, `Rooms()` and `Warehouse()`, whose fields are the sizes of their parts.

    Raises:
        ValueError: If the density leaves no room, or the style cannot reach it, or an argument is out of its range.
        TypeError: If an argument has the wrong type.
    """
    check_map(height, width, density)
    number, parts = STYLES.index(style_name(style)), asdict(style) if not isinstance(style, str) else {}
    obstacles = round(density * height * width)
    return _native.random_maps(_as_seeds(seeds), height, width, obstacles, number, **parts)


def random_starts_and_goals(
    seeds: npt.ArrayLike, grids: npt.NDArray[np.bool_], num_agents: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Return starts and goals, each (B, N, 2), for each of B seeds on its grid of `grids` (B, H, W).

    Starts are distinct, goals are distinct, no robot starts on its own goal, and all lie in the largest connected free
    region, over which they are uniform.

    Raises:
        ValueError: If a region is too small for that many robots, or an argument is out of its range.
        TypeError: If an argument has the wrong type.
    """
    robots = arguments.integer(num_agents, "num_agents", 1, arguments.MOST_INT)
    maps = as_bool(arguments.shaped(grids, "grids", "(B, H, W)"), "grids")
    return _native.place_agents(_as_seeds(seeds), maps, robots)


def random_map(
    *, height: int = 20, width: int = 20, density: float = 0.1, style: Style = "cells", seed: int | None = None
) -> Obstacles:
    """Return one map (H, W) of `random_maps`; without a seed, a different one at each call."""
    return random_maps([_one_seed(seed)], height=height, width=width, density=density, style=style)[0]


def random_instance(
    *,
    height: int = 20,
    width: int = 20,
    density: float = 0.1,
    num_agents: int = 10,
    style: Style = "cells",
    grid: npt.ArrayLike | None = None,
    seed: int | None = None,
) -> Instance:
    """Return a random instance, on a random map or on `grid` (H, W) if given.

    The map depends on the seed and the map's arguments alone: another number of agents gives the same map.

    Raises:
        ValueError: If the map has no room for the robots, or the density leaves none, or an argument is out of its
            range.
        TypeError: If an argument has the wrong type.
    """
    seeds = np.array([_one_seed(seed)], dtype=np.uint64)
    if grid is None:
        grids = random_maps(seeds, height=height, width=width, density=density, style=style)
    else:
        grids = as_obstacles(grid)[None]
    starts, goals = random_starts_and_goals(seeds, grids, num_agents)
    return Instance(grids[0], starts[0], goals[0])


def check_map(height: int, width: int, density: float, border: int = 1) -> None:
    """Raise ValueError or TypeError unless there are maps of that size and density."""
    height = arguments.integer(height, "height", 1, arguments.MOST_INT)
    width = arguments.integer(width, "width", 1, arguments.MOST_INT)
    if (height + 2 * border) * (width + 2 * border) > arguments.MOST_INT:
        raise ValueError(
            f"a map of height {height} and width {width} with a border of {border} has more than "
            f"{arguments.MOST_INT} cells: ask for a smaller one"
        )
    if not 0.0 <= arguments.number(density, "density") < 1.0:
        raise ValueError(f"density must lie in [0, 1), got {density}")


def style_name(style: Any) -> MapStyle:
    """Return the name of a style that is given by name or by its parts.

    Raises:
        ValueError: If it is neither.
    """
    name = _STYLE_OF.get(type(style), style)
    if not isinstance(name, str) or name not in STYLES:
        raise ValueError(
            f"style must be one of {', '.join(STYLES)}, or a Maze, Rooms, Walls or Warehouse, got {style!r}"
        )
    return name


def _check_parts(parts: Maze | Rooms | Walls | Warehouse) -> None:
    for name, size in asdict(parts).items():
        if name in ("loops", "straight", "ring"):  # the parts that are not sizes
            continue
        if not 1 <= arguments.integer(size, f"the {name} of {type(parts).__name__}") <= 9999:
            raise ValueError(f"the {name} of {type(parts).__name__} must lie in 1..9999, got {size}")


def _one_seed(seed: int | None) -> int:
    if seed is None:
        return int(np.random.SeedSequence().generate_state(1, np.uint64)[0])
    return arguments.seed(seed)


def _as_seeds(seeds: npt.ArrayLike) -> Seeds:
    array = arguments.shaped(seeds, "seeds", "(B,)", ": a vector of non-negative integers")
    if array.dtype.kind not in "iu" or (array < 0).any():
        raise ValueError(f"seeds must be a vector of non-negative integers below 2**64, got {array.dtype} {array}")
    return np.ascontiguousarray(array, dtype=np.uint64)
