"""What can be played on POGEMA's instances: policies, PIBT, greedy robots and LaCAM, each by name.

A method is written as its name and options with commas between them: "pibt", "lacam,2", "rolling,200",
"n12-informed,argmax".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

import experts
from experts import arguments
from gnn_policy import DecentralizedPolicy, Execution, Rollouts, checkpoint, rollout
from gnn_policy.execution import STUCK_MEMORY, hears_of, is_stuck, robot_seeds
from mapf_env import MOVES, BatchedEnv, Instance, Observation, instance_hash

FIRST_PLAN_LIMIT = 2.0
"""Seconds that LaCAM may take for a plan where no time is given."""
LESS_THAN_A_STEP = 0.25
"""Noise that orders equally close cells; a step of the channel "cost_to_go" is 0.5 in a view of radius 1."""

Choose = Callable[[BatchedEnv, Observation], npt.NDArray[np.float32]]
"""Values (1, N, 5) of the moves of a team, the greatest wanted most."""


@dataclass(frozen=True, eq=False)
class Played:
    """What became of C teams by the benchmark's rules."""

    success: npt.NDArray[np.bool_]
    """(C,) all robots are on their goals at once within T (CSR)."""
    home: npt.NDArray[np.float64]
    """(C,) share of the robots that are on their goals at the end (ISR)."""
    flowtime: npt.NDArray[np.int64]
    """(C,) sum of the last arrivals, T for a robot that is off its goal at the end (SoC)."""
    makespan: npt.NDArray[np.int64]
    """(C,) last arrival of all, T if the team fails."""
    steps: npt.NDArray[np.int64]
    """(C,) joint steps until all robots are on their goals, at most T."""


@dataclass(frozen=True, eq=False)
class Method:
    """One row of the tables."""

    name: str
    settings: Mapping[str, object]
    """What its results depend on besides the instances, T and the seed."""
    play: Callable[[Sequence[Instance], int, int], Played]
    """Play instances of any map sizes for at most T steps with a seed."""
    serve: Callable[[Instance, npt.NDArray[np.int32], int, int], int] | None
    """Serve goals for ever: an instance, the goals (N, K, 2) that follow its own, steps and a seed in, the number of
    arrivals out; None if the method cannot."""


def method_named(words: str) -> Method:
    """Return the method of the given words.

    Raises:
        ValueError: If an option is unknown, or a policy is damaged.
        OSError: If there is no such policy.
    """
    name, _, options = ("", "", "") if Path(words).exists() else words.partition(",")
    if name in SHIELDS and not options:
        return _closest_cells(name)
    if name == "lacam":
        return _lacam(words, options)
    if name == "rolling":
        return _rolling(words, options)
    if name in SHIELDS:
        raise ValueError(f"{name} has no options, got {words!r}")
    return _policy(name or words, options)


SHIELDS = {"greedy": "idle", "pibt": "pibt", "pibt_swap": "pibt_swap"}
"""Robots that always want a cell closest to their goal: greedy ones, and those of PIBT (Okumura et al. 2022, 2023)."""


def _closest_cells(name: str) -> Method:
    """Play PIBT or greedy robots in the environment, step by step, so that teams which fail have paths, too."""
    settings = {"fov_radius": 1, "extra_channels": ("cost_to_go",), "shield": SHIELDS[name]}

    def choose_by(instance: Instance, seed: int) -> Choose:
        rng = np.random.default_rng(_seeds(instance, seed)[1])

        def choose(venv: BatchedEnv, observation: Observation) -> npt.NDArray[np.float32]:
            further = observation.fov[:, :, -1, MOVES[:, 0] + 2, MOVES[:, 1] + 2]  # the own cell is (2, 2) of 5 x 5
            return -(further + LESS_THAN_A_STEP * rng.random(further.shape, np.float32))

        return choose

    def play(instances: Sequence[Instance], max_steps: int, seed: int) -> Played:
        trips = [drive(each, choose_by(each, seed), settings, max_steps, seed) for each in instances]
        return judge(instances, [trip.paths for trip in trips], max_steps)

    def serve(instance: Instance, goals: npt.NDArray[np.int32], steps: int, seed: int) -> int:
        return drive(instance, choose_by(instance, seed), settings, steps, seed, goals).arrivals

    return Method(name, {}, play, serve)


