"""Teams under a policy, from their starts to the end: the executed paths and how good they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from gnn_policy.execution import (
    STUCK_MEMORY,
    Execution,
    Sample,
    Shield,
    hears_of,
    is_stuck,
    robot_seeds,
)
from gnn_policy.finite import require_finite
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.perception import Perception
from gnn_policy.policy_config import CommRange, CommWeights, PolicyConfig
from mapf_env import Instance, Solution, _native, rules

Cases = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Teams:
    """B teams at one moment of their cases, as an actor meets them."""

    cases: Cases
    """(B,) which of the instances they play."""
    seeds: npt.NDArray[np.uint64]
    """(B,) a hash of the case and its seed, to draw from."""
    obstacles: rules.Bordered
    """(B, H + 2 border, W + 2 border) the maps inside the actor's border."""
    positions: rules.Positions
    """(B, N, 2)"""
    goals: rules.Positions
    """(B, N, 2)"""
    past: rules.Positions
    """(T, B, N, 2) positions at up to as many earlier steps as the actor remembers."""
    time: int
    """Steps since the start."""


@runtime_checkable
class Actor(Protocol):
    """What chooses the moves of many teams at once: a class of your own that has these three."""

    border: int
    """Cells of obstacles around the maps that `act` receives; at least the radius that it observes with."""
    memory: int
    """How many steps back `act` receives positions."""

    def act(self, teams: Teams) -> npt.NDArray[Any]:
        """Joint actions (B, N); under PIBT also values (B, N, 5)."""
        ...


class PolicyActor:
    """A network on given cases, executed as `execution` says; it gives the values (B, N, 5) of the moves.

    Raises:
        TypeError: If the network has no `config`.
        ValueError: If its weights are not finite.
    """

    def __init__(self, policy: nn.Module, instances: Sequence[Instance], execution: Execution) -> None:
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
        self._perception = Perception(
            config, instances, comm_range=execution.comm_range, comm_weights=execution.comm_weights
        )
        self._device = next((each.device for each in policy.parameters()), torch.device("cpu"))
        self.border = config.fov_radius
        self.memory = STUCK_MEMORY if execution.sample == "stuck" else 0
        self._rows: dict[int, int] = {}

    def act(self, teams: Teams) -> npt.NDArray[np.float32]:
        """Observe, communicate and value the moves."""
        count, device = len(teams.cases), self._device
        padded = np.arange(_padded_size(count)).clip(max=count - 1)
        fov, graph = self._perception.observe(
            teams.cases[padded],
            teams.obstacles[padded],
            teams.positions[padded],
            teams.goals[padded],
            self._tables(teams, padded) if self.config.cost_to_go else None,
        )
        with torch.inference_mode():
            logits = self.policy(torch.from_numpy(fov).to(device), torch.from_numpy(graph).to(device))[:count]
        alarmed = is_stuck(teams.positions, teams.goals, teams.past)
        if self.config.taps > 1:  # with one tap robots do not communicate
            alarmed |= hears_of(alarmed, graph[:count])
        seeds = robot_seeds(teams.seeds, graph.shape[1])
        return self.execution.values(logits.float().cpu().numpy(), alarmed, seeds, teams.time)

    def _tables(self, teams: Teams, chosen: Cases) -> npt.NDArray[np.uint16]:
        """(B, N, size) distances to the goals of the chosen teams (B,), which stay as long as they are played."""
        if not self._rows.keys() >= set(teams.cases.tolist()):
            self._rows = {case: row for row, case in enumerate(teams.cases.tolist())}
            self._distances = rules.distance_tables(teams.obstacles, self.border, teams.goals)
        return self._distances[[self._rows[case] for case in teams.cases[chosen].tolist()]]


