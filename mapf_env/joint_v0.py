"""The team as one agent: a Gymnasium environment whose action is the joint action, for single-agent libraries."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from mapf_env import arguments
from mapf_env.batched_env import BatchedEnv, Observation
from mapf_env.config import configured
from mapf_env.grid_v0 import begun, instance_of_reset, observation_spaces
from mapf_env.instance import Instance
from mapf_env.pixels import RENDER_MODES, RenderMode, Screen


class JointEnv(gymnasium.Env[Any, npt.NDArray[np.integer]]):
    """One agent decides for all robots: it observes `{"fov": (N, C, F, F), "graph": (N, N)}` and its action is N moves.

    With `robot_features` it also observes "scalars" (N, K), with `edge_features` "edge_attr" (N, N, D).
    The reward is the sum of the robots' rewards. Infos carry `action_mask` (N, 5), `replaced` (N,) and `on_goal` (N,),
    in lifelong tasks `arrived` (N,) too.

    Args:
        render_mode: As in `GridEnv`.
        cases: As in `BatchedEnv`.
        grid: As in `BatchedEnv`.
        settings: Fields of `mapf_env.EnvConfig`.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 4}  # noqa: RUF012

    def __init__(
        self,
        *,
        render_mode: RenderMode | None = None,
        cases: Iterable[Instance] | None = None,
        grid: npt.ArrayLike | None = None,
        **settings: Any,
    ) -> None:
        self.config = config = configured(settings, ("render_mode", "cases", "grid"), grid)
        self._batch = BatchedEnv(1, cases=cases, grid=grid, **settings)
        self.render_mode = render_mode
        self._screen = Screen(render_mode, self.metadata["render_fps"])
        N = config.num_agents
        parts = observation_spaces(config)
        self._keys = tuple(parts)
        self.observation_space = spaces.Dict({key: _of_all(part, N) for key, part in parts.items()})
        self.action_space = spaces.MultiDiscrete([5] * N)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Begin an episode as `GridEnv` does: a fresh random instance, or `options["instance"]` with a map of any size.

        Raises:
            ValueError: If the instance has another number of agents than the environment.
            TypeError: If the seed is not an integer, `options` not a dictionary or `options["instance"]` not an
                `Instance`.
        """
        seed, instance = None if seed is None else arguments.seed(seed), instance_of_reset(options)
        super().reset(seed=seed)
        observation = self._batch.buffers()
        self._batch = begun(self._batch, self.config, seed, instance, observation)
        self._show()
        nobody = np.zeros(self._batch.num_agents, np.bool_)
        return self._seen(observation), self._infos(nobody, nobody)

    def step(
        self, action: npt.NDArray[np.integer]
    ) -> tuple[dict[str, npt.NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Execute the joint action (N,).

        Raises:
            ValueError: If the shape is wrong or an action is out of range.
            TypeError: If the actions are not integers.
        """
        joint = arguments.shaped(arguments.numbers(action, "action"), "action", "(N,)")
        step = self._batch.step(joint[None])
        reward, terminated, truncated = step.rewards[0].sum(), step.terminated[0], step.truncated[0]
        infos = self._infos(step.replaced[0], step.arrived[0])
        self._show()
        return self._seen(step.observation), float(reward), bool(terminated), bool(truncated), infos

    def render(self) -> str | npt.NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Render the current state in `render_mode`; returns None without a mode and for "human".

        Raises:
            RuntimeError: Before the first reset.
        """
        return self._screen.show(self._batch)

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _seen(self, observation: Observation) -> dict[str, npt.NDArray[Any]]:
        return {key: getattr(observation, key)[0] for key in self._keys}

    def _infos(self, replaced: npt.NDArray[np.bool_], arrived: npt.NDArray[np.bool_]) -> dict[str, Any]:
        infos = {
            "action_mask": self._batch.action_mask()[0],
            "replaced": replaced,
            "on_goal": self._batch.on_goal()[0],
        }
        return infos | {"arrived": arrived} if self.config.task == "lifelong" else infos


def _of_all(space: spaces.Box, num_agents: int) -> spaces.Box:
    """Return the joint observation space of `num_agents` robots, each of which observes `space`."""
    low, high = (np.broadcast_to(bound, (num_agents, *space.shape)) for bound in (space.low, space.high))
    return spaces.Box(low, high, dtype=space.dtype.type)  # pyright: ignore[reportOptionalMemberAccess]


def joint_env(**settings: Any) -> JointEnv:
    """Make the team as one Gymnasium agent; the settings are those of `JointEnv`."""
    return JointEnv(**settings)
