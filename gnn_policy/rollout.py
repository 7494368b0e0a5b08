"""Rollouts of teams under a policy: executed paths and their quality."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from experts.cluster import connect
from gnn_policy.acting import scores_of
from gnn_policy.cases import Task
from gnn_policy.execution import Execution, episode_noise, episode_seeds
from gnn_policy.finite import require_finite
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.policy_config import PolicyConfig
from mapf_env import Action, BatchedEnv, Instance, Solution, arguments

_MOST_BYTES = 2**28
"""Limit on the memory for the distance tables of teams that are played at the same time."""


@runtime_checkable
class Actor(Protocol):
    """A class of your own that chooses the moves of many teams at once."""

    def env_settings(self) -> dict[str, Any]:
        """Return the settings of the environment that it acts in, fields of `mapf_env.EnvConfig`: senses and shield."""
        ...

    def act(self, env: BatchedEnv) -> npt.NDArray[Any]:
        """Return joint actions (B, N), or with a PIBT shield scores (B, N, 5); ended teams' are ignored."""
        ...


class PolicyActor:
    """A network, executed in one way; it gives the scores (B, N, 5) of the moves.

    Raises:
        TypeError: If the network has no `config`.
        ValueError: If its weights are not finite.
    """

    def __init__(self, policy: nn.Module, execution: Execution) -> None:
        config = getattr(policy, "config", None)
        if not isinstance(config, PolicyConfig):
            kind = type(policy).__name__
            raise TypeError(
                f"{kind} does not say what its robots perceive: give it a `config`, as {kind}.config = "
                "gnn_policy.PolicyConfig(fov_radius=4, comm_radius=5.0)"
            )
        weights = policy.state_dict() if isinstance(policy, DecentralizedPolicy) else dict(policy.named_parameters())
        require_finite(weights)
        self.policy, self.config, self.execution = policy, config, execution

    def env_settings(self) -> dict[str, Any]:
        """Return what the policy's robots perceive and how they are shielded."""
        return self.execution.env_settings(self.config)

    def act(self, env: BatchedEnv) -> npt.NDArray[Any]:
        """Observe, communicate and score the moves."""
        robots = env.present & env.running[:, None]
        team, robot = np.nonzero(robots)
        noise = episode_noise(env.seeds[team], env.times[team], robot)
        scores = np.zeros((*robots.shape, len(Action)), np.float32)
        scores[robots] = scores_of(self.policy, env.bag(), self.execution, noise)
        return scores if self.execution.shield != "idle" else scores.argmax(-1)


@dataclass(frozen=True, slots=True, eq=False)
class Rollouts:
    """The outcomes of C teams."""

    instances: list[Instance]
    """The C instances."""
    solutions: list[Solution]
    """The executed paths: up to the first time that all robots were on their goals, or to max_steps."""
    goals: list[npt.NDArray[np.int32]]
    """For each team (T + 1, N, 2), the robots' goals at each time of its path; (1, N, 2) where they never change."""
    success: npt.NDArray[np.bool_]
    """(C,) all robots were on their goals at once within max_steps; never in lifelong tasks."""
    flowtime: npt.NDArray[np.int64]
    """(C,) the sum over robots of the last arrival; a robot that is not on its goal at the end counts max_steps."""
    makespan: npt.NDArray[np.int64]
    """(C,) the last arrival of all; max_steps if the team failed."""
    on_goal: npt.NDArray[np.float64]
    """(C,) the share of robots that are on their goals at the end (ISR)."""
    latched: npt.NDArray[np.bool_]
    """(C,) every robot touched its goal at least once (what the authors' code counts as success)."""
    replaced: npt.NDArray[np.float64]
    """(C,) the share of actions that the shield replaced."""
    throughput: npt.NDArray[np.float64]
    """(C,) arrivals of all robots per step."""