def _policy(path: str, row: str) -> Method:
    policy, shield = checkpoint.load(path), checkpoint.trained_with(path).shield
    execution = Execution.parse(row or "stuck", shield)

    def play(instances: Sequence[Instance], max_steps: int, seed: int) -> Played:
        return _rollouts(policy, instances, execution, max_steps, seed)

    def serve(instance: Instance, goals: npt.NDArray[np.int32], steps: int, seed: int) -> int:
        choose, settings = _choose_by_policy(policy, execution, _seeds(instance, seed)[1])
        return drive(instance, choose, settings, steps, seed, goals).arrivals

    name = f"{Path(path).name.removesuffix('.safetensors')} {execution.name}"
    settings = {"policy": checkpoint.fingerprint(policy), "row": execution.name}
    return Method(name, settings, play, serve)


def _choose_by_policy(policy: DecentralizedPolicy, execution: Execution, seed: int) -> tuple[Choose, dict[str, Any]]:
    """How a policy chooses in lifelong play, and the settings of the environment in which it does."""
    config, past = policy.config, list[npt.NDArray[np.int32]]()
    settings = {
        "fov_radius": config.fov_radius,
        "comm_radius": config.comm_radius,
        "comm_range": execution.comm_range or config.comm_range,
        "comm_weights": execution.comm_weights or config.comm_weights,
        "extra_channels": ("cost_to_go",) if config.cost_to_go else (),
        "shield": execution.shield,
    }

    def choose(venv: BatchedEnv, observation: Observation) -> npt.NDArray[np.float32]:
        positions = venv.positions
        earlier = np.stack(past[-STUCK_MEMORY:]) if past else np.empty((0, *positions.shape), positions.dtype)
        with torch.inference_mode():
            logits = policy(torch.from_numpy(observation.fov), torch.from_numpy(observation.graph)).float().numpy()
        alarmed = is_stuck(positions, venv.goals, earlier)
        if config.taps > 1:
            alarmed |= hears_of(alarmed, observation.graph)
        seeds = robot_seeds(np.array([seed], np.uint64), venv.num_agents)
        past.append(positions)
        return execution.values(logits, alarmed, seeds, len(past) - 1)

    return choose, settings


@dataclass(frozen=True, eq=False)
class Trip:
    """One team in the environment."""

    paths: npt.NDArray[np.int32]
    """(steps + 1, N, 2)"""
    arrivals: int
    """How often a robot has come to its goal."""


def drive(
    instance: Instance,
    choose: Choose,
    settings: Mapping[str, Any],
    max_steps: int,
    seed: int,
    goals: npt.NDArray[np.int32] | None = None,
) -> Trip:
    """Play one team in the environment until all are on their goals at once or time is up.

    With `goals` (N, K, 2) the task is lifelong: a robot that arrives gets the next of its K goals.
    """
    height, width = instance.grid.shape
    venv = BatchedEnv(
        1,
        num_agents=instance.num_agents,
        height=height,
        width=width,
        max_cycles=max_steps,
        task="one_shot" if goals is None else "lifelong",
        **settings,
    )
    observation = venv.reset([_seeds(instance, seed)[0]], instances=[instance])
    given = np.zeros(instance.num_agents, np.int64)
    paths = [instance.starts]
    ended = goals is None and bool(venv.on_goal().all())
    while not ended:
        values, current = choose(venv, observation), venv.goals
        step = venv.step(values.argmax(-1) if venv.config.shield == "idle" else values, observe=False)
        if goals is not None and step.arrived.any():
            arrived = np.flatnonzero(step.arrived[0])
            current[0, arrived] = goals[arrived, given[arrived]]
            given[arrived] += 1
            venv.assign_goals(current)
        observation = venv.observe()
        paths.append(venv.positions[0])
        ended = bool(step.terminated[0] or step.truncated[0])
    return Trip(np.stack(paths), int(given.sum()))


def _seeds(instance: Instance, seed: int) -> tuple[int, int]:
    """Seeds of the environment and of the robots' draws for one instance, whatever is played beside it."""
    first, second = np.random.SeedSequence([seed, int(instance_hash(instance)[:16], 16)]).generate_state(2, np.uint64)
    return int(first), int(second)


