"""The PettingZoo environment `mapf/grid-v0`: one team of robots on a grid, all acting at once."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pettingzoo
from gymnasium import spaces
from pettingzoo.utils.conversions import parallel_to_aec

from mapf_env import _native, arguments, rules
from mapf_env.batched_env import BatchedEnv, Observation
from mapf_env.config import EnvConfig, configured
from mapf_env.instance import Instance
from mapf_env.pixels import RENDER_MODES, RenderMode, Screen

ENV_ID = "mapf/grid-v0"


class GridEnv(pettingzoo.ParallelEnv[str, Any, Any]):
    """A team of robots with local views and local communication, stepped under a collision shield.

    Every agent observes `{"fov": (C, F, F), "graph": (N,)}`: its field of view and its row of the communication graph;
    with `robot_features` also "scalars" (K,), with `edge_features` also "edge_attr" (N, D).
    All agents act until the joint end: terminated once all are on their goals at the same time, truncated after
    `max_cycles` steps. Infos carry `action_mask` (5,), `replaced` (the shield changed the action) and `on_goal`, in
    lifelong tasks `arrived` too.

    Args:
        observation: "dict", or "box" for the field of view alone.
        preferences: An action is a score for each of the five moves, (5,) float32, instead of one of them; this needs
            shield="pibt".
        reuse_buffers: Return the same dictionaries and arrays at every step, overwritten; faster, for loops that store
            none of them.
        render_mode: "ansi" gives text, "rgb_array" a picture (H', W', 3), "human" prints the text at each step; in a
            terminal each state replaces the one before, `metadata["render_fps"]` times per second.
        cases: As in `BatchedEnv`.
        grid: As in `BatchedEnv`.
        settings: Fields of `mapf_env.EnvConfig`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "name": "mapf_grid_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": 4,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        *,
        observation: Literal["dict", "box"] = "dict",
        preferences: bool = False,
        reuse_buffers: bool = False,
        render_mode: RenderMode | None = None,
        cases: Iterable[Instance] | None = None,
        grid: npt.ArrayLike | None = None,
        **settings: Any,
    ) -> None:
        arguments.choice(observation, ("dict", "box"), "observation")
        arguments.flag(preferences, "preferences")
        arguments.flag(reuse_buffers, "reuse_buffers")
        options = ("observation", "preferences", "reuse_buffers", "render_mode", "cases", "grid")
        self.config = config = configured(settings, options, grid)  # which refuses the options of a batch alone
        self._batch = BatchedEnv(1, cases=cases, grid=grid, **settings)
        if preferences and config.shield == "idle":
            raise ValueError('preferences over all five moves need shield="pibt" or "pibt_swap"')
        self._observation, self._preferences, self._reuse = observation, preferences, reuse_buffers
        self.render_mode = render_mode
        self._screen = Screen(render_mode, self.metadata["render_fps"])
        N, (H, W) = config.num_agents, (config.height, config.width)
        self.possible_agents = [f"agent_{i}" for i in range(N)]
        self.agents: list[str] = []
        parts = observation_spaces(config)
        self._keys = tuple(parts)
        moves = spaces.Box(-np.inf, np.inf, (5,), np.float32) if preferences else spaces.Discrete(5)
        self.observation_spaces = {
            agent: copy.deepcopy(spaces.Dict(parts) if observation == "dict" else parts["fov"])
            for agent in self.possible_agents
        }
        self.action_spaces = {agent: copy.deepcopy(moves) for agent in self.possible_agents}
        self.state_space = spaces.Box(0.0, 1.0, (3, H, W), np.float32)
        self._masks_shape = (N, 5)
        self._reused: _Reused | None = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_reused": None}  # its dictionaries share its arrays

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the observation space of an agent; the same object at every call.

        Raises:
            ValueError: If the agent is unknown.
        """
        return _space_of(agent, self.observation_spaces)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """The five moves: up, left, down, right, idle; with preferences a score for each.

        Raises:
            ValueError: If the agent is unknown.
        """
        return _space_of(agent, self.action_spaces)

    @property
    def grid(self) -> npt.NDArray[np.bool_]:
        """(H, W) the map, True is an obstacle; a copy."""
        return self._batch.grids[0]

    @property
    def positions(self) -> npt.NDArray[np.int32]:
        """(N, 2) row and column of each robot; a copy."""
        return self._batch.positions[0]

    @property
    def goals(self) -> npt.NDArray[np.int32]:
        """(N, 2) row and column of each robot's goal; a copy."""
        return self._batch.goals[0]

    def instance(self) -> Instance:
        """The remaining problem: its starts are the current positions."""
        if not self.agents:
            raise RuntimeError("there is no episode: call reset() first")
        return Instance(self.grid, self.positions, self.goals)

    def state(self) -> npt.NDArray[np.float32]:
        """Return the global state (3, H, W): obstacles, robots and goals.

        Robot i and its goal have the value (i + 1) / N.

        Raises:
            RuntimeError: Before the first reset.
            ValueError: If the episode's instance has a map of another size than the environment's H x W.
        """
        if not self._batch.began:
            raise RuntimeError("there is no state before the first reset: call reset()")
        (height, width), (H, W) = self.grid.shape, self.state_space.shape[1:]
        if (height, width) != (H, W):
            raise ValueError(
                f"the state has the size of the environment's maps, {H}x{W}, but this episode is played on one of "
                f"{height}x{width}: make the environment with height={height}, width={width}, or read grid, positions "
                "and goals"
            )
        planes = np.zeros(self.state_space.shape, np.float32)
        planes[0] = self.grid
        numbers = np.arange(1, self._batch.num_agents + 1, dtype=np.float32) / np.float32(self._batch.num_agents)
        for plane, cells in ((1, self.positions), (2, self.goals)):
            planes[plane, cells[:, 0], cells[:, 1]] = numbers
        return planes

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin an episode: a fresh random instance, or `options["instance"]` with a map of any size.

        Raises:
            ValueError: If the instance has another number of agents than the environment.
            TypeError: If the seed is not an integer, `options` not a dictionary or `options["instance"]` not an
                `Instance`.
        """
        seed, instance = None if seed is None else arguments.seed(seed), instance_of_reset(options)
        if self._reuse and self._reused is None:
            self._reused = _Reused(self)
        reused = self._reused
        buffers = self._batch.buffers() if reused is None else reused.buffers
        self._batch = begun(self._batch, self.config, seed, instance, buffers)
        self.agents = list(self.possible_agents)
        if reused is None:
            observations, infos, agent_buffers = self._fresh(buffers)
        else:
            (observations, *_, infos), agent_buffers = reused.returned, reused.agent_buffers
        self._batch.stepper.outcome_by_agent(agent_buffers, self.agents, {}, {}, {}, infos)
        if self.render_mode == "human":
            self.render()
        return observations, infos

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Execute one action for each agent.

        Raises:
            RuntimeError: Before the first reset or after the end of the episode.
            ValueError: If agents are missing or unknown, or an action is out of range.
            TypeError: If `actions` is not a dictionary, or an action is not an integer.
        """
        if not isinstance(actions, dict):
            raise TypeError(f"actions must be a dictionary of one action for each agent, got {type(actions).__name__}")
        agents = self.agents
        if not agents:
            raise RuntimeError("the episode has not begun or has ended: call reset() before step()")
        if self._reuse and self._reused is None:  # a copy made in the middle of an episode
            self._reused = _Reused(self)
        batch, reused = self._batch, self._reused
        if reused is None:
            buffers = batch.buffers()
            observations, infos, agent_buffers = self._fresh(buffers)
            rewards, terminated, truncated = {}, {}, {}
        else:
            buffers, agent_buffers = reused.buffers, reused.agent_buffers
            observations, rewards, terminated, truncated, infos = reused.returned
        stepper, ended = batch.stepper, None
        if not self._preferences:
            ended = stepper.step_agents(actions, agent_buffers, agents, rewards, terminated, truncated, infos)
        if ended is None:
            batch.advance(arguments.numbers([self._checked(actions)], "actions"), buffers)
            ended = stepper.outcome_by_agent(agent_buffers, agents, rewards, terminated, truncated, infos)
        if ended:
            self.agents = []
        if self.render_mode == "human":
            self.render()
        return observations, rewards, terminated, truncated, infos

    def render(self) -> str | npt.NDArray[np.uint8] | None:
        """Render the current state in `render_mode`; returns None without a mode and for "human".

        Raises:
            RuntimeError: Before the first reset.
        """
        return self._screen.show(self._batch)

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def _fresh(self, buffers: Observation) -> tuple[dict[str, Any], dict[str, Any], Any]:
        """Return observations and infos by agent, whose arrays are rows of the buffers (1, N, ...) and of masks (N, 5).

        The third part has the same arrays as buffers of the stepper, in its dtype.
        """
        agents, rows = self.possible_agents, _native.rows_by_agent
        masks = np.empty(self._masks_shape, np.int8)
        if self._observation == "dict":
            names, columns = self._keys, (buffers.fov[0], buffers.graph[0])
            if len(names) > 2:
                columns = tuple([getattr(buffers, key)[0] for key in names])
        else:
            names, columns = (), (buffers.fov[0],)
        return (
            rows(agents, names, columns),
            rows(agents, ("action_mask",), (masks,)),
            self._batch.stepper.agent_buffers(buffers, masks),
        )

    def _checked(self, actions: dict[str, Any]) -> list[Any]:
        """Return the actions in the order of agents, or raise the error that says what is wrong with them."""
        if actions.keys() != set(self.agents):
            missing, unknown = set(self.agents) - actions.keys(), actions.keys() - set(self.agents)
            raise ValueError(f"give one action for each agent; missing: {sorted(missing)}, unknown: {sorted(unknown)}")
        if not self._preferences:
            return [arguments.integer(actions[agent], f"the action of {agent}") for agent in self.agents]
        return [_as_preferences(agent, actions[agent]) for agent in self.agents]


