"""Hypothesis strategies: small maps, problems, teams and joint actions."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st

import oracles
from mapf_env import HISTORY, SCHEMES, Instance, Rewards
from mapf_env.senses import channels, edge_features, robot_features

seeds = st.integers(0, 2**32 - 1)


@st.composite
def grids(draw: st.DrawFn, max_side: int = 6, min_free: int = 1) -> oracles.Grid:
    """Maps (H, W) of at least `min_free` free cells, which need not be connected."""
    height, width = draw(st.integers(1, max_side)), draw(st.integers(1, max_side))
    if height * width < min_free:
        height = width = max_side
    size = height * width
    blocked = draw(st.sets(st.integers(0, size - 1), max_size=size - min_free))
    grid = np.zeros(size, bool)
    grid[sorted(blocked)] = True
    return grid.reshape(height, width)


@st.composite
def crowds(draw: st.DrawFn, max_side: int = 5, max_agents: int = 25) -> tuple[oracles.Grid, list[oracles.Cell]]:
    """A map and robots on distinct free cells of it, often on nearly all of them."""
    grid = draw(grids(max_side))
    free = sorted(oracles.free_cells(grid))
    count = draw(st.one_of(st.integers(1, len(free)), st.integers(max(1, len(free) - 2), len(free))))
    return grid, draw(st.permutations(free))[: min(count, max_agents)]


def joint_actions(num_agents: int) -> st.SearchStrategy[list[int]]:
    """One action 0..4 for each robot."""
    return st.lists(st.integers(0, 4), min_size=num_agents, max_size=num_agents)


@st.composite
def instances(draw: st.DrawFn, max_side: int = 6, min_agents: int = 1, max_agents: int = 6) -> Instance:
    """Well-formed problems in the largest region of a map; a robot may start on its goal."""
    enough_room = grids(max_side, min_free=min_agents).filter(lambda g: len(oracles.regions(g)[0]) >= min_agents)
    grid = draw(enough_room)
    region = sorted(oracles.regions(grid)[0])
    count = draw(st.integers(min_agents, min(max_agents, len(region))))
    starts, goals = draw(st.permutations(region))[:count], draw(st.permutations(region))[:count]
    return Instance(grid, np.array(starts), np.array(goals))


@st.composite
def settings(draw: st.DrawFn, max_side: int = 7, max_agents: int = 8) -> dict[str, Any]:
    """Settings of an environment that fit together."""
    height, width = draw(st.integers(1, max_side)), draw(st.integers(2, max_side))
    density = draw(st.sampled_from([0.0, 0.1, 0.2]))
    free = height * width - round(density * height * width)
    return {
        "height": height,
        "width": width,
        "density": density if free >= 2 else 0.0,
        "style": "cells",
        "num_agents": draw(st.integers(1, min(max_agents, max(free, 2)))),
        "fov_radius": draw(st.integers(1, 5)),
        "comm_radius": draw(st.sampled_from([0.0, 1.0, 2.0**0.5, 2.5, 5.0, float("inf")])),
        "max_cycles": draw(st.integers(1, 12)),
        "dtype": draw(st.sampled_from(["float32", "uint8"])),
    }


@st.composite
def all_settings(draw: st.DrawFn) -> dict[str, Any]:
    """Settings of an environment with every option at once."""
    names = [name for name in channels() if name not in ("obstacles", "goal", "robots")]
    parts = st.sampled_from([0.0, -1.0, 0.5])
    return draw(settings(max_side=6, max_agents=6)) | {
        "extra_channels": some_of(draw, names),
        "robot_features": some_of(draw, list(robot_features())),
        "edge_features": some_of(draw, list(edge_features())),
        "memory": draw(st.integers(1, HISTORY)),
        "comm_radius": draw(st.sampled_from([1.0, 2.5, float("inf")])),
        "comm_range": draw(st.sampled_from(["fixed", "connected"])),
        "comm_weights": draw(st.sampled_from(["binary", "distance"])),
        "message_loss": draw(st.sampled_from([0.0, 0.3, 1.0])),
        "shield": draw(st.sampled_from(["idle", "pibt", "pibt_swap"])),
        "task": draw(st.sampled_from(["one_shot", "lifelong"])),
        "reward": draw(st.one_of(st.sampled_from(sorted(SCHEMES)), st.builds(Rewards, *[parts] * 6))),
    }


def some_of(draw: st.DrawFn, names: list[str]) -> tuple[str, ...]:
    """Up to three of the names, in any order."""
    return tuple(draw(st.permutations(names))[: draw(st.integers(0, 3))])