def rollout(
    policy: nn.Module | Actor,
    instances: Sequence[Instance],
    *,
    task: Task = "one_shot",
    execution: Execution | None = None,
    message_loss: float = 0.0,
    seed: int | Sequence[int] = 0,
    max_steps: int | Sequence[int] | npt.NDArray[np.integer] = 128,
    batch_size: int = 256,
    cluster: str | None = None,
) -> Rollouts:
    """Play `instances` under a policy and the collision shield; no expert is needed.

    Teams and maps of any sizes can be played in one call. The outcome of a team depends only on the policy, its
    instance, its seed and its max_steps: not on its place in the list, and not on the other teams.

    Args:
        policy: A policy; or a network of your own that maps a bag of robots (`mapf_env.Bag`, as tensors) to logits
            (M, 5) and has a `config`, a `PolicyConfig` that says what its robots perceive; or an `Actor`.
        instances: The problems to play.
        task: "one_shot", or "lifelong": a robot that arrives gets a new goal, until max_steps.
        execution: The choice of actions, the shield and the communication; the policy's own (`policy.execution`) if
            not given. An `Actor` brings its own settings.
        message_loss: The probability that a link fails in a step.
        seed: Random seed for sampling and the shield's tie-breaking, one for all instances or one for each.
        max_steps: T_max, one for all instances or one for each.
        batch_size: Maximum number of teams to play at a time; it does not change the outcome.
        cluster: The address of a Ray cluster whose workers play the batches, one thread each, as in
            `experts.solve_many`; the policy must be on the CPU. `"local"` starts as many workers as `torch` has
            threads.

    Raises:
        ValueError: If an argument is out of range, the policy needs more memory than there is for one team, or a policy
            for a cluster is not on the CPU.
        TypeError: If `policy` is neither a network nor an actor.
    """
    instances = list(arguments.each_of(instances, Instance, "instances"))
    if not instances:
        raise ValueError("there are no instances to play")
    if execution is not None:
        arguments.instance_of(execution, Execution, "execution")
    if batch_size < 1:
        raise ValueError(f"batch_size must be at least 1, got {batch_size}")
    limits = np.array(_one_for_each("max_steps", max_steps, len(instances)), np.int64)
    if (limits < 1).any():
        raise ValueError(f"max_steps must be at least 1, got {limits.min()}")
    seeds = episode_seeds(instances, _one_for_each("seed", seed, len(instances)))
    actor = _actor(policy, execution)
    settings = {**actor.env_settings(), "task": task, "message_loss": message_loss}
    was_training = isinstance(policy, nn.Module) and policy.training
    played: list[_Played | None] = [None] * len(instances)
    try:
        if isinstance(policy, nn.Module):
            policy.eval()
        batches = list(_batches(instances, batch_size, task))
        teams = (([instances[i] for i in chosen], seeds[chosen], limits[chosen]) for chosen in batches)
        play = partial(_play, actor, settings)
        outcomes = map(play, teams) if cluster is None else _on_cluster(play, teams, policy, cluster)
        for chosen, batch in zip(batches, outcomes, strict=True):
            for i, outcome in zip(chosen, batch, strict=True):
                played[i] = outcome
    finally:
        if isinstance(policy, nn.Module):
            policy.train(was_training)
    return _summarise(
        list(instances), [each or _Played.at_once(i) for each, i in zip(played, instances, strict=True)], limits, task
    )


def _actor(policy: nn.Module | Actor, execution: Execution | None) -> Actor:
    if isinstance(policy, nn.Module):
        own: Execution = getattr(policy, "execution", Execution())
        return PolicyActor(policy, own if execution is None else execution)
    if not isinstance(policy, Actor):
        raise TypeError(
            f"rollout plays a network or an actor, got {type(policy).__name__}: an actor has `env_settings` and `act` "
            "(gnn_policy.Actor)"
        )
    if execution is not None:
        raise ValueError(f"{type(policy).__name__} is an actor and brings its own settings: leave execution out")
    return policy


def _one_for_each(name: str, given: int | Sequence[int] | npt.NDArray[np.integer], count: int) -> list[int]:
    values = [int(given)] if isinstance(given, int | np.integer) else [int(each) for each in given]
    if len(values) not in (1, count):
        raise ValueError(f"{len(values)} values of {name} for {count} instances: give one, or one for each")
    return values * count if len(values) == 1 else values


def _batches(instances: Sequence[Instance], batch_size: int, task: Task) -> Iterator[npt.NDArray[np.intp]]:
    """Yield the numbers of instances to play together: of similar sizes, as arrays are as large as the largest.

    Instances that are solved at the start are left out of one-shot tasks. In lifelong tasks the maps of a batch have
    one size: new goals are drawn on the map as it is filled up.
    """
    areas = np.array([each.grid.size for each in instances])
    heights = np.array([each.grid.shape[0] for each in instances])
    robots = np.array([each.num_agents for each in instances])
    open_ = [task == "lifelong" or not np.array_equal(each.starts, each.goals) for each in instances]
    order = np.lexsort((robots, heights, areas))
    order = order[np.array(open_)[order]]
    first = 0
    while first < len(order):
        last = first + 1
        most_robots = robots[order[first]]
        while last < len(order) and last - first < batch_size:
            most_robots = max(most_robots, robots[order[last]])
            if task == "lifelong" and instances[order[last]].grid.shape != instances[order[first]].grid.shape:
                break
            if 2 * areas[order[last]] * most_robots * (last - first + 1) > _MOST_BYTES:
                break
            last += 1
        yield order[first:last]
        first = last


