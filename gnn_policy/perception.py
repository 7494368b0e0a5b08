"""What a policy's robots perceive, rebuilt from positions: the same for training batches and for play."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from gnn_policy.policy_config import CommRange, CommWeights, PolicyConfig
from mapf_env import HISTORY, Instance, MapSet, Senses, States, perceive, rules


class Perception:
    """The views and communication graphs of teams that play known cases.

    Args:
        config: What the policy perceives.
        instances: The C cases.
        comm_range: In place of the policy's own.
        comm_weights: In place of the policy's own.

    Raises:
        ValueError: If a radius of zero shall grow.
    """

    def __init__(
        self,
        config: PolicyConfig,
        instances: Sequence[Instance],
        *,
        comm_range: CommRange | None = None,
        comm_weights: CommWeights | None = None,
    ) -> None:
        self._config = config
        self._weights: CommWeights = comm_weights or config.comm_weights
        self._radii = np.full(len(instances), config.comm_radius)
        if (comm_range or config.comm_range) == "connected":
            if config.comm_radius == 0:
                raise ValueError('comm_radius must be positive to grow, got 0.0 with comm_range "connected"')
            self._radii[:] = [rules.connecting_radius(each.starts, config.comm_radius) for each in instances]

    def observe(
        self,
        cases: npt.NDArray[np.integer],
        obstacles: rules.Bordered,
        positions: rules.Positions,
        goals: rules.Positions,
        distances: npt.NDArray[np.uint16] | None = None,
    ) -> tuple[npt.NDArray[Any], npt.NDArray[np.float32]]:
        """Views (B, N, C, F, F) and graphs (B, N, N) of teams that play the given cases (B,).

        The maps (B, H, W) stand inside a border of fov_radius, in the dtype of the views. Who plays cases for long may
        keep their `distances` of `rules.distance_tables`, which a policy that knows the map needs.
        """
        radius = self._config.fov_radius
        B, N = positions.shape[:2]
        senses = Senses(fov_radius=radius, extra_channels=("cost_to_go",) if self._config.cost_to_go else ())
        maps = MapSet(obstacles[:, radius:-radius, radius:-radius].astype(bool), radius, obstacles.dtype.name)
        states = States(
            maps=maps.index,
            offsets=np.arange(B + 1) * N,
            positions=positions.reshape(-1, 2),
            goals=goals.reshape(-1, 2),
            moves=np.full((B * N, HISTORY), -1, np.int8),
            under_way=np.zeros(B * N, np.int32),
            seeds=np.zeros(B, np.uint64),
            times=np.zeros(B, np.int32),
            limits=np.ones(B, np.int32),
            comm_radius=self._radii[cases],
        )
        fov = perceive(states, maps, senses).fov.reshape(B, N, -1, senses.fov_side, senses.fov_side)
        return fov, rules.communication_graph(positions, self._radii[cases], weights=self._weights)