class _Reused:
    """The dictionaries that a `GridEnv` with reused buffers returns at every step; their arrays are rows of these."""

    def __init__(self, env: GridEnv) -> None:
        self.buffers = env._batch.buffers()
        observations, infos, self.agent_buffers = env._fresh(self.buffers)
        self.returned: tuple[dict[str, Any], ...] = (observations, {}, {}, {}, infos)


def observation_spaces(config: EnvConfig) -> dict[str, Any]:
    """The observation of one robot by key: fov (C, F, F), graph (N,), and scalars and edge_attr if any."""
    low, high, unit = config.channel_low, config.channel_high, config.channel_unit
    if config.dtype == "uint8":
        low, high = np.zeros_like(low), (high - low) * unit
    N, dtype = config.num_agents, np.uint8 if config.dtype == "uint8" else np.float32
    shape = (config.num_channels, config.fov_side, config.fov_side)
    bounds = [np.broadcast_to(bound[:, None, None], shape).astype(dtype) for bound in (low, high)]
    found = {"fov": spaces.Box(bounds[0], bounds[1], shape, dtype), "graph": spaces.Box(0.0, 1.0, (N,), np.float32)}
    if config.num_robot_features:
        low, high = config.robot_feature_bounds
        found["scalars"] = spaces.Box(low, high, dtype=np.float32)
    if config.num_edge_features:
        low, high = (np.tile(bound, (N, 1)) for bound in config.edge_feature_bounds)
        found["edge_attr"] = spaces.Box(low, high, dtype=np.float32)
    return found