@dataclass(frozen=True, slots=True, eq=False)
class _Played:
    """The run of one team of n robots over T steps."""

    paths: npt.NDArray[np.int32]
    """(T + 1, n, 2)"""
    goals: npt.NDArray[np.int32]
    """(T + 1, n, 2), or (1, n, 2) where they never change."""
    replaced: int
    """Number of actions that the shield replaced."""
    arrivals: npt.NDArray[np.int64]
    """(n,) number of times each robot has moved onto its goal."""

    @staticmethod
    def at_once(instance: Instance) -> _Played:
        """Return the run of a team that starts on its goals."""
        return _Played(instance.starts[None], instance.goals[None], 0, np.zeros(instance.num_agents, np.int64))


Teams = tuple[Sequence[Instance], npt.NDArray[np.uint64], npt.NDArray[np.int64]]
"""Instances to play together, their seeds and their limits."""


def _on_cluster(
    play: Callable[[Teams], list[_Played]], batches: Iterable[Teams], policy: nn.Module | Actor, cluster: str
) -> Iterator[list[_Played]]:
    if isinstance(policy, nn.Module) and any(weight.device.type != "cpu" for weight in policy.parameters()):
        raise ValueError('the workers of a cluster play on their CPUs: move the policy there by policy.to("cpu")')
    with connect(cluster, workers=torch.get_num_threads()) as workers:
        yield from workers.map(play, batches)


def _play(actor: Actor, settings: dict[str, Any], teams: Teams) -> list[_Played]:
    """Play instances together until the last team has ended."""
    instances, seeds, limits = teams
    lifelong = settings["task"] == "lifelong"
    env = BatchedEnv(
        len(instances),
        fill=True,
        num_agents=max(each.num_agents for each in instances),
        height=max(each.grid.shape[0] for each in instances),
        width=max(each.grid.shape[1] for each in instances),
        style="empty",
        **settings,
    )
    env.reset(seeds.tolist(), instances=instances, max_cycles=limits.tolist())
    paths, goals = [env.positions], [env.goals]
    steps, replaced = (np.zeros(len(instances), np.int64) for _ in range(2))
    arrivals = np.zeros((len(instances), env.num_agents), np.int64)
    while (running := env.running).any():
        actions = actor.act(env)
        if not np.isfinite(actions).all():
            raise ValueError(f"{type(actor).__name__}.act returned values that are not finite numbers")
        outcome = env.step(actions, observe=False)
        paths.append(env.positions)
        if lifelong:
            goals.append(env.goals)
        steps += running
        replaced += np.where(running, outcome.replaced.sum(axis=1), 0)
        arrivals += running[:, None] & outcome.arrived
    all_paths, all_goals = np.stack(paths, axis=1), np.stack(goals, axis=1)
    return [
        _Played(
            all_paths[b, : steps[b] + 1, : each.num_agents],
            all_goals[b, : steps[b] + 1, : each.num_agents],
            int(replaced[b]),
            arrivals[b, : each.num_agents],
        )
        for b, each in enumerate(instances)
    ]


def _summarise(instances: list[Instance], played: list[_Played], limits: npt.NDArray[np.int64], task: Task) -> Rollouts:
    solutions = [Solution(each.paths) for each in played]
    success, flowtime, makespan, share, latched = [], [], [], [], []
    for run, solution, limit in zip(played, solutions, limits, strict=True):
        on_goal = (run.paths == run.goals).all(axis=2)
        times = np.where(on_goal[-1] & (task == "one_shot"), solution.arrival_times, limit)
        success.append(on_goal[-1].all() and task == "one_shot")
        flowtime.append(times.sum())
        makespan.append(times.max())
        share.append(on_goal[-1].mean())
        latched.append((on_goal[0] | (run.arrivals > 0)).all())
    steps = np.array([max(len(run.paths) - 1, 1) for run in played])
    robots = np.array([each.num_agents for each in instances])
    return Rollouts(
        instances,
        solutions,
        [run.goals for run in played],
        np.array(success),
        np.array(flowtime, np.int64),
        np.array(makespan, np.int64),
        np.array(share),
        np.array(latched),
        np.array([run.replaced for run in played]) / (steps * robots),
        np.array([run.arrivals.sum() for run in played]) / steps,
    )
