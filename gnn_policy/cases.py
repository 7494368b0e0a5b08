"""Cases for training, validation and test: the three never share a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from mapf_env import Instance, _native, random_cases, random_maps
from mapf_env.generation import MapStyle

Split = Literal["train", "validation", "test"]


def make_cases(
    split: Split,
    *,
    seed: int,
    maps: int,
    cases_per_map: int,
    num_agents: int,
    height: int,
    width: int,
    density: float,
    styles: Sequence[MapStyle],
) -> list[Instance]:
    """The cases of a split, `cases_per_map` on each of its maps, map after map; the maps take turns among the styles.

    The maps depend on the seed, the split and the map's arguments alone: teams of every size meet the same maps.

    Raises:
        ValueError: If there would be no case, or the maps have no room for the robots.
    """
    if not styles:
        raise ValueError(f"the {split} split needs at least one style of maps, got none")
    if maps < 1 or cases_per_map < 1:
        raise ValueError(f"the {split} split needs at least one map and one case a map, got {maps} and {cases_per_map}")
    stream = _native.mix(np.array([seed], np.uint64), np.array([get_args(Split).index(split)], np.uint64))
    map_seeds = _native.mix(np.repeat(stream, maps), np.arange(maps, dtype=np.uint64))
    grids = np.empty((maps, height, width), np.bool_)
    for first, style in enumerate(styles):
        turn = slice(first, None, len(styles))
        grids[turn] = random_maps(map_seeds[turn], height=height, width=width, density=density, style=style)
    numbers = np.tile(np.arange(cases_per_map, dtype=np.uint64), maps)
    case_seeds = _native.mix(np.repeat(map_seeds, cases_per_map), numbers)
    starts, goals = random_cases(case_seeds, np.repeat(grids, cases_per_map, axis=0), num_agents)
    return [Instance(grids[i // cases_per_map], starts[i], goals[i]) for i in range(len(starts))]