def _padded_size(teams: int) -> int:
    """The next of few batch sizes: the convolution library prepares itself anew for each size it meets."""
    return 1 << (teams - 1).bit_length() if teams < 32 else -(-teams // 32) * 32


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
    policy: nn.Module | Actor,
    instances: Sequence[Instance],
    *,
    shield: Shield = "idle",
    sample: Sample = False,
    temperature: float = 1.0,
    comm_range: CommRange | None = None,
    comm_weights: CommWeights | None = None,
    seed: int | Sequence[int] = 0,
    max_steps: int | Sequence[int] | npt.NDArray[np.integer] = 128,
    batch_size: int = 256,
) -> Rollouts:
    """Play `instances` under a policy and the collision shield; no expert is needed.

    What becomes of a team depends on the policy, its instance, its seed and its max_steps alone: neither on its place
    in the list nor on the others. So equal instances with equal seeds end equally.

    Args:
        policy: A policy; or a network of your own that maps views (B, N, C, F, F) and graphs (B, N, N) to logits
            (B, N, 5) and has a `config`, a `PolicyConfig` that says what its robots perceive; or an `Actor` of your
            own, which heeds nothing of how policies are executed but the shield.
        instances: The problems; all with the same number of agents and maps of one size.
        shield: As in `Execution`.
        sample: As in `Execution`.
        temperature: As in `Execution`.
        comm_range: As in `Execution`.
        comm_weights: As in `Execution`.
        seed: Of the draws and of the shield's tie-breaking, one for all instances or one for each.
        max_steps: T_max, one for all instances or one for each.
        batch_size: How many teams are played at a time; it does not change the outcome.

    Raises:
        ValueError: If the instances differ in size, an argument is out of range, or weights, logits or an actor's
            values are not finite numbers.
        TypeError: If `policy` is none of these.
    """
    if not instances:
        raise ValueError("there are no instances to play")
    execution = Execution(
        sample=sample, temperature=temperature, shield=shield, comm_range=comm_range, comm_weights=comm_weights
    )
    sizes = {(each.num_agents, *each.grid.shape) for each in instances}
    if len(sizes) > 1:
        raise ValueError(f"all instances must have one team size and map size, got (agents, rows, columns) {sizes}")
    if batch_size < 1:
        raise ValueError(f"batch_size must be at least 1, got {batch_size}")
    limits = np.array(_one_for_each("max_steps", max_steps, len(instances)), np.int64)
    if (limits < 1).any():
        raise ValueError(f"max_steps must be at least 1, got {limits.min()}")
    seeds = _seeds(instances, _one_for_each("seed", seed, len(instances)))
    if isinstance(policy, Actor):
        return _play_all(policy, instances, seeds, limits, shield, batch_size)
    if not isinstance(policy, nn.Module):
        raise TypeError(
            f"rollout plays a network or an actor, got {type(policy).__name__}: an actor has `border`, `memory` and "
            "`act` (gnn_policy.Actor)"
        )
    was_training = policy.training
    try:
        return _play_all(PolicyActor(policy.eval(), instances, execution), instances, seeds, limits, shield, batch_size)
    finally:
        policy.train(was_training)


def _one_for_each(name: str, given: int | Sequence[int] | npt.NDArray[np.integer], count: int) -> list[int]:
    values = [int(given)] if isinstance(given, int | np.integer) else [int(each) for each in given]
    if len(values) not in (1, count):
        raise ValueError(f"{len(values)} values of {name} for {count} instances: give one, or one for each")
    return values * count if len(values) == 1 else values


def _seeds(instances: Sequence[Instance], seeds: Sequence[int]) -> npt.NDArray[np.uint64]:
    """(C,) a hash of each instance and its seed."""
    wrong = [seed for seed in seeds if not 0 <= seed < 2**64]
    if wrong:
        raise ValueError(f"seed must lie in 0..2**64 - 1, got {wrong[0]}")
    prints = [
        blake2b(repr(each.grid.shape).encode() + each.grid.tobytes() + each.starts.tobytes() + each.goals.tobytes())
        for each in instances
    ]
    counters = np.array([int.from_bytes(each.digest()[:8], "little") for each in prints], np.uint64)
    return _native.mix(np.array(seeds, np.uint64), counters)


def _play_all(
    actor: Actor,
    instances: Sequence[Instance],
    seeds: npt.NDArray[np.uint64],
    limits: npt.NDArray[np.int64],
    shield: Shield,
    batch_size: int,
) -> Rollouts:
    parts = [
        _play(actor, instances, np.arange(first, min(first + batch_size, len(instances))), seeds, limits, shield)
        for first in range(0, len(instances), batch_size)
    ]
    solutions, replaced = [each for part, _ in parts for each in part], np.concatenate([each for _, each in parts])
    return _judge(list(instances), solutions, limits, replaced)


def _play(
    actor: Actor,
    instances: Sequence[Instance],
    cases: Cases,
    seeds: npt.NDArray[np.uint64],
    limits: npt.NDArray[np.int64],
    shield: Shield,
) -> tuple[list[Solution], npt.NDArray[np.float64]]:
    """Paths and the share of replaced actions of some cases."""
    pad = actor.border
    obstacles = rules.bordered(np.stack([instances[i].grid for i in cases]), pad)
    goals = np.stack([instances[i].goals for i in cases])
    positions = np.stack([instances[i].starts for i in cases])
    under_way = np.zeros(positions.shape[:2], np.int32)
    lengths, replaced = np.zeros(len(cases), np.int64), np.zeros(len(cases))
    history = [positions]
    active = np.flatnonzero((positions != goals).any(axis=(1, 2)))
    while len(active):
        time = len(history) - 1
        here, maps, draws = positions[active], obstacles[active], seeds[cases[active]]
        recent = history[max(time - actor.memory, 0) : time]
        past = np.stack(recent)[:, active] if recent else np.empty((0, *here.shape), here.dtype)
        wanted = actor.act(Teams(cases[active], draws, maps, here, goals[active], past, time))
        if not np.isfinite(wanted).all():
            raise ValueError(f"{type(actor).__name__}.act returned values that are not finite numbers")
        times = np.full(len(active), time)
        chosen = wanted.argmax(-1) if wanted.ndim == 3 else wanted
        if shield == "pibt":
            executed = rules.pibt_shield(maps, pad, here, wanted, under_way[active], draws, times)
        else:
            executed = rules.shield(maps, pad, here, chosen, draws, times)
        positions = positions.copy()
        positions[active] = rules.move(here, executed)
        under_way = np.where((positions == goals).all(-1), 0, under_way + 1).astype(np.int32)
        history.append(positions)
        lengths[active] += 1
        replaced[active] += (executed != chosen).mean(axis=1)
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
