"""DAgger's seam: what the expert would do next in each of many states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from experts import _native, arguments
from mapf_env.instance import Instance


def relabel(
    instances: Instance | Sequence[Instance],
    positions: npt.ArrayLike,
    *,
    w: float = arguments.DEFAULT_W,
    node_limit: int = arguments.DEFAULT_RELABEL_NODE_LIMIT,
    threads: int = 1,
    seed: int = 0,
) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.bool_]]:
    """The expert's first joint action in each of B states of N robots.

    For each state it is the first action of `solve(instance.at(positions[b]), w=w, node_limit=node_limit, seed=seed)`,
    at a fraction of the time: the distance tables of an instance are computed once for all its states, also where the
    same `Instance` object occurs many times in a sequence. There is no time limit, so labels are reproducible.

    Args:
        instances: The instance that all states belong to, or a sequence of B instances, one for each state. All have
            the same number N of robots; maps may differ.
        positions: (B, N, 2) integers, the row and column of each robot in each state.
        w: The suboptimality factor, at least 1.
        node_limit: High-level nodes to generate at most for a state.
        threads: Threads to share the states; the labels do not depend on it.
        seed: As in `solve`.

    Returns:
        `actions` (B, N) int8, the `Action` of each robot, and `solved` (B,) bool. Where a state is not solved within
        the limit, all its actions are IDLE; leave it out of the training data.

    Raises:
        ValueError: If an argument is out of its range, shapes do not fit, or a state is invalid (off the map, on an
            obstacle, two robots in a cell, a goal out of reach); the message names the state and the robot.
        TypeError: If an argument has the wrong type.
        KeyboardInterrupt: At Ctrl-C.
    """
    states = arguments.cells(positions, "positions", "(B, N, 2)", ": N cells for each of B states")
    if isinstance(instances, Instance):
        problems = [instances]
        problem_of = np.zeros(len(states), dtype=np.int64)
    else:
        problems, problem_of = _distinct(list(arguments.each_of(instances, Instance, "instances")))
        if len(problem_of) != len(states):
            raise ValueError(
                f"{len(problem_of)} instances but positions of {len(states)} states: give one instance for each state, "
                "or a single Instance that all states belong to"
            )
    for problem in problems:
        if problem.num_agents != states.shape[1]:
            raise ValueError(
                f"positions hold {states.shape[1]} agents, but an instance has {problem.num_agents}: all instances and "
                "states of one call need the same number of agents"
            )
    return _native.relabel(
        [(problem.grid, problem.goals) for problem in problems],
        problem_of,
        states,
        arguments.suboptimality(w),
        arguments.at_least_one(node_limit, "node_limit"),
        arguments.seed(seed),
        arguments.at_least_one(threads, "threads", maximum=arguments.MOST_THREADS),
    )


def _distinct(instances: list[Instance]) -> tuple[list[Instance], npt.NDArray[np.int64]]:
    """The distinct objects among `instances`, and for each of `instances` its index among them."""
    index_of: dict[int, int] = {}
    problems: list[Instance] = []
    problem_of = np.empty(len(instances), dtype=np.int64)
    for state, instance in enumerate(instances):
        index = index_of.setdefault(id(instance), len(problems))
        if index == len(problems):
            problems.append(instance)
        problem_of[state] = index
    return problems, problem_of
