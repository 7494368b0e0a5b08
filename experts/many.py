"""Solving many instances, as a list or as a stream of bounded memory, with the package's solvers or your own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import islice
from typing import Any

from experts import arguments
from experts.cluster import connect
from experts.ecbs import solve, solve_batch
from experts.lazy_constraints import lacam
from experts.prioritised_planning import prioritised
from experts.priority_inheritance import pibt
from experts.result import Result
from mapf_env.instance import Instance

Solver = Callable[[Instance], Result]
"""A function of an instance that returns a result; make yours with `Result.of`. Its plans are audited."""

Progress = Callable[[int, int], None]
"""Called after each result with the number of instances done and of those solved."""

_MOST_IN_PART = 64
"""Instances that a worker of a cluster solves at a time, and solves again if it dies."""

SOLVER_NAMES = ("ecbs", "lacam", "prioritised", "pibt")


def solve_many(
    instances: Iterable[Instance],
    *,
    solver: str | Solver = "ecbs",
    w: float | None = None,
    threads: int = 1,
    time_limit: float = arguments.DEFAULT_TIME_LIMIT,
    node_limit: int = arguments.DEFAULT_NODE_LIMIT,
    seed: int = 0,
    progress: Progress | None = None,
    cluster: str | None = None,
) -> list[Result]:
    """Solve each instance as `solve` does, or with another solver, over `threads` threads or on a cluster.

    Instances may differ in maps and numbers of robots. The limits are those of each instance, not of the call. The
    results do not depend on the number of threads, nor on the cluster (except for time limits); each is that of the
    solver called alone.

    Args:
        instances: The problems.
        solver: `"ecbs"`, `"lacam"`, `"prioritised"`, `"pibt"`, or a function of an instance, for
            example a `functools.partial` that sets more options; its plans are `audited`.
        w: As in `solve` for `"ecbs"` and as in `lacam` for `"lacam"`, with the default of each; others have none.
        threads: Native solvers do not hold Python's interpreter lock. A function runs in a pool of threads, or in the
            calling thread if there is one only. With `cluster="local"` the number of worker processes.
        time_limit: Seconds for each instance, if the named solver has a limit.
        node_limit: Nodes for each instance, if the named solver has a limit.
        seed: Random seed of a named solver.
        progress: Called after each result with the number of instances done and of those solved; of ECBS, which shares
            threads better the more it is given at once, after every 64 or so.
        cluster: The address of a Ray cluster whose workers solve the instances, one thread each; `"auto"` for the
            cluster that this machine belongs to, `"local"` for one of worker processes on this machine. A part of the
            instances whose worker dies is solved again. Needs the extra `cluster`.

    Returns:
        One result for each instance, in their order; unsolved ones say why, and may hold a plan without a proof.

    Raises:
        ValueError: If an argument is out of its range, the solver has no `w` and one is given, or a solver of your own
            returns paths that do not solve the instance.
        TypeError: If an argument has the wrong type, an element of `instances` is not an `Instance`, or a solver's
            answer is not a `Result`.
        KeyboardInterrupt: On Ctrl-C, which stops ECBS, and any solver on one thread or on a cluster, at once. On more
            threads other solvers start no further instance, and running ones finish in the background.
        ImportError: If Ray is needed and not installed.
        ConnectionError: If there is no cluster at the address.
        RuntimeError: If a part of the instances loses its workers again and again.
    """
    problems = list(arguments.each_of(instances, Instance, "instances"))
    return list(
        solve_stream(
            problems,
            solver=solver,
            w=w,
            threads=threads,
            time_limit=time_limit,
            node_limit=node_limit,
            seed=seed,
            backlog=max(1, len(problems)) if progress is None or cluster else arguments.DEFAULT_BACKLOG,
            progress=progress,
            cluster=cluster,
        )
    )


def solve_stream(
    instances: Iterable[Instance],
    *,
    solver: str | Solver = "ecbs",
    w: float | None = None,
    threads: int = 1,
    time_limit: float = arguments.DEFAULT_TIME_LIMIT,
    node_limit: int = arguments.DEFAULT_NODE_LIMIT,
    seed: int = 0,
    backlog: int = arguments.DEFAULT_BACKLOG,
    progress: Progress | None = None,
    cluster: str | None = None,
) -> Iterator[Result]:
    """Solve instances as they come: `solve_many` for more instances than fit into memory, or for an endless stream.

    No more than `backlog` instances are taken before their results are read, so a slow reader slows the source down.
    Arguments are checked in this call, before the first result is asked for.

    Args:
        instances: The problems; taken from the calling thread only, so any generator will do.
        solver: As in `solve_many`, like all arguments but the next.
        w: As in `solve_many`.
        threads: As in `solve_many`.
        time_limit: As in `solve_many`.
        node_limit: As in `solve_many`.
        seed: As in `solve_many`.
        backlog: Instances to hold at most. ECBS solves so many at a time. A large cluster needs some for each of its
            cores.
        progress: As in `solve_many`.
        cluster: As in `solve_many`.

    Returns:
        An iterator over one result for each instance, in their order, as `solve_many` returns them.

    Raises:
        ValueError: As `solve_many`.
        TypeError: As `solve_many`.
    """
    limits = {
        "time_limit": arguments.seconds(time_limit),
        "node_limit": arguments.at_least_one(node_limit, "node_limit"),
        "seed": arguments.seed(seed),
    }
    threads = arguments.at_least_one(threads, "threads", maximum=arguments.MOST_THREADS)
    backlog = arguments.at_least_one(backlog, "backlog")
    problems = arguments.each_of(instances, Instance, "instances")
    if progress is not None and not callable(progress):
        raise TypeError(f"progress must be a function of two numbers, got {progress!r}")
    if solver == "ecbs":
        factor = arguments.DEFAULT_W if w is None else arguments.suboptimality(w)
        batch = partial(solve_batch, w=factor, threads=threads, **limits)
        results = _in_batches(problems, batch, backlog)
    else:
        single = solver_named(solver, w=w, **limits) if isinstance(solver, str) else audited(solver)
        if w is not None and not isinstance(solver, str):
            raise ValueError("w is an option of named solvers: fix that of a function by functools.partial")
        results = _in_pool(problems, single, threads, backlog)
    if cluster is not None:
        solve_part = partial(solve_many, solver=solver, w=w, **limits)
        results = _on_cluster(problems, solve_part, arguments.address(cluster), threads, backlog)
    return results if progress is None else _reporting(results, progress)


def audited(solver: Solver) -> Solver:
    """Wrap a solver of your own so that each plan is checked before it is used.

    `solve_many` and `solve_stream` do this with every function that they are given.

    Args:
        solver: A function of an instance, or a `functools.partial` of one.

    Returns:
        The same solver. It raises a TypeError if the answer is not a `Result`, and a ValueError if its paths do not
        solve the instance, whatever the status; the message names the solver and what is wrong first.

    Raises:
        TypeError: If `solver` cannot be called.
    """
    if not callable(solver):
        raise TypeError(f"solver must be one of {', '.join(SOLVER_NAMES)} or a function, got {solver!r}")
    return partial(_audit, solver)


def _audit(solver: Solver, instance: Instance) -> Result:
    result = solver(instance)
    if not isinstance(result, Result):
        raise TypeError(
            f"the solver {_name(solver)} must return an experts.Result, got {type(result).__name__} (see Result.of)"
        )
    violations = [] if result.solution is None else result.solution.violations(instance, most=1)
    if violations:
        raise ValueError(
            f"the solver {_name(solver)} returned paths that do not solve the instance: {', '.join(violations)}"
        )
    return result


def _name(solver: object) -> str:
    """Return the module and name of a function or of the class of a callable object."""
    while isinstance(solver, partial):
        solver = solver.func
    named: Any = solver if hasattr(solver, "__qualname__") else type(solver)
    return f"{named.__module__}.{named.__qualname__}"


def solver_named(name: str, *, w: float | None, time_limit: float, node_limit: int, seed: int) -> Solver:
    """Return the solver of that name with the limits it takes, and `w` if that is given.

    Raises:
        ValueError: If the solver is unknown, or it has no `w` and one is given.
    """
    match name:
        case "ecbs":
            factor = {} if w is None else {"w": arguments.suboptimality(w)}
            return partial(solve, **factor, time_limit=time_limit, node_limit=node_limit, seed=seed)
        case "lacam":
            factor = {} if w is None else {"w": arguments.improvement(w)}
            return partial(lacam, **factor, time_limit=time_limit, node_limit=node_limit, seed=seed)
        case "prioritised" | "pibt" if w is not None:
            raise ValueError(f"the solver {name!r} has no w: leave it out, or choose ecbs or lacam")
        case "prioritised":
            return partial(prioritised, time_limit=time_limit, seed=seed)
        case "pibt":
            return partial(pibt, seed=seed)
    raise ValueError(f"solver must be one of {', '.join(SOLVER_NAMES)} or a function, got {name!r}")


def _in_batches(
    instances: Iterator[Instance], batch: Callable[[list[Instance]], list[Result]], size: int
) -> Iterator[Result]:
    while taken := list(islice(instances, size)):
        yield from batch(taken)


def _in_pool(instances: Iterator[Instance], solver: Solver, threads: int, backlog: int) -> Iterator[Result]:
    if threads == 1:
        yield from map(solver, instances)
        return
    pool = ThreadPoolExecutor(threads)
    try:
        waiting: deque[Future[Result]] = deque()
        while True:
            for instance in islice(instances, backlog - len(waiting)):
                waiting.append(pool.submit(solver, instance))
            if not waiting:
                return
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _on_cluster(
    instances: Iterator[Instance],
    solve_part: Callable[[list[Instance]], list[Result]],
    cluster: str,
    workers: int,
    backlog: int,
) -> Iterator[Result]:
    with connect(cluster, workers=workers) as found:
        size = found.size_of_parts(backlog, most=_MOST_IN_PART)
        parts = iter(lambda: list(islice(instances, size)), [])
        for solved in found.map(solve_part, parts, ahead=backlog // size):
            yield from solved


def _reporting(results: Iterator[Result], progress: Progress) -> Iterator[Result]:
    solved = 0
    for done, result in enumerate(results, start=1):
        solved += result.solved
        progress(done, solved)
        yield result
