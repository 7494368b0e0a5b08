"""The methods that can be played on POGEMA's instances: policies, PIBT, greedy robots and LaCAM, each by name.

A method is written as its name and options with commas between them: "pibt", "lacam,2", "rolling,200",
"n12-informed,argmax".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import experts
from experts import arguments
from gnn_policy import Actor, Execution, checkpoint, rollout
from gnn_policy.baselines import GreedyActor
from gnn_policy.rollout import PolicyActor
from mapf_env import BatchedEnv, Instance, instance_hash
from mapf_env.config import Shield

TEAMS_OF_A_WORKER = 8
"""Teams that a worker of a cluster plays at a time; outcomes do not depend on it."""
FIRST_PLAN_LIMIT = 2.0
"""Seconds that LaCAM may take for a plan where no time is given."""


@dataclass(frozen=True, eq=False)
class Played:
    """The outcomes of C teams by the benchmark's rules."""

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
    """Everything that its results depend on besides the instances, T and the seed."""
    play: Callable[[Sequence[Instance], int, int], Played]
    """Play instances of any map sizes for at most T steps with a seed."""
    serve: Callable[[Sequence[Instance], Sequence[npt.NDArray[np.int32]], int, int], list[int]] | None
    """Serve goals forever: instances of one team size, the goals (N, K, 2) that follow the instance's, steps and a seed
    in, the number of arrivals of each out; None if the method cannot."""


def method_named(words: str, cluster: str | None = None) -> Method:
    """Return the method of the given words.

    Args:
        words: Its name and options.
        cluster: The address of a Ray cluster that plays one-shot teams of policies, PIBT and greedy robots.

    Raises:
        ValueError: If an option is unknown, or a policy is damaged.
        OSError: If the policy does not exist.
    """
    name, _, options = ("", "", "") if Path(words).exists() else words.partition(",")
    if name in SHIELDS and not options:
        return _step_by_step(name, {}, GreedyActor(shield=SHIELDS[name]), cluster)
    if name == "lacam":
        return _lacam(words, options)
    if name == "rolling":
        return _rolling(words, options)
    if name in SHIELDS:
        raise ValueError(f"{name} has no options, got {words!r}")
    return _policy(name or words, options, cluster)


SHIELDS: dict[str, Shield] = {"greedy": "idle", "pibt": "pibt", "pibt_swap": "pibt_swap"}
"""Robots that always want a cell closest to their goal: greedy ones, and those of PIBT (Okumura et al. 2022), also with
swap (Okumura 2023)."""


def _policy(path: str, row: str, cluster: str | None) -> Method:
    policy = checkpoint.load(path)
    execution = Execution.parse(row, policy.execution) if row else policy.execution
    name = f"{Path(path).name.removesuffix('.safetensors')} {execution.name}"
    settings = {"policy": checkpoint.fingerprint(policy), "row": execution.name}
    return _step_by_step(name, settings, PolicyActor(policy.eval(), execution), cluster)


def _step_by_step(name: str, settings: Mapping[str, object], actor: Actor, cluster: str | None) -> Method:
    """Play by an actor in the environment, so that teams that fail have paths, too."""

    where: dict[str, Any] = {} if cluster is None else {"cluster": cluster, "batch_size": TEAMS_OF_A_WORKER}

    def play(instances: Sequence[Instance], max_steps: int, seed: int) -> Played:
        played = rollout(actor, instances, seed=seed, max_steps=max_steps, **where)
        steps = np.array([len(solution.paths) - 1 for solution in played.solutions], np.int64)
        return Played(played.success, played.on_goal, played.flowtime, played.makespan, steps)

    def serve(
        instances: Sequence[Instance], goals: Sequence[npt.NDArray[np.int32]], steps: int, seed: int
    ) -> list[int]:
        return arrivals(instances, actor, goals, steps, seed)

    return Method(name, settings, play, serve)


def arrivals(
    instances: Sequence[Instance], actor: Actor, goals: Sequence[npt.NDArray[np.int32]], steps: int, seed: int
) -> list[int]:
    """Play teams of one size for that many steps; return how often the robots of each come to their goals.

    A robot that arrives gets the next of its K `goals` (N, K, 2).
    """
    env = BatchedEnv(
        len(instances),
        num_agents=instances[0].num_agents,
        height=max(each.grid.shape[0] for each in instances),
        width=max(each.grid.shape[1] for each in instances),
        style="empty",
        fill=True,
        max_cycles=steps,
        task="lifelong",
        **actor.env_settings(),
    )
    env.reset([_seed(each, seed) for each in instances], instances=instances, observe=False)
    to_come, given = np.stack(goals), np.zeros((len(instances), env.num_agents), np.int64)
    while env.running.any():
        current = env.goals
        arrived = env.step(actor.act(env), observe=False).arrived
        team, robot = np.nonzero(arrived)
        if len(team):
            current[arrived] = to_come[team, robot, given[arrived]]
            given[arrived] += 1
            env.assign_goals(current)
    return given.sum(axis=1).tolist()


def _seed(instance: Instance, seed: int) -> int:
    """Return the seed of the environment for one instance, whatever else is played."""
    return int(np.random.SeedSequence([seed, int(instance_hash(instance)[:16], 16)]).generate_state(1, np.uint64)[0])


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
        return outcomes_of(instances, plans, max_steps)

    return Method(words, {"w": str(w), "time_limit": seconds}, play, None)


class RollingActor:
    """The planner with a rolling horizon as the actor of one team."""

    def __init__(self, instance: Instance, rounds: int, seed: int) -> None:
        self._planner = experts.RollingHorizon(instance.grid, rounds=rounds, seed=_seed(instance, seed))

    def env_settings(self) -> dict[str, object]:
        """Return the settings of an environment in which robots perceive nothing that costs time."""
        return {"fov_radius": 1, "comm_radius": 0.0}

    def act(self, env: BatchedEnv) -> npt.NDArray[np.int8]:
        """Return the planner's joint move (1, N)."""
        return self._planner.act(env.positions[0], env.goals[0])[None]


def _rolling(words: str, options: str) -> Method:
    """Play with a rolling horizon; the option is the number of rounds for each plan."""
    if options and not options.isdecimal():
        raise ValueError(f"the option of rolling is a number of rounds, got {words!r}")
    rounds = int(options) if options else arguments.DEFAULT_WINDOW_ROUNDS

    def play(instances: Sequence[Instance], max_steps: int, seed: int) -> Played:
        trips = [
            rollout(RollingActor(each, rounds, seed), [each], seed=seed, max_steps=max_steps).solutions[0].paths
            for each in instances
        ]
        return outcomes_of(instances, trips, max_steps)

    def serve(
        instances: Sequence[Instance], goals: Sequence[npt.NDArray[np.int32]], steps: int, seed: int
    ) -> list[int]:
        return [
            arrivals([instance], RollingActor(instance, rounds, seed), [own], steps, seed)[0]
            for instance, own in zip(instances, goals, strict=True)
        ]

    return Method(words, {"rounds": rounds, "window": arguments.DEFAULT_WINDOW}, play, serve)


def outcomes_of(instances: Sequence[Instance], paths: Sequence[npt.NDArray[np.integer]], max_steps: int) -> Played:
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
