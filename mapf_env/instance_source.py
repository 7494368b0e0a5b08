"""Sources of the problems of episodes, as arrays: random ones, draws from a set, or given ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments
from mapf_env.config import EnvConfig
from mapf_env.generation import random_maps, random_starts_and_goals
from mapf_env.instance import Instance, as_obstacles


class Problems(NamedTuple):
    """M instances of at most N robots on maps of H x W cells."""

    grids: npt.NDArray[np.bool_]
    """(M, H, W)"""
    starts: npt.NDArray[np.int32]
    """(M, N, 2)"""
    goals: npt.NDArray[np.int32]
    """(M, N, 2)"""
    team_sizes: npt.NDArray[np.int32]
    """(M,) number of robots that are there, of N."""


class InstanceSource:
    """The problems of the environments of one configuration.

    Args:
        config: The sizes, and the distribution of random problems.
        cases: Instances to draw from, instead of random ones.
        grid: The map (H, W) of random ones, in the size of the configuration.
        fill: Take smaller instances too: the map is filled up with obstacles, and the missing robots are absent.

    Raises:
        ValueError: If there are no cases, one does not fit, or the map has no room for the robots.
        TypeError: If the cases are not instances.
    """

    def __init__(
        self, config: EnvConfig, cases: Iterable[Instance] | None, grid: npt.ArrayLike | None, fill: bool
    ) -> None:
        self._config, self._fill = config, arguments.flag(fill, "fill")
        self._grid = None if grid is None else as_obstacles(grid)
        if grid is not None and cases is not None:
            raise ValueError("cases bring maps of their own: give cases or a grid, not both")
        self._cases = None if cases is None else list(arguments.each_of(cases, Instance, "cases"))
        if self._cases is not None and not len(self.stack(self._cases, "cases").grids):
            raise ValueError("there are no cases to play: give some, or None for random instances")
        if self._grid is not None:
            self.draw(np.zeros(1, np.uint64))  # raises if the map has no room

    def draw(self, seeds: npt.NDArray[np.uint64]) -> Problems:
        """Return one problem for each seed."""
        if self._cases is None:
            config, count = self._config, len(seeds)
            if self._grid is None:
                size = {"height": config.height, "width": config.width}
                grids = random_maps(seeds, **size, density=config.density, style=config.style)
            else:
                grids = np.repeat(self._grid[None], count, axis=0)
            starts, goals = random_starts_and_goals(seeds, grids, config.num_agents)
            return Problems(grids, starts, goals, np.full(count, config.num_agents, np.int32))
        draws = _native.mix(seeds, np.full_like(seeds, np.iinfo(np.uint64).max)) % np.uint64(len(self._cases))
        return self.stack([self._cases[i] for i in draws.tolist()], "cases")

    def stack(self, instances: Sequence[Instance], name: str) -> Problems:
        """Return these instances as arrays; messages call them `name`.

        Raises:
            ValueError: If one does not fit.
            TypeError: If one is not an `Instance`.
        """
        config, given = self._config, list(arguments.each_of(instances, Instance, name))
        grids = np.ones((len(given), config.height, config.width), np.bool_)
        starts, goals = (np.zeros((len(given), config.num_agents, 2), np.int32) for _ in range(2))
        sizes = np.empty(len(given), np.int32)
        for b, instance in enumerate(given):
            robots, (height, width) = instance.num_agents, instance.grid.shape
            if robots > config.num_agents or (robots < config.num_agents and not self._fill):
                raise ValueError(
                    f"the instance has {robots} agents, the environment {config.num_agents}: "
                    f"make it with num_agents={robots}"
                )
            small = height < config.height or width < config.width
            if height > config.height or width > config.width or (small and not self._fill):
                raise ValueError(
                    f"the instance's map is {height}x{width}, the environment's {config.height}x{config.width}: "
                    f"make it with height={height}, width={width}"
                )
            grids[b, :height, :width] = instance.grid
            starts[b, :robots], goals[b, :robots], sizes[b] = instance.starts, instance.goals, robots
        return Problems(grids, starts, goals, sizes)