def _lacam(words: str, options: str) -> Method:
    try:
        seconds = float(options or FIRST_PLAN_LIMIT)
    except ValueError:
        raise ValueError(f"the option of lacam is a number of seconds for improving its plan, got {words!r}") from None
    if not 0 < seconds < math.inf:
        raise ValueError(f"lacam needs a positive number of seconds, got {words!r}")
    w = 1.0 if options else math.inf

    def play(instances: Sequence[Instance], max_steps: int, seed: int) -> Played:
        results = [experts.lacam(each, w=w, time_limit=seconds, seed=seed) for each in instances]
        plans = [
            each.starts[None] if result.solution is None else result.solution.paths
            for each, result in zip(instances, results, strict=True)
        ]
        return judge(instances, plans, max_steps)

    return Method(words, {"w": str(w), "time_limit": seconds}, play, None)


def _rolling(words: str, options: str) -> Method:
    """Play with a rolling horizon; the option is the number of rounds for each plan."""
    if options and not options.isdecimal():
        raise ValueError(f"the option of rolling is a number of rounds, got {words!r}")
    rounds = int(options) if options else arguments.DEFAULT_WINDOW_ROUNDS
    settings = {"fov_radius": 1, "shield": "idle"}

    def choose_by(instance: Instance, seed: int) -> Choose:
        planner = experts.RollingHorizon(instance.grid, rounds=rounds, seed=_seeds(instance, seed)[1])

        def choose(venv: BatchedEnv, observation: Observation) -> npt.NDArray[np.float32]:
            return np.eye(len(MOVES), dtype=np.float32)[planner.act(venv.positions[0], venv.goals[0])][None]

        return choose

    def play(instances: Sequence[Instance], max_steps: int, seed: int) -> Played:
        trips = [drive(each, choose_by(each, seed), settings, max_steps, seed) for each in instances]
        return judge(instances, [trip.paths for trip in trips], max_steps)

    def serve(instance: Instance, goals: npt.NDArray[np.int32], steps: int, seed: int) -> int:
        return drive(instance, choose_by(instance, seed), settings, steps, seed, goals).arrivals

    return Method(words, {"rounds": rounds, "window": arguments.DEFAULT_WINDOW}, play, serve)


def judge(instances: Sequence[Instance], paths: Sequence[npt.NDArray[np.integer]], max_steps: int) -> Played:
    """Apply the benchmark's rules to paths (T + 1, N, 2) of each team; what lies beyond `max_steps` is cut off.

    A team whose paths end earlier stays where it is.
    """
    rows = []
    for instance, path in zip(instances, paths, strict=True):
        on_goal = (path[: max_steps + 1] == instance.goals).all(axis=2)
        arrivals = np.array([0 if each.all() else np.flatnonzero(~each)[-1] + 1 for each in on_goal.T])
        times = np.where(on_goal[-1], arrivals, max_steps)
        home = on_goal[-1].mean()
        steps = len(on_goal) - 1 if home == 1.0 else max_steps
        rows.append((home == 1.0, home, times.sum(), times.max(), steps))
    columns = zip(*rows, strict=True)
    return Played(*(np.array(column, kind) for column, kind in zip(columns, (bool, float, int, int, int), strict=True)))


def _rollouts(
    policy: DecentralizedPolicy, instances: Sequence[Instance], execution: Execution, max_steps: int, seed: int
) -> Played:
    """Play instances of several map sizes, those of one size at a time."""
    sizes = [instance.grid.shape for instance in instances]
    groups = [[case for case, size in enumerate(sizes) if size == each] for each in dict.fromkeys(sizes)]
    parts = [
        _of_rollouts(
            rollout(policy, [instances[i] for i in cases], seed=seed, max_steps=max_steps, **asdict(execution))
        )
        for cases in groups
    ]
    order = np.argsort(np.concatenate(groups))
    return Played(*(np.concatenate(columns)[order] for columns in zip(*map(_columns, parts), strict=True)))


def _columns(played: Played) -> list[npt.NDArray[Any]]:
    return [getattr(played, each.name) for each in fields(played)]


def _of_rollouts(played: Rollouts) -> Played:
    ends = [solution.paths[-1] for solution in played.solutions]
    home = [(end == each.goals).all(axis=1).mean() for end, each in zip(ends, played.instances, strict=True)]
    steps = [len(solution.paths) - 1 for solution in played.solutions]
    return Played(played.success, np.array(home), played.flowtime, played.makespan, np.array(steps, np.int64))
