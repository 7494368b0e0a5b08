"""The kind of a team's failure, found from its executed paths alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from gnn_policy.rollout import Rollouts
from mapf_env import Instance, Scene, Solution, distances

Failure = Literal["goal blocked", "deadlock", "oscillation", "livelock", "out of time"]
MEANINGS: dict[Failure, str] = {
    "out of time": "nobody is stalled; with more steps the team might have done it",
    "goal blocked": "robots that rest on their goals throughout the last steps cut off a stalled robot from its own",
    "deadlock": "the stalled robots stand still throughout the last steps",
    "oscillation": "each stalled robot stays on at most two cells, some going to and fro",
    "livelock": "the stalled robots move about and get nowhere",
}
"""The kinds of failure, in the order in which they are tried."""

LAST_STEPS = 16
"""Number of steps at the end of an episode from which the kind of failure is read."""


def failure(instance: Instance, solution: Solution) -> Failure | None:
    """Return the kind of failure, or None if all robots end on their goals.

    A robot is late if it ends off its goal. It is stalled if it is late and in the last steps came no nearer to its
    goal than it had ever been before (by shortest paths on the map without robots). The kind is the first of `MEANINGS`
    that holds.

    Args:
        instance: The problem.
        solution: Paths (T + 1, N, 2) over its free cells.

    Raises:
        ValueError: If the paths are of another number of agents.
    """
    if solution.paths.shape[1] != instance.num_agents:
        raise ValueError(f"{solution.paths.shape[1]} paths for {instance.num_agents} agents")
    paths = solution.paths
    late = (paths[-1] != instance.goals).any(axis=1)
    if not late.any():
        return None
    first = max(len(paths) - 1 - LAST_STEPS, 0)
    recent = paths[first:]
    rows, cols = paths[..., 0], paths[..., 1]
    robots = np.arange(instance.num_agents)
    steps = distances(instance.grid, instance.goals)[robots, rows, cols]
    stalled = late & (steps[first:].min(axis=0) >= steps[: first + 1].min(axis=0))
    if not stalled.any():
        return "out of time"
    resting = (recent == instance.goals).all(axis=(0, 2))
    if any(_cut_off(instance, paths[-1, robot], instance.goals[robot], resting) for robot in np.flatnonzero(stalled)):
        return "goal blocked"
    visited = [len(np.unique(recent[:, robot], axis=0)) for robot in np.flatnonzero(stalled)]
    return "deadlock" if max(visited) == 1 else "oscillation" if max(visited) == 2 else "livelock"


def _cut_off(
    instance: Instance, cell: npt.NDArray[np.int32], goal: npt.NDArray[np.int32], resting: npt.NDArray[np.bool_]
) -> bool:
    """Return True if the robots that rest on their goals block every path from the cell to the goal."""
    blocked = instance.grid.copy()
    blocked[tuple(instance.goals[resting].T)] = True
    return bool(distances(blocked, goal[None].astype(np.int32))[0, cell[0], cell[1]] < 0)


def count_failures(played: Rollouts) -> dict[Failure, int]:
    """Count the played cases by kind of failure."""
    found = Counter(map(failure, played.instances, played.solutions))
    return {kind: found[kind] for kind in get_args(Failure) if found[kind]}


def worst(played: Rollouts, expert: Sequence[Solution], count: int) -> list[Scene]:
    """Return scenes of up to `count` played cases with the expert's solutions, the worst of each kind of failure first.

    A case is worse than another if it failed and the other did not, then if more robots are off their goals, then if
    its flowtime exceeds the expert's by more.
    """
    instances, solutions = played.instances, played.solutions
    kinds = list(map(failure, instances, solutions))
    off_goal = [
        int((solution.paths[-1] != instance.goals).any(axis=1).sum())
        for instance, solution in zip(instances, solutions, strict=True)
    ]
    costs = np.array([each.sum_of_costs for each in expert])
    increase = (played.flowtime - costs) / np.maximum(costs, 1)
    order = [int(number) for number in np.lexsort([-increase, -np.array(off_goal)])]
    examples = {next(number for number in order if kinds[number] == kind) for kind in set(kinds) - {None}}
    order.sort(key=lambda number: number not in examples)
    return [
        Scene(
            f"{instances[number].num_agents} robots, case {number}: "
            + (f"{kinds[number]}, {off_goal[number]} not on goal" if kinds[number] else "solved")
            + f", flowtime {increase[number]:+.0%}",
            instances[number],
            {"policy": solutions[number], "expert": expert[number]},
        )
        for number in order[:count]
    ]
