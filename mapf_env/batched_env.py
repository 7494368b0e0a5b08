"""Many environments, stepped in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from math import prod
from typing import Any, Generic, Literal, NamedTuple, TypeVar, overload

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode

from mapf_env import _native, arguments, rules
from mapf_env.config import EnvConfig, configured
from mapf_env.instance import Instance
from mapf_env.instance_source import InstanceSource
from mapf_env.perception import Bag, States
from mapf_env.team_state import TeamState

_FLOAT = np.dtype(np.float32)
_MOST_DENSE_BYTES = 2**33


class Observation(NamedTuple):
    """Observations of the robots of B teams; C, K and D follow from the settings."""

    fov: npt.NDArray[Any]
    """(B, N, C, F, F) fields of view."""
    graph: npt.NDArray[np.float32]
    """(B, N, N) communication graph; row i has the robots that robot i hears."""
    scalars: npt.NDArray[np.float32]
    """(B, N, K) features of each robot, as the setting `robot_features` names them."""
    edge_attr: npt.NDArray[np.float32]
    """(B, N, N, D) features of robot j as heard by robot i, as `edge_features` names them; 0 if i does not hear j."""


Seen = TypeVar("Seen", bound=Observation | None)


class Step(NamedTuple, Generic[Seen]):
    """The outcome of one joint step of B teams."""

    observation: Seen
    """The observation after the step; None after a step without observation."""
    rewards: npt.NDArray[np.float32]
    """(B, N) by default 0 for a robot that is on its goal after the step, else -1.

    If no robot leaves its goal again, a team's undiscounted return is the number of robots that did not start on their
    goals minus its flowtime, because the step that arrives costs nothing.
    """
    terminated: npt.NDArray[np.bool_]
    """(B,) all robots of the team are on their goals at once; never in lifelong tasks."""
    truncated: npt.NDArray[np.bool_]
    """(B,) max_cycles is reached and the team is not terminated."""
    replaced: npt.NDArray[np.bool_]
    """(B, N) the shield replaced the robot's action."""
    arrived: npt.NDArray[np.bool_]
    """(B, N) the robot has moved onto its goal in this step; in lifelong tasks their sum is the throughput."""
    final_observation: Observation | None = None
    """With autoreset SAME_STEP the last observations of the teams that have ended, in their order, if any have."""


