"""Teams that learn nothing, to compare a policy with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gnn_policy.execution import robot_seeds, uniform
from mapf_env import Action, BatchedEnv
from mapf_env.config import Shield


@dataclass(frozen=True, slots=True)
class RandomActor:
    """Every robot draws one of the five moves."""

    shield: Shield = "idle"

    def env_settings(self) -> dict[str, Any]:
        """Return the settings of an environment in which robots perceive nothing that costs time."""
        return {"fov_radius": 1, "comm_radius": 0.0, "shield": self.shield}

    def act(self, env: BatchedEnv) -> npt.NDArray[np.int64]:
        """Return uniform moves (B, N)."""
        return _draws(env).argmax(-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class GreedyActor:
    """Every robot takes a move that shortens its way, drawn if there are several; it knows the map, but no robots.

    With the shield "pibt" or "pibt_swap" this is PIBT: a robot prefers the moves that shorten its way, then to stay.
    """

    random_when_stuck: bool = False
    """A robot that is stuck draws one of the five moves instead."""
    shield: Shield = "idle"

    def env_settings(self) -> dict[str, Any]:
        """Return the settings of an environment in which robots know their greedy moves and whether they are stuck."""
        return {"robot_features": ("greedy_moves", "stuck"), "fov_radius": 1, "comm_radius": 0.0, "shield": self.shield}

    def act(self, env: BatchedEnv) -> npt.NDArray[Any]:
        """Return greedy moves (B, N), or with a PIBT shield scores (B, N, 5)."""
        robots = env.present & env.running[:, None]
        known = np.zeros((*robots.shape, len(Action) + 1), np.float32)
        known[robots] = env.bag().scalars
        draws = _draws(env)
        scores = 2 * known[..., :-1] + draws
        scores[..., Action.IDLE] += 1 - known[..., Action.IDLE]  # the second choice where it is not the first
        if self.random_when_stuck:
            scores = np.where(known[..., -1:] > 0, draws, scores)
        return scores.astype(np.float32) if self.shield != "idle" else scores.argmax(-1)


def _draws(env: BatchedEnv) -> npt.NDArray[np.float64]:
    B, N = env.num_envs, env.num_agents
    seeds = robot_seeds(np.repeat(env.seeds, N), np.tile(np.arange(N), B))
    return uniform(seeds, np.repeat(env.times, N), len(Action)).reshape(B, N, len(Action))
