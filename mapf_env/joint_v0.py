"""The team as one agent: a Gymnasium environment whose action is the joint action, for single-agent libraries."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from mapf_env import arguments
from mapf_env.batched_env import BatchedEnv, Observation
from mapf_env.config import EnvConfig
from mapf_env.grid_v0 import fov_space, instance_asked_for


class JointEnv(gymnasium.Env[Any, npt.NDArray[np.integer]]):
    """All robots decided by one agent: it observes `{"fov": (N, C, F, F), "graph": (N, N)}` and acts by N moves.

    The reward is the sum of the robots'. Infos carry `action_mask` (N, 5), `replaced` (N,) and `on_goal` (N,).

    Args:
        settings: Fields of `mapf_env.EnvConfig`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, **settings: Any) -> None:
        config = EnvConfig(**settings)  # which has none of the options of a batch alone
        self._batch = BatchedEnv(1, **settings)
        N, view = config.num_agents, fov_space(config)
        low, high = (np.broadcast_to(bound, (N, *view.shape)) for bound in (view.low, view.high))
        self.observation_space = spaces.Dict(
            {
                "fov": spaces.Box(low, high, dtype=view.dtype.type),  # pyright: ignore[reportOptionalMemberAccess]
                "graph": spaces.Box(0.0, 1.0, (N, N), np.float32),
            }
        )
        self.action_space = spaces.MultiDiscrete([5] * N)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Begin an episode: a fresh random instance, or `options["instance"]`; seeds are those of `BatchedEnv`.

        Raises:
            ValueError: If the instance does not fit the environment.
            TypeError: If the seed is no integer, `options` no dictionary or `options["instance"]` no `Instance`.
        """
        seed, instance = None if seed is None else arguments.seed(seed), instance_asked_for(options)
        super().reset(seed=seed)
        observation = self._batch.reset(seed, instances=None if instance is None else [instance])
        return self._seen(observation), self._infos(np.zeros(self._batch.num_agents, np.bool_))

    def step(
        self, action: npt.NDArray[np.integer]
    ) -> tuple[dict[str, npt.NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Execute the joint action (N,).

        Raises:
            ValueError: If the shape is wrong or an action is out of range.
            TypeError: If the actions are not integers.
        """
        step = self._batch.step(arguments.shaped(action, "action", "(N,)")[None])
        reward, terminated, truncated = step.rewards[0].sum(), step.terminated[0], step.truncated[0]
        infos = self._infos(step.replaced[0])
        return self._seen(step.observation), float(reward), bool(terminated), bool(truncated), infos

    def _seen(self, observation: Observation) -> dict[str, npt.NDArray[Any]]:
        return {"fov": observation.fov[0], "graph": observation.graph[0]}

    def _infos(self, replaced: npt.NDArray[np.bool_]) -> dict[str, Any]:
        return {
            "action_mask": self._batch.action_mask()[0],
            "replaced": replaced,
            "on_goal": self._batch.on_goal()[0],
        }


def joint_env(**settings: Any) -> JointEnv:
    """The team as one Gymnasium agent; the settings are the fields of `mapf_env.EnvConfig`."""
    return JointEnv(**settings)
