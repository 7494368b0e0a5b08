"""What a policy's robots perceive, rebuilt from positions: the same for training batches and for play."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from gnn_policy.policy_config import CommRange, CommWeights, PolicyConfig
from mapf_env import Instance, rules


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
        fov = rules.observe(obstacles, positions, goals, radius)
        if self._config.cost_to_go:
            if distances is None:
                distances = rules.distance_tables(obstacles, radius, goals)
            extra = rules.observe_extra(obstacles, positions, radius, "cost_to_go", distances=distances)
            fov = np.concatenate([fov, extra[:, :, None]], axis=2)
        return fov, rules.communication_graph(positions, self._radii[cases], weights=self._weights)
