"""Prioritised planning: one robot after the other, each around those before it."""

from __future__ import annotations

from experts import _native, arguments
from experts.result import Result, as_result
from mapf_env.instance import Instance


def prioritised(
    instance: Instance,
    *,
    max_orders: int = arguments.DEFAULT_MAX_ORDERS,
    time_limit: float = arguments.DEFAULT_TIME_LIMIT,
    seed: int = 0,
) -> Result:
    """Plan the robots in an order of priority, each along the shortest path that the robots before it leave.

    Erdmann and Lozano-Perez 1987, "On multiple moving objects", over safe intervals (Phillips and Likhachev 2011,
    "SIPP: safe interval path planning for dynamic environments"). The robots with the longest distance come first; a
    robot that finds no path comes first in the next order. Fast and often near the optimum, but without a bound, and
    some instances have no order that works.

    Args:
        instance: The problem.
        max_orders: Orders to try at most; then the status is `node_limit`.
        time_limit: Seconds of wall-clock time, `math.inf` for none.
        seed: Random seed for the order of robots with equal distances.

    Returns:
        The result. Its lower bound is the sum of the distances, its expansions are the orders tried.

    Raises:
        ValueError: If an argument is out of its range.
        TypeError: If an argument has the wrong type.
        KeyboardInterrupt: On Ctrl-C.
    """
    arguments.instance_of(instance, Instance, "instance")
    parts = _native.prioritised(
        instance.grid,
        instance.starts,
        instance.goals,
        arguments.at_least_one(max_orders, "max_orders", maximum=arguments.MAX_ORDERS),
        arguments.seconds(time_limit),
        arguments.seed(seed),
    )
    return as_result(parts)
