"""Relabelling for DAgger: the expert's next joint action in each of many states."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from experts import _native, arguments
from experts.cluster import connect
from mapf_env.instance import Instance

_MOST_IN_PART = 1024
"""States that a worker of a cluster labels at a time."""


def relabel(
    instances: Instance | Sequence[Instance],
    positions: npt.ArrayLike,
    *,
    offsets: npt.ArrayLike | None = None,
    w: float = arguments.DEFAULT_W,
    node_limit: int = arguments.DEFAULT_RELABEL_NODE_LIMIT,
    threads: int = 1,
    seed: int = 0,
    cluster: str | None = None,
) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.bool_]]:
    """Return the expert's first joint action in each of B states.

    For each state it is the first action of `solve(instance.at(positions[b]), w=w, node_limit=node_limit, seed=seed)`,
    at a fraction of the time: the distance tables of an instance are computed once for all its states, also if the
    same `Instance` object occurs many times in a sequence. There is no time limit, so labels are reproducible.

    Args:
        instances: The instance that all states belong to, or a sequence of B instances, one for each state. Maps and,
            with `offsets`, team sizes may differ.
        positions: (B, N, 2) integers, the row and column of each robot in each state; with `offsets` (R, 2), the robots
            of all states one after the other.
        offsets: (B + 1,) integers for states of different team sizes: the robots of state b are those from `offsets[b]`
            to `offsets[b + 1]`. `PlanLabels` has positions and offsets of this form.
        w: The suboptimality factor, at least 1.
        node_limit: High-level nodes to generate at most for a state.
        threads: Threads to share the states; the labels do not depend on it.
        seed: As in `solve`.
        cluster: The address of a Ray cluster whose workers label the states, as in `solve_many`; nor do the labels
            depend on that.

    Returns:
        `actions` (B, N) int8, or (R,) with `offsets`, the `Action` of each robot, and `solved` (B,) bool. Where a state
        is not solved within the limit, all its actions are IDLE, even if `solve` returns a plan without a proof; leave
        it out of the training data.

    Raises:
        ValueError: If an argument is out of its range, shapes do not fit, or a state is invalid (off the map, on an
            obstacle, two robots in a cell, a goal out of reach); the message names the state and the robot.
        TypeError: If an argument has the wrong type.
        KeyboardInterrupt: On Ctrl-C.
    """
    flat, spans = _flat(positions, offsets)
    if isinstance(instances, Instance):
        problems = [instances]
        problem_of = np.zeros(len(spans) - 1, dtype=np.int64)
    else:
        problems, problem_of = _distinct(list(arguments.each_of(instances, Instance, "instances")))
        if len(problem_of) != len(spans) - 1:
            raise ValueError(
                f"{len(problem_of)} instances but positions of {len(spans) - 1} states: give one instance for each "
                "state, or a single Instance that all states belong to"
            )
    sizes = np.diff(spans)
    teams = np.array([problem.num_agents for problem in problems], np.int64)[problem_of]
    for state in np.flatnonzero(sizes != teams):
        raise ValueError(
            f"state {state} holds {sizes[state]} agents, but an instance has {teams[state]}: give each state the "
            "robots of its instance, and offsets where team sizes differ"
        )
    limits = {
        "w": arguments.suboptimality(w),
        "node_limit": arguments.at_least_one(node_limit, "node_limit"),
        "seed": arguments.seed(seed),
    }
    threads = arguments.at_least_one(threads, "threads", maximum=arguments.MOST_THREADS)
    if cluster is not None and len(problem_of):
        with connect(arguments.address(cluster), workers=threads) as workers:
            size = workers.size_of_parts(len(problem_of), most=_MOST_IN_PART)
            firsts = range(0, len(problem_of), size)
            parts = (_part(problems, problem_of, flat, spans, first, first + size) for first in firsts)
            labels = list(workers.map(partial(_relabel_part, **limits), parts))
        actions, solved = (np.concatenate(column) for column in zip(*labels, strict=True))
    else:
        actions, solved = _native.relabel(
            [(problem.grid, problem.goals) for problem in problems], problem_of, flat, spans, threads=threads, **limits
        )
    return (actions.reshape(np.shape(positions)[:2]) if offsets is None else actions), solved


def _flat(
    positions: npt.ArrayLike, offsets: npt.ArrayLike | None
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """Return the robots of all states (R, 2), and the offsets (B + 1,) of the states among them."""
    if offsets is None:
        states = arguments.cells(positions, "positions", "(B, N, 2)", ": N cells for each of B states")
        return states.reshape(-1, 2), np.arange(len(states) + 1) * states.shape[1]
    flat = arguments.cells(positions, "positions", "(R, 2)", ": the cells of the robots of all states")
    spans = arguments.cells(offsets, "offsets", "(B + 1,)", filled=True)
    if spans[0] != 0 or spans[-1] != len(flat) or (np.diff(spans) < 1).any():
        raise ValueError(f"offsets must rise from 0 to the number of robots, {len(flat)}, got {spans}")
    return flat, spans.astype(np.int64)


Part = tuple[int, list[Instance], npt.NDArray[np.int32], npt.NDArray[np.int64]]
"""Some of the states: the number of the first, the instance of each, the robots' cells (r, 2), and the offsets of the
states among them."""


def _part(
    problems: list[Instance],
    problem_of: npt.NDArray[np.int64],
    flat: npt.NDArray[np.int32],
    spans: npt.NDArray[np.int64],
    begin: int,
    end: int,
) -> Part:
    """Return the states begin..end."""
    own = spans[begin : end + 1]
    return begin, [problems[index] for index in problem_of[begin:end]], flat[own[0] : own[-1]], own - own[0]


def _relabel_part(part: Part, **limits: Any) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.bool_]]:
    first, instances, positions, offsets = part
    try:
        return relabel(instances, positions, offsets=offsets, **limits)
    except ValueError as error:
        raise ValueError(f"among the states from number {first} on, {error}") from None


def _distinct(instances: list[Instance]) -> tuple[list[Instance], npt.NDArray[np.int64]]:
    """Return the distinct objects among `instances`, and the index of each instance among them."""
    index_of: dict[int, int] = {}
    problems: list[Instance] = []
    problem_of = np.empty(len(instances), dtype=np.int64)
    for state, instance in enumerate(instances):
        index = index_of.setdefault(id(instance), len(problems))
        if index == len(problems):
            problems.append(instance)
        problem_of[state] = index
    return problems, problem_of
