"""Labels by plan: solve many states once each, and label the states on the first steps of each plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from experts import _native, arguments
from experts.cluster import map_cases
from experts.result import FINDERS
from mapf_env.instance import Instance

_MOST_IN_PART = 64
"""Instances that a worker of a cluster labels at a time."""


@dataclass(frozen=True, slots=True)
class PlanLabels:
    """The S labelled team states of B plans, with R robots in all; teams may differ in size.

    Attributes:
        source: (S,) int64, the index of the instance whose plan the state lies on.
        time: (S,) int32, the state's time on that plan; 0 is the instance itself.
        offsets: (S + 1,) int64. The robots of state s are those from `offsets[s]` to `offsets[s + 1]`, in their order.
        positions: (R, 2) int32, the row and column of each robot.
        actions: (R,) int8, the plan's next `Action` of each robot.
        solved: (B,) bool. Instances without a plan have no states.
        costs: (B,) int64, the sum of costs of each plan, 0 without one.
        found_by: For each of the B instances the `FoundBy` of its plan, None without one.
    """

    source: npt.NDArray[np.int64]
    time: npt.NDArray[np.int32]
    offsets: npt.NDArray[np.int64]
    positions: npt.NDArray[np.int32]
    actions: npt.NDArray[np.int8]
    solved: npt.NDArray[np.bool_]
    costs: npt.NDArray[np.int64]
    found_by: tuple[str | None, ...]


def label_plans(
    instances: Sequence[Instance],
    *,
    steps: int = arguments.DEFAULT_LABEL_STEPS,
    w: float = arguments.DEFAULT_LABEL_W,
    node_limit: int = arguments.DEFAULT_LABEL_NODE_LIMIT,
    rounds: int = arguments.DEFAULT_ROUNDS,
    threads: int = 1,
    seed: int = 0,
    cluster: str | None = None,
) -> PlanLabels:
    """Solve each instance once and label the states on the first steps of its plan with the plan's moves.

    An instance is a state: `instance.at(positions)` makes one from the robots' positions. Teams and maps may differ.
    Plans are found by ECBS if a few expansions are enough, else by LaCAM, whose plan large neighbourhood search
    improves. There is no time limit, so equal arguments give equal labels, on any number of threads and on any cluster.

    Args:
        instances: The states to start from.
        steps: Steps of each plan to label; fewer if all robots are on their goals before that.
        w: The suboptimality factor of ECBS, at least 1.
        node_limit: Nodes of ECBS and joint states of LaCAM to generate at most for an instance.
        rounds: Rounds of the neighbourhood search on each plan of LaCAM; more rounds make cheaper plans.
        threads: Threads to share the instances.
        seed: As in `solve` and `lacam`.
        cluster: The address of a Ray cluster whose workers label the states, as in `solve_many`.

    Returns:
        The labels, in the order of the instances and then of time.

    Raises:
        ValueError: If an argument is out of its range.
        TypeError: If an argument has the wrong type.
        KeyboardInterrupt: On Ctrl-C.
    """
    problems = list(arguments.each_of(instances, Instance, "instances"))
    limits = {
        "steps": arguments.at_least_one(steps, "steps", maximum=arguments.MAX_STEPS),
        "w": arguments.suboptimality(w),
        "node_limit": arguments.at_least_one(node_limit, "node_limit"),
        "rounds": arguments.at_least_one(rounds, "rounds", maximum=arguments.MAX_ROUNDS),
        "seed": arguments.seed(seed),
    }
    threads = arguments.at_least_one(threads, "threads", maximum=arguments.MOST_THREADS)
    if cluster is not None and problems:
        label = partial(label_plans, **limits)
        return _joined(map_cases(label, problems, arguments.address(cluster), workers=threads, most=_MOST_IN_PART))
    source, time, offsets, positions, actions, solved, costs, finders = _native.label_plans(
        [(each.grid, each.starts, each.goals) for each in problems], threads=threads, **limits
    )
    found_by = tuple(FINDERS[finder] for finder in finders)
    return PlanLabels(source, time, offsets, positions, actions, solved, costs, found_by)


def _joined(parts: Sequence[PlanLabels]) -> PlanLabels:
    """Return the labels of consecutive parts of the instances as one."""
    firsts = np.cumsum([0, *(len(part.solved) for part in parts)])
    robots = np.concatenate([np.diff(part.offsets) for part in parts])
    return PlanLabels(
        source=np.concatenate([part.source + first for part, first in zip(parts, firsts, strict=False)]),
        time=np.concatenate([part.time for part in parts]),
        offsets=np.concatenate([np.zeros(1, np.int64), np.cumsum(robots)]),
        positions=np.concatenate([part.positions for part in parts]),
        actions=np.concatenate([part.actions for part in parts]),
        solved=np.concatenate([part.solved for part in parts]),
        costs=np.concatenate([part.costs for part in parts]),
        found_by=tuple(finder for part in parts for finder in part.found_by),
    )
