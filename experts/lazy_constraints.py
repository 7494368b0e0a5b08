"""LaCAM: complete and fast planning for hundreds to thousands of robots, with anytime improvement."""

from __future__ import annotations

import math

from experts import _native, arguments
from experts.result import Result, as_result
from mapf_env.instance import Instance


def lacam(
    instance: Instance,
    *,
    w: float = math.inf,
    time_limit: float = arguments.DEFAULT_TIME_LIMIT,
    node_limit: int = arguments.DEFAULT_NODE_LIMIT,
    seed: int = 0,
) -> Result:
    """Find a plan by lazy constraints addition search, and improve it if `w` is given.

    Okumura 2023, "LaCAM: search-based algorithm for quick multi-agent pathfinding": a depth-first search over joint
    states whose successors PIBT with swap makes, complete because all constraints on a successor are tried in the end.
    It takes turns with searches that restart with other random choices, also from the goals. A plan is then
    improved by large neighbourhood search (Li et al. 2021) until it costs at most `w` times the sum of the distances,
    or the time limit is reached. This is not LaCAM*, whose plans become optimal in the end.

    Args:
        instance: The problem.
        w: Cost bound at which improvement stops, at least 1; by default the first plan is returned unchanged.
        time_limit: Seconds of wall-clock time, `math.inf` for none. A plan found earlier is returned.
        node_limit: Joint states to generate at most, of about 8 bytes per robot; at most four times as many successors
            are tried, which matters where hardly any joint move is possible.
        seed: Draws the order of equally good moves and of constraints.

    Returns:
        The result. Its lower bound is the sum of the distances. `infeasible` is a proof: all joint states were seen.

    Raises:
        ValueError: If an argument is out of its range.
        TypeError: If an argument has the wrong type.
        KeyboardInterrupt: On Ctrl-C.
    """
    arguments.instance_of(instance, Instance, "instance")
    parts = _native.lacam(
        instance.grid,
        instance.starts,
        instance.goals,
        arguments.improvement(w),
        arguments.seconds(time_limit),
        arguments.at_least_one(node_limit, "node_limit"),
        arguments.seed(seed),
    )
    return as_result(parts)
