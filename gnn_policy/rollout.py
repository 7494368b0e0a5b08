"""Teams under a policy, from their starts to the end: the executed paths and how good they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
import torch

from gnn_policy.network import DecentralizedPolicy
from mapf_env import MOVES, Instance, Solution, _native, rules

Shield = Literal["idle", "pibt"]
Cases = npt.NDArray[np.intp]


class Actor(Protocol):
    """What chooses the moves of many teams at once. `cases` (B,) says which of the instances the teams play."""

    border: int
    """Cells of obstacles around the maps that `act` receives; at least the radius that it observes with."""

    def act(
        self, cases: Cases, obstacles: rules.Bordered, positions: rules.Positions, goals: rules.Positions, time: int
    ) -> npt.NDArray[Any]:
        """Joint actions (B, N) for teams at `positions` (B, N, 2) at `time`; under PIBT also values (B, N, 5)."""
        ...


class PolicyActor:
    """A trained policy: the most probable move of each robot, or one drawn from the softmax.

    With `preferences` it gives its logits instead, (B, N, 5), for the PIBT shield to choose in their order; with
    `sample` that order is drawn from the softmax, move after move without replacement (by Gumbel noise).

    A draw depends on the seed, the case's place in the list, the time and the robot, not on how cases are batched.
    """

    def __init__(
        self,
        policy: DecentralizedPolicy,
        *,
        sample: bool = False,
        temperature: float = 1.0,
        seed: int = 0,
        preferences: bool = False,
    ) -> None:
        if not temperature > 0:
            raise ValueError(
                f"temperature must be positive, got {temperature}; for the most probable move: sample=False"
            )
        self.policy, self.sample, self.temperature, self.seed = policy, sample, temperature, seed
        self.border = policy.config.fov_radius
        self.preferences = preferences

    def act(
        self, cases: Cases, obstacles: rules.Bordered, positions: rules.Positions, goals: rules.Positions, time: int
    ) -> npt.NDArray[Any]:
        """Observe, communicate and decide."""
        config = self.policy.config
        device = self.policy.head.weight.device
        teams = len(cases)
        padded = np.arange(_padded_size(teams)).clip(max=teams - 1)
        fov = rules.observe(obstacles[padded], positions[padded], goals[padded], config.fov_radius)
        graph = rules.communication_graph(positions[padded], config.comm_radius)
        with torch.inference_mode():
            logits = self.policy(torch.from_numpy(fov).to(device), torch.from_numpy(graph).to(device))[:teams].cpu()
        if self.preferences:
            draws = uniform(self.seed, cases, time, logits.shape[1] * logits.shape[2]).reshape(logits.shape)
            gumbel = -np.log(-np.log(draws.clip(1e-12, 1 - 1e-12))) if self.sample else np.zeros(1)
            return logits.float().numpy() / self.temperature + gumbel.astype(np.float32)
        if not self.sample:
            return logits.argmax(-1).numpy()
        cumulative = torch.softmax(logits / self.temperature, -1).cumsum(-1).numpy()
        draws = uniform(self.seed, cases, time, positions.shape[1])
        return np.minimum((draws[..., None] >= cumulative).sum(-1), cumulative.shape[-1] - 1)


def _padded_size(teams: int) -> int:
    """The next of few batch sizes: the convolution library prepares itself anew for each size it meets."""
    return 1 << (teams - 1).bit_length() if teams < 32 else -(-teams // 32) * 32


class GreedyActor:
    """Every robot takes a move that shortens its way, drawn if there are several; it knows the map, but no robots."""

    def __init__(self, instances: Sequence[Instance], *, seed: int = 0) -> None:
        self.seed, self.border = seed, 1
        self.distances = np.stack([_native.distances(each.grid, each.goals) for each in instances])

    def act(
        self, cases: Cases, obstacles: rules.Bordered, positions: rules.Positions, goals: rules.Positions, time: int
    ) -> npt.NDArray[np.int64]:
        """The move to the neighbouring cell nearest to the goal; idle on the goal."""
        del obstacles, goals
        neighbours = positions[:, :, None, :] + MOVES
        height, width = self.distances.shape[2:]
        rows, cols = neighbours[..., 0].clip(0, height - 1), neighbours[..., 1].clip(0, width - 1)
        team, robot = np.ogrid[: len(cases), : positions.shape[1]]
        steps = self.distances[cases[team, None], robot[..., None], rows, cols]
        inside = (neighbours == np.stack([rows, cols], -1)).all(-1)
        draws = uniform(self.seed, cases, time, positions.shape[1] * len(MOVES)).reshape(steps.shape)
        return np.where(inside & (steps >= 0), steps + draws, np.inf).argmin(-1)


def uniform(seed: int, cases: Cases, time: int, count: int) -> npt.NDArray[np.float64]:
    """Draws (B, count) from [0, 1) for B cases at a time, a function of the arguments alone."""
    streams = _native.mix(np.full(len(cases), seed, np.uint64), cases.astype(np.uint64))
    counters = np.uint64(time * count) + np.arange(count, dtype=np.uint64)
    words = _native.mix(np.repeat(streams, count), np.tile(counters, len(cases)))
    return (words >> np.uint64(11)).astype(np.float64).reshape(-1, count) * 2.0**-53


@dataclass(frozen=True, slots=True, eq=False)
class Rollouts:
    """What became of C teams."""

    instances: list[Instance]
    """The C instances."""
    solutions: list[Solution]
    """The executed paths, up to the first time that all robots were on their goals, or to max_steps."""
    success: npt.NDArray[np.bool_]
    """(C,) all robots were on their goals at once within max_steps."""
    flowtime: npt.NDArray[np.int64]
    """(C,) the sum over robots of the last arrival; a robot that is not on its goal at the end counts max_steps."""
    makespan: npt.NDArray[np.int64]
    """(C,) the last arrival of all; max_steps if the team failed."""
    latched: npt.NDArray[np.bool_]
    """(C,) every robot touched its goal at least once (what the paper's released code counts as success)."""
    replaced: npt.NDArray[np.float64]
    """(C,) the share of actions that the shield replaced."""


def rollout(
    policy: DecentralizedPolicy | Actor,
    instances: Sequence[Instance],
    *,
    shield: Shield = "idle",
    sample: bool = False,
    temperature: float = 1.0,
    seed: int = 0,
    max_steps: int | Sequence[int] | npt.NDArray[np.integer] = 128,
    batch_size: int = 256,
) -> Rollouts:
    """Play `instances` under a policy and the collision shield; no expert is needed.

    Args:
        policy: A policy, or an actor of one's own.
        instances: The problems; all with the same number of agents and maps of one size.
        shield: Collision shielding; "idle" is the paper's, "pibt" moves robots aside by priority and takes a policy's
            logits as preferences.
        sample: Draw moves from the policy's softmax in place of the most probable one.
        temperature: Divides the logits when sampling.
        seed: Of the draws and of the shield's tie-breaking.
        max_steps: T_max, one for all instances or one for each.
        batch_size: How many teams are played at a time; it does not change the outcome.

    Raises:
        ValueError: If the instances differ in size, or an argument is out of range.
    """
    if not instances:
        raise ValueError("there are no instances to play")
    if shield not in ("idle", "pibt"):
        raise ValueError(f"shield must be 'idle' or 'pibt', got {shield!r}")
    sizes = {(each.num_agents, *each.grid.shape) for each in instances}
    if len(sizes) > 1:
        raise ValueError(f"all instances must have one team size and map size, got (agents, rows, columns) {sizes}")
    if batch_size < 1:
        raise ValueError(f"batch_size must be at least 1, got {batch_size}")
    if np.size(max_steps) not in (1, len(instances)):
        raise ValueError(f"{np.size(max_steps)} max_steps for {len(instances)} instances: give one, or one for each")
    limits = np.broadcast_to(np.asarray(max_steps, np.int64), len(instances))
    if (limits < 1).any():
        raise ValueError(f"max_steps must be at least 1, got {limits.min()}")
    if isinstance(policy, DecentralizedPolicy):
        actor: Actor = PolicyActor(
            policy.eval(), sample=sample, temperature=temperature, seed=seed, preferences=shield == "pibt"
        )
    else:
        actor = policy
    parts = [
        _play(actor, instances, np.arange(first, min(first + batch_size, len(instances))), limits, seed, shield)
        for first in range(0, len(instances), batch_size)
    ]
    solutions, replaced = [each for part, _ in parts for each in part], np.concatenate([each for _, each in parts])
    return _judge(list(instances), solutions, limits, replaced)


def _play(
    actor: Actor, instances: Sequence[Instance], cases: Cases, limits: npt.NDArray[np.int64], seed: int, shield: Shield
) -> tuple[list[Solution], npt.NDArray[np.float64]]:
    """Paths and the share of replaced actions of some cases."""
    pad = actor.border
    obstacles = rules.bordered(np.stack([instances[i].grid for i in cases]), pad)
    goals = np.stack([instances[i].goals for i in cases])
    positions = np.stack([instances[i].starts for i in cases])
    seeds = _native.mix(np.full(len(cases), seed, np.uint64), cases.astype(np.uint64))
    under_way = np.zeros(positions.shape[:2], np.int32)
    lengths, replaced = np.zeros(len(cases), np.int64), np.zeros(len(cases))
    history = [positions]
    active = np.flatnonzero((positions != goals).any(axis=(1, 2)))
    while len(active):
        time = len(history) - 1
        here, maps = positions[active], obstacles[active]
        wanted = actor.act(cases[active], maps, here, goals[active], time)
        times = np.full(len(active), time)
        if shield == "idle":
            executed = rules.shield(maps, pad, here, wanted, seeds[active], times)
        else:
            executed = rules.pibt_shield(maps, pad, here, wanted, under_way[active], seeds[active], times)
            wanted = wanted.argmax(-1) if wanted.ndim == 3 else wanted
        positions = positions.copy()
        positions[active] = rules.move(here, executed)
        under_way = np.where((positions == goals).all(-1), 0, under_way + 1).astype(np.int32)
        history.append(positions)
        lengths[active] += 1
        replaced[active] += (executed != wanted).mean(axis=1)
        goes_on = (positions[active] != goals[active]).any(axis=(1, 2)) & (lengths[active] < limits[cases[active]])
        active = active[goes_on]
    paths = np.stack(history, axis=1)
    solutions = [Solution(path[: length + 1]) for path, length in zip(paths, lengths, strict=True)]
    return solutions, replaced / np.maximum(lengths, 1)


def _judge(
    instances: list[Instance],
    solutions: list[Solution],
    limits: npt.NDArray[np.int64],
    replaced: npt.NDArray[np.float64],
) -> Rollouts:
    success, flowtime, makespan, latched = [], [], [], []
    for instance, solution, limit in zip(instances, solutions, limits, strict=True):
        on_goal = (solution.paths == instance.goals).all(axis=2)
        times = np.where(on_goal[-1], solution.arrivals, limit)
        success.append(on_goal[-1].all())
        flowtime.append(times.sum())
        makespan.append(times.max())
        latched.append(on_goal.any(axis=0).all())
    return Rollouts(
        instances,
        solutions,
        np.array(success),
        np.array(flowtime, np.int64),
        np.array(makespan, np.int64),
        np.array(latched),
        replaced,
    )