class BatchedEnv:
    """B environments in arrays; the settings are the fields of `EnvConfig`.

    All robots of a team act until the team's episode ends. A team that has ended must be reset before the next step,
    unless `autoreset` does that.

    Args:
        num_envs: The number of environments B.
        threads: Threads that share the environments of a step; results do not depend on it.
        autoreset: As in Gymnasium: DISABLED; NEXT_STEP, where the step after the end ignores its actions (which must
            be valid) and begins the next episode; or SAME_STEP, where the step that ends returns the first observation
            of the next episode, and `Step.final_observation` has the last one of those that ended.
        cases: Instances to play, drawn at each reset by the seed, instead of random ones.
        grid: The map (H, W) of all episodes, True is an obstacle; starts and goals are drawn. It sets height and width.
        fill: Take instances that are smaller than the environment too: the map is filled up with obstacles. Absent
            robots have zeros everywhere, except that their action mask allows idle, so a masked choice is always
            defined; `present` tells which robots are there.
        settings: Fields of `EnvConfig`.

    Raises:
        ValueError: If a setting is out of range, or a case does not fit.
        TypeError: If a setting is unknown or of a wrong type.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        threads: int = 1,
        autoreset: AutoresetMode = AutoresetMode.DISABLED,
        cases: Iterable[Instance] | None = None,
        grid: npt.ArrayLike | None = None,
        fill: bool = False,
        **settings: Any,
    ) -> None:
        self.num_envs = num_envs = arguments.integer(num_envs, "num_envs", 1, arguments.MOST_INT)
        self.threads = arguments.integer(threads, "threads", 1, arguments.MOST_THREADS)
        try:
            self.autoreset = AutoresetMode(autoreset)
        except ValueError:
            modes = ", ".join(f"AutoresetMode.{mode.name}" for mode in AutoresetMode)
            raise ValueError(f"autoreset must be one of {modes}, got {autoreset!r}") from None
        self.config = config = configured(settings, ("threads", "autoreset", "cases", "grid", "fill"), grid)
        self._source = self._home = InstanceSource(config, cases, grid, fill)
        teams = (num_envs, config.num_agents)
        self._fov_shape = (*teams, config.num_channels, config.fov_side, config.fov_side)
        self._graph_shape = (*teams, config.num_agents)
        self._scalars_shape = (*teams, config.num_robot_features)
        self._edge_attr_shape = (*teams, config.num_agents, config.num_edge_features)
        self._no_scalars = np.empty((*self._scalars_shape[:-1], 0), _FLOAT)
        self._no_edge_attr = np.empty((*self._edge_attr_shape[:-1], 0), _FLOAT)
        self._dtype = np.dtype(config.dtype)
        self._state = TeamState.empty(num_envs, config)
        self._bind()

    def on_maps_of(self, config: EnvConfig, shape: tuple[int, int]) -> BatchedEnv:
        """Return environments for maps of `shape` that continue these streams of seeds; `self` if the shape fits.

        They have the settings of `config`. On maps of another size only given instances can be played.
        """
        if shape == (self.config.height, self.config.width):
            return self
        settings = {each.name: getattr(config, each.name) for each in fields(config)}
        same_size = shape == (config.height, config.width)
        if not same_size:
            settings |= {"height": shape[0], "width": shape[1], "density": 0.0, "style": "empty"}
        other = BatchedEnv(self.num_envs, threads=self.threads, autoreset=self.autoreset, **settings)
        other._home = self._home
        if same_size:
            other._source = self._home
        for name in ("streams", "episodes", "started"):
            getattr(other._state, name)[:] = getattr(self._state, name)
        return other

    def _bind(self) -> None:
        stepper = _native.StepperFloat32 if self.config.dtype == "float32" else _native.StepperUint8
        self.stepper = stepper(self._state, self.config, self.threads)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "stepper"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._state = self._state.writeable()
        self._bind()

    @property
    def num_agents(self) -> int:
        """The number of robots N in each team."""
        return self.config.num_agents

    @property
    def grids(self) -> npt.NDArray[np.bool_]:
        """(B, H, W) the maps, True is an obstacle; a copy."""
        return self._state.grids.copy()

    @property
    def positions(self) -> npt.NDArray[np.int32]:
        """(B, N, 2) the robots' positions; a copy."""
        return self._state.positions.copy()

    @property
    def goals(self) -> npt.NDArray[np.int32]:
        """(B, N, 2) the robots' goals; a copy."""
        return self._state.goals.copy()

    @property
    def moves(self) -> npt.NDArray[np.int8]:
        """(B, N, HISTORY) the last executed moves, newest first; -1 before the start; a copy."""
        return self._state.moves.copy()

    @property
    def under_way(self) -> npt.NDArray[np.int32]:
        """(B, N) steps since the robot was on its goal, or since reset; a copy."""
        return self._state.under_way.copy()

    @property
    def seeds(self) -> npt.NDArray[np.uint64]:
        """(B,) the seeds of the episodes; a copy."""
        return self._state.seeds.copy()

    @property
    def team_sizes(self) -> npt.NDArray[np.int32]:
        """(B,) number of robots in each team; a copy."""
        return self._state.team_sizes.copy()

    @property
    def max_cycles(self) -> npt.NDArray[np.int32]:
        """(B,) steps after which each team's episode is truncated; a copy."""
        return self._state.max_cycles.copy()

    @property
    def times(self) -> npt.NDArray[np.int64]:
        """(B,) steps since each team's reset; a copy."""
        return self._state.times.copy()

    @property
    def comm_radius(self) -> npt.NDArray[np.float64]:
        """(B,) robots closer than this hear each other; a copy."""
        return self._state.comm_radius.copy()

    @property
    def present(self) -> npt.NDArray[np.bool_]:
        """(B, N) which robots are there.

        Properties show the current state. With autoreset SAME_STEP, read `present` before the step to know whose
        rewards and `final_observation` the step returns.
        """
        return np.arange(self.num_agents) < self._state.team_sizes[:, None]

    @property
    def running(self) -> npt.NDArray[np.bool_]:
        """(B,) the teams that have begun and not ended."""
        return self._state.started & ~self._state.ended

    @property
    def began(self) -> bool:
        """True if all environments have been reset."""
        return bool(self._state.started.all())

    def buffers(self) -> Observation:
        """Allocate arrays for observations, to be passed as `out`.

        Raises:
            ValueError: If the communication graphs, which are dense here, would take more than 8 GiB.
        """
        graph_bytes = 4 * prod(self._graph_shape) * (1 + self.config.num_edge_features)
        if graph_bytes > _MOST_DENSE_BYTES:
            raise ValueError(
                f"the dense communication graphs of {self.num_envs} teams of {self.num_agents} robots take "
                f"{graph_bytes:,} bytes, more than {_MOST_DENSE_BYTES:,}: call reset and step with observe=False and "
                "read bag(), whose size grows with the edges"
            )
        return Observation(
            np.empty(self._fov_shape, self._dtype),
            np.empty(self._graph_shape, _FLOAT),
            np.empty(self._scalars_shape, _FLOAT) if self._scalars_shape[-1] else self._no_scalars,
            np.empty(self._edge_attr_shape, _FLOAT) if self._edge_attr_shape[-1] else self._no_edge_attr,
        )

    @overload
    def reset(
        self,
        seed: int | Sequence[int] | None = None,
        *,
        instances: Sequence[Instance] | None = None,
        mask: npt.NDArray[np.bool_] | None = None,
        max_cycles: int | Sequence[int] | None = None,
        out: Observation | None = None,
        observe: Literal[True] = True,
    ) -> Observation: ...

    @overload
    def reset(
        self,
        seed: int | Sequence[int] | None = None,
        *,
        instances: Sequence[Instance] | None = None,
        mask: npt.NDArray[np.bool_] | None = None,
        max_cycles: int | Sequence[int] | None = None,
        out: None = None,
        observe: Literal[False],
    ) -> None: ...

    def reset(
        self,
        seed: int | Sequence[int] | None = None,
        *,
        instances: Sequence[Instance] | None = None,
        mask: npt.NDArray[np.bool_] | None = None,
        max_cycles: int | Sequence[int] | None = None,
        out: Observation | None = None,
        observe: bool = True,
    ) -> Observation | None:
        """Begin new episodes and return their observation.

        Args:
            seed: Restarts the random streams of the environments that are reset: environment b gets seed + b, or the
                b-th of a sequence of B. Without a seed each goes on with its stream (the first time, from a random
                seed).
            instances: One instance for each environment that is reset, instead of random ones.
            mask: (B,) the environments to reset; all if not given. The others continue undisturbed.
            max_cycles: Steps after which these episodes are truncated, one number or one for each of the B
                environments; by default the setting of that name.
            out: Where to write the observation of all environments, as for `step`.
            observe: False writes no observation and returns None, for loops that use `bag`.

        Raises:
            ValueError: If a length or shape does not fit, or an instance is of another size than the environment;
                the environments are then as they were.
            TypeError: If a seed is not an integer, an instance is not an `Instance`, or `out` has the wrong dtype.
        """
        arguments.flag(observe, "observe")
        chosen = np.arange(self.num_envs) if mask is None else np.flatnonzero(self._checked_mask(mask))
        if out is not None:
            self._write_observation(out, np.zeros(self.num_envs, np.bool_))  # nothing, if there is room for it
        limits = None if max_cycles is None else self._checked_limits(max_cycles)[chosen]
        self._begin(chosen, None if seed is None else self._checked_seeds(seed)[chosen], instances, limits)
        self._state.replaced[chosen] = self._state.arrived[chosen] = False
        return self._observe(out) if observe else None

    def _begin(
        self,
        chosen: npt.NDArray[np.intp],
        streams: npt.NDArray[np.uint64] | None = None,
        instances: Sequence[Instance] | None = None,
        limits: npt.NDArray[np.int32] | None = None,
    ) -> None:
        state = self._state
        episodes = state.episodes[chosen] if streams is None else np.zeros_like(chosen, np.uint64)
        if streams is None:
            streams, new = state.streams[chosen], ~state.started[chosen]
            if new.any():  # drawn no sooner than here, so that copies of an environment not yet begun differ
                streams[new] = np.random.SeedSequence().generate_state(int(new.sum()), np.uint64)
        seeds = _native.mix(streams, episodes)
        problems = self._source.draw(seeds) if instances is None else self._source.stack(instances, "instances")
        if len(problems.grids) != len(chosen):
            raise ValueError(f"{len(problems.grids)} instances for {len(chosen)} environments: give one for each")
        if limits is None:
            limits = np.full(len(chosen), self.config.max_cycles, np.int32)
        self.stepper.begin(chosen, seeds, limits, *problems)
        state.streams[chosen], state.episodes[chosen] = streams, episodes + np.uint64(1)

    @overload
    def step(
        self, actions: npt.ArrayLike, out: Observation | None = None, *, observe: Literal[True] = True
    ) -> Step[Observation]: ...

    @overload
    def step(self, actions: npt.ArrayLike, out: None = None, *, observe: Literal[False]) -> Step[None]: ...

    def step(self, actions: npt.ArrayLike, out: Observation | None = None, *, observe: bool = True) -> Step[Any]:
        """Shield and execute the joint actions (B, N), integers 0..4.

        Args:
            actions: One of the five actions for each robot; under the shield "pibt" alternatively a score for each of
                them, (B, N, 5), for example logits: the greatest is preferred.
            out: Arrays for the observation (NumPy arrays or torch tensors on the CPU, shaped as in `buffers()`), which
                are then returned. New arrays if not given.
            observe: False writes no observation, for loops that use `bag`; teams that have ended are then left as they
                are, whatever their actions.

        Raises:
            ValueError: If the shape is wrong or an action is out of range.
            TypeError: If the actions are not integers, or `out` has the wrong dtype.
            RuntimeError: Before the first reset, or, if the step is observed, if a team has ended and was not reset.
        """
        if not arguments.flag(observe, "observe") and out is not None:
            raise ValueError("a step without observation needs no arrays for it: leave out the argument out")
        observation = (self.buffers() if out is None else out) if observe else None
        final = self.advance(arguments.numbers(actions, "actions"), observation)
        state = self._state
        return Step(
            observation,
            state.rewards.copy(),
            state.terminated.copy(),
            state.truncated.copy(),
            state.replaced.copy(),
            state.arrived.copy(),
            final,
        )

    def assign_goals(self, goals: npt.ArrayLike) -> None:
        """Set the robots' goals between two steps, as a task dispatcher does; `observe` then shows them.

        In lifelong tasks these goals replace those that the environment has drawn for robots that have arrived. Two
        robots may have the same goal.

        Args:
            goals: (B, N, 2) the goals of all robots; those of absent robots are ignored.

        Raises:
            ValueError: If the shape is wrong, or a goal is not a free cell that its robot can reach.
            TypeError: If the goals are not integers.
            RuntimeError: Before the first reset.
        """
        if not self.began:
            raise RuntimeError("there are no robots before the first reset: call reset()")
        state = self._state
        wanted = arguments.cells(goals, "goals", "(B, N, 2)")
        if wanted.shape != state.goals.shape:
            raise ValueError(f"goals must have shape {state.goals.shape}, got {wanted.shape}")
        changed = self.present & (wanted != state.goals).any(axis=2)
        teams = np.flatnonzero(changed.any(axis=1))
        ways = [self._ways_to(int(b), np.flatnonzero(changed[b]), wanted[b]) for b in teams]
        for b, (tables, corners) in zip(teams, ways, strict=True):
            state.goals[b, changed[b]] = wanted[b, changed[b]]
            if state.distances.size:
                state.distances[b, changed[b]], state.corners[b, changed[b]] = tables, corners
        state.on_goal[changed] = (state.positions == state.goals).all(axis=2)[changed]

    def _ways_to(self, b: int, robots: npt.NDArray[np.intp], goals: npt.NDArray[np.int32]) -> tuple[Any, Any]:
        """Return tables and corners of K robots of team b for their goals, which must be free and within reach."""
        state = self._state
        height, width = state.grids.shape[1:]
        for robot in robots.tolist():
            row, col = goals[robot].tolist()
            if not (0 <= row < height and 0 <= col < width) or state.grids[b, row, col]:
                raise ValueError(f"the goal ({row}, {col}) of agent {robot} in environment {b} is not a free cell")
        tables, corners, reached = self.stepper.ways_to(b, robots, np.ascontiguousarray(goals[robots]))
        if not reached.all():
            robot = int(robots[np.flatnonzero(~reached)[0]])
            row, col = goals[robot].tolist()
            raise ValueError(f"agent {robot} in environment {b} cannot reach the goal ({row}, {col}) from where it is")
        return tables, corners

    def advance(self, actions: npt.NDArray[Any], out: Observation | None) -> Observation | None:
        """Do `step` without copying the outcome, which stays in the state; return the final observation."""
        if self.autoreset is AutoresetMode.DISABLED:
            self._execute(actions, out, skip_ended=out is None and self.began)
            return None
        state = self._state
        due = state.ended.copy()
        self._execute(actions, out, skip_ended=self.began)
        final = None
        if self.autoreset is AutoresetMode.SAME_STEP:
            due = state.ended.copy()
            if due.any() and out is not None:
                final = Observation(*(np.asarray(part)[due] for part in out))
        if due.any():
            self._begin(np.flatnonzero(due))
            if out is not None:
                self._write_observation(out, due)
        return final

    def _execute(self, actions: npt.NDArray[Any], out: Observation | None, *, skip_ended: bool) -> None:
        step: Callable[..., None]
        if actions.ndim == 3:
            step, wanted = self.stepper.step_by_scores, rules.as_scores(actions)
        elif actions.ndim == 2:
            step, wanted = self.stepper.step, rules.as_actions(actions)
        else:
            raise ValueError(f"actions must have shape ({self.num_envs}, {self.num_agents}), got {actions.shape}")
        step(wanted, out, skip_ended)

    def observe(self, out: Observation | None = None) -> Observation:
        """Return the current observation.

        Raises:
            RuntimeError: Before the first reset.
        """
        if not self.began:
            raise RuntimeError("there is nothing to observe before the first reset: call reset()")
        return self._observe(out)

    def _observe(self, out: Observation | None) -> Observation:
        observation = self.buffers() if out is None else out
        self._write_observation(observation, None)
        return observation

    def _write_observation(self, out: Observation, chosen: npt.NDArray[np.bool_] | None) -> None:
        self.stepper.observe(out, chosen)

    def bag(self, mask: npt.NDArray[np.bool_] | None = None) -> Bag:
        """Return the observation of the running teams as one bag; `Bag.team` is the environment.

        A team runs from its reset to its end.

        Args:
            mask: (B,) take only these of them.
        """
        return Bag(*self.stepper.bag(None if mask is None else self._checked_mask(mask)))

    def states(self, mask: npt.NDArray[np.bool_] | None = None) -> States:
        """Return copies of the joint states of all teams, or of those in `mask` (B,); `States.maps` is the environment.

        Raises:
            RuntimeError: Before the first reset.
        """
        if not self.began:
            raise RuntimeError("there are no states before the first reset: call reset()")
        chosen = np.arange(self.num_envs) if mask is None else np.flatnonzero(self._checked_mask(mask))
        state, sizes = self._state, self._state.team_sizes[chosen]
        robots = np.arange(self.num_agents) < sizes[:, None]
        return States(
            maps=chosen.astype(np.int32),
            offsets=np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes, dtype=np.int64)]),
            positions=state.positions[chosen][robots],
            goals=state.goals[chosen][robots],
            moves=state.moves[chosen][robots],
            under_way=state.under_way[chosen][robots],
            seeds=state.seeds[chosen],
            times=state.times[chosen].astype(np.int32),
            limits=state.max_cycles[chosen],
            comm_radius=state.comm_radius[chosen],
        )

    def edges(self, graph: npt.NDArray[np.float32]) -> rules.Edges:
        """Return the graph (B, N, N) of an observation as lists of edges, with each neighbour's relative position."""
        return rules.communication_edges(graph, self._state.positions)

    def on_goal(self) -> npt.NDArray[np.bool_]:
        """Return the robots (B, N) that stand on their goals."""
        return self._state.on_goal.copy()

    def action_mask(self) -> npt.NDArray[np.int8]:
        """Return (B, N, 5), 1 for each action that stays on free cells; absent robots may idle."""
        self.stepper.write_action_masks()
        return self._state.action_mask.copy()

    def _checked_seeds(self, seed: int | Sequence[int]) -> npt.NDArray[np.uint64]:
        if isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str | bytes):
            seeds = [arguments.integer(each, f"seed[{b}]") for b, each in enumerate(seed)]
        else:
            first = arguments.integer(seed, "seed")
            seeds = [first + b for b in range(self.num_envs)]
        if len(seeds) != self.num_envs or not all(0 <= each < 2**64 for each in seeds):
            raise ValueError(f"give one non-negative seed or {self.num_envs} of them, below 2**64, got {seed!r}")
        return np.array(seeds, np.uint64)

    def _checked_limits(self, max_cycles: int | Sequence[int]) -> npt.NDArray[np.int32]:
        given = max_cycles if isinstance(max_cycles, Sequence | np.ndarray) else [max_cycles] * self.num_envs
        limits = [arguments.integer(each, "max_cycles", 1, arguments.MOST_INT) for each in given]
        if len(limits) != self.num_envs:
            raise ValueError(f"give one max_cycles or {self.num_envs} of them, got {len(limits)}")
        return np.array(limits, np.int32)

    def _checked_mask(self, mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        array = arguments.array(mask, "mask")
        if array.shape != (self.num_envs,) or array.dtype != np.bool_:
            raise ValueError(f"mask must be bool of shape ({self.num_envs},), got {array.dtype} of shape {array.shape}")
        return array
