"""ECBS: near-optimal solutions with a proved bound."""

from __future__ import annotations

from collections.abc import Sequence

from experts import _native, arguments
from experts.result import Result, as_result
from mapf_env.instance import Instance


def solve(
    instance: Instance,
    *,
    w: float = arguments.DEFAULT_W,
    time_limit: float = arguments.DEFAULT_TIME_LIMIT,
    node_limit: int = arguments.DEFAULT_NODE_LIMIT,
    seed: int = 0,
) -> Result:
    """Find conflict-free paths whose sum of costs is at most `w` times the optimum.

    Enhanced conflict-based search (Barer, Sharon, Stern and Felner 2014) that spends all of `w` on the choice
    between joint plans and none on single paths, which keeps makespans short. If a few expansions do not solve the
    instance, large neighbourhood search (Li et al. 2021, 2022), LaCAM (Okumura 2023) and best-first search with a proof
    (Li et al. 2019) take turns.
    `w=1` is optimal conflict-based search (Sharon, Stern, Felner and Sturtevant 2015).

    Args:
        instance: The problem; `instance.at(positions)` is the same problem from any later state.
        w: The suboptimality factor, at least 1: `cost <= w * lower_bound` holds for every solved result.
        time_limit: Seconds of wall-clock time, `math.inf` for none.
        node_limit: High-level nodes to generate at most, and for `w` > 1 joint states of LaCAM; this bounds the memory
            (about 160 bytes per node on 20x20, up to twice that while arrays grow; 8 bytes per robot for a joint
            state).
        seed: Shuffles the order in which the first joint plan treats the robots.

    Returns:
        The result. A search that ends at a limit returns the cheapest plan it has found, if any, with that limit as its
        status; such a plan costs more than `w` times the lower bound. The result depends only on the arguments,
        unless the time limit ends the search.

    Raises:
        ValueError: If an argument is out of its range.
        TypeError: If an argument has the wrong type.
        KeyboardInterrupt: On Ctrl-C, which stops the search.
    """
    arguments.instance_of(instance, Instance, "instance")
    return solve_batch([instance], w=w, threads=1, time_limit=time_limit, node_limit=node_limit, seed=seed)[0]


def solve_batch(
    instances: Sequence[Instance], *, w: float, threads: int, time_limit: float, node_limit: int, seed: int
) -> list[Result]:
    """Solve each instance as `solve` does, in one call of the native core over `threads` threads."""
    parts = _native.ecbs(
        [(each.grid, each.starts, each.goals) for each in instances],
        arguments.suboptimality(w),
        arguments.seconds(time_limit),
        arguments.at_least_one(node_limit, "node_limit"),
        arguments.seed(seed),
        arguments.at_least_one(threads, "threads", maximum=arguments.MOST_THREADS),
    )
    return [as_result(part) for part in parts]