def begun(
    batch: BatchedEnv, config: EnvConfig, seed: int | None, instance: Instance | None, out: Observation | None = None
) -> BatchedEnv:
    """Return a batch of one team at the start of an episode: `batch`, or its successor on maps of the instance's size.

    Raises:
        ValueError: If the instance has another number of agents than the environment; `batch` is then as it was.
    """
    shape = (config.height, config.width) if instance is None else instance.grid.shape
    fitting = batch.on_maps_of(config, shape)
    fitting.reset(seed, instances=None if instance is None else [instance], out=out)
    return fitting


def instance_of_reset(options: dict[str, Any] | None) -> Instance | None:
    """Return `options["instance"]` of a reset, if given; raises TypeError if it or `options` has the wrong type."""
    instance = None if options is None else arguments.instance_of(options, dict, "options").get("instance")
    return None if instance is None else arguments.instance_of(instance, Instance, 'options["instance"]')


def _space_of(agent: str, found: dict[str, spaces.Space[Any]]) -> spaces.Space[Any]:
    try:
        return found[agent]
    except (KeyError, TypeError):
        raise ValueError(f"there is no agent {agent!r}: they are agent_0 to agent_{len(found) - 1}") from None


def _as_preferences(agent: str, action: Any) -> npt.NDArray[np.float32]:
    scores = arguments.numbers(action, f"the action of {agent}")
    if scores.shape != (5,):
        raise ValueError(f"the action of {agent} must be a score for each of the five moves, got {action!r}")
    return rules.as_scores(scores)


def parallel_env(**settings: Any) -> GridEnv:
    """Make a `pettingzoo.ParallelEnv` of one team; the settings are those of `GridEnv`."""
    return GridEnv(**settings)


def env(**settings: Any) -> pettingzoo.AECEnv[str, Any, Any]:
    """Make the same environment in PettingZoo's turn-based (AEC) form."""
    return parallel_to_aec(parallel_env(**settings))
