"""The metrics of the paper with confidence intervals, for policies, baselines and the expert."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import experts
from gnn_policy.baselines import GreedyActor, RandomActor
from gnn_policy.execution import Execution
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.rollout import Rollouts, rollout
from mapf_env import Instance, Solution

LIFELONG_STEPS = 256
"""Steps of a lifelong episode in validation, and by default in evaluation."""
REFERENCE_NODES = 200_000
"""High-level nodes that the expert may generate for a held-out case; several seconds of search."""
TEAMS_AT_A_TIME = 64
"""Teams that are played in one batch; on a cluster, by one worker. The same on one machine, for equal numbers."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean with its 95 % interval."""

    mean: float
    low: float
    high: float

    @staticmethod
    def proportion(outcomes: npt.NDArray[np.bool_]) -> Estimate:
        """Return the share of true outcomes, with Wilson's interval."""
        n, share, z = len(outcomes), float(outcomes.mean()), 1.96
        centre = (share + z * z / (2 * n)) / (1 + z * z / n)
        spread = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
        # An end that is the share itself, at 0 or 1, is off by rounding.
        return Estimate(share, min(max(centre - spread, 0.0), share), max(min(centre + spread, 1.0), share))

    @staticmethod
    def average(values: npt.NDArray[np.float64]) -> Estimate:
        """Return the mean, with the normal interval; NaN without values."""
        if len(values) == 0:
            return Estimate(math.nan, math.nan, math.nan)
        mean = float(values.mean())
        spread = 1.96 * float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.inf
        return Estimate(mean, mean - spread, mean + spread)


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceSet:
    """Cases with the expert's solution, which sets the time limit and the flowtime to compare with."""

    instances: list[Instance]
    solutions: list[Solution]
    lower_bounds: npt.NDArray[np.int64]
    """(C,) lower bounds of the optimal sums of costs."""
    max_steps: npt.NDArray[np.int64]
    """(C,) T_max of each case."""
    unsolved: int
    """Cases left out because the expert did not solve them within its limits."""

    @staticmethod
    def prepare(
        instances: Sequence[Instance],
        *,
        w: float,
        timeout: float,
        threads: int,
        nodes: int = REFERENCE_NODES,
        cluster: str | None = None,
    ) -> ReferenceSet:
        """Solve the cases with the expert; T_max is `timeout` times the makespan of its solution.

        LaCAM plans the cases that ECBS does not solve, even if ECBS has a plan without a proof. Which cases are solved
        depends on `nodes`, not on the machine.

        Args:
            instances: The cases.
            w: ECBS's bound on suboptimality.
            timeout: T_max in makespans of the expert's solution.
            threads: CPU threads.
            nodes: Nodes that ECBS, and then LaCAM, may generate for a case.
            cluster: The address of a Ray cluster that solves them, as in `experts.solve_many`.

        Raises:
            ValueError: If the expert solves none of them.
        """
        limits: dict[str, Any] = {
            "threads": threads,
            "time_limit": math.inf,
            "node_limit": nodes,
            "cluster": cluster,
        }
        results = experts.solve_many(instances, w=w, **limits)
        left = [i for i, result in enumerate(results) if not result.solved]
        for i, plan in zip(
            left, experts.solve_many([instances[i] for i in left], solver="lacam", **limits), strict=True
        ):
            results[i] = plan
        known = [i for i, result in enumerate(results) if result.solved]
        if not known:
            raise ValueError(f"the expert solved none of the {len(instances)} cases: make them easier or raise w")
        solutions = [plan for i in known if (plan := results[i].solution) is not None]
        return ReferenceSet(
            [instances[i] for i in known],
            solutions,
            np.array([results[i].lower_bound for i in known], np.int64),
            np.array([max(math.ceil(timeout * solution.makespan), 1) for solution in solutions]),
            len(instances) - len(known),
        )

    @staticmethod
    def without_expert(instances: Sequence[Instance], max_steps: int) -> ReferenceSet:
        """Return cases of lifelong tasks, which have no solution and end after `max_steps`."""
        limits = np.full(len(instances), max_steps, np.int64)
        return ReferenceSet(list(instances), [], np.zeros(0, np.int64), limits, 0)

    @property
    def flowtimes(self) -> npt.NDArray[np.int64]:
        """(C,) the expert's sums of costs."""
        return np.array([each.sum_of_costs for each in self.solutions], np.int64)

    def increase(self, flowtimes: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """Return the excess (C,) of flowtimes over the expert's, as a share of the latter."""
        return (flowtimes - self.flowtimes) / np.maximum(self.flowtimes, 1)


@dataclass(frozen=True, slots=True)
class Score:
    """One row of a results table."""

    name: str
    success_rate: Estimate
    """Share of cases in which all robots were on their goals at once in time."""
    flowtime_increase: Estimate
    """Over the expert's flowtime, signed, over all cases; a robot that fails counts T_max."""
    flowtime_increase_solved: Estimate
    """The same over solved cases."""
    makespan: Estimate
    """Over solved cases, in steps."""
    latched: float
    """Share of cases in which every robot touched its goal at least once (the success of the authors' code)."""


def score(name: str, reference: ReferenceSet, rollouts: Rollouts) -> Score:
    """Compute the metrics of played cases."""
    increase = reference.increase(rollouts.flowtime)
    return Score(
        name,
        Estimate.proportion(rollouts.success),
        Estimate.average(increase),
        Estimate.average(increase[rollouts.success]),
        Estimate.average(rollouts.makespan[rollouts.success].astype(np.float64)),
        float(rollouts.latched.mean()),
    )


def compare(
    reference: ReferenceSet,
    policy: DecentralizedPolicy,
    executions: Sequence[Execution],
    *,
    seed: int = 0,
    cluster: str | None = None,
    progress: Callable[[str], None] = lambda phase: None,
) -> tuple[list[Score], list[Rollouts]]:
    """Compare a policy with the expert and with baselines without learning, on the same cases.

    The cases of an execution are played in batches of `TEAMS_AT_A_TIME`, by a cluster's workers if `cluster` is given.

    Returns:
        The rows, those of the executions first, and what the policy did in each execution.
    """
    rows, played = [], []
    mark = "*" if policy.config.needs_map else ""
    for execution in executions:
        progress(execution.name)
        played.append(
            rollout(
                policy,
                reference.instances,
                execution=execution,
                seed=seed,
                max_steps=reference.max_steps,
                batch_size=TEAMS_AT_A_TIME,
                cluster=cluster,
            )
        )
        rows.append(score(execution.name + mark, reference, played[-1]))
    return [*rows, *baselines(reference, seed=seed, cluster=cluster, progress=progress)], played


BASELINES = ("random", "greedy*", "greedy,stuck*", "PIBT*", "expert*")
"""The baselines without learning; those with a star know the whole map."""


def baselines(
    reference: ReferenceSet,
    *,
    seed: int = 0,
    cluster: str | None = None,
    progress: Callable[[str], None] = lambda phase: None,
) -> list[Score]:
    """Return the rows of `BASELINES`; of the two greedy ones, the second moves at random when it is stuck."""
    cases, rows = reference.instances, []
    actors = (RandomActor(), GreedyActor(), GreedyActor(random_when_stuck=True))
    for name, actor in zip(BASELINES, actors, strict=False):
        progress(name)
        played = rollout(
            actor,
            cases,
            seed=seed,
            max_steps=reference.max_steps,
            batch_size=TEAMS_AT_A_TIME,
            cluster=cluster,
        )
        rows.append(score(name, reference, played))
    progress("PIBT*")
    return [*rows, _pibt_score(reference, seed), _expert_score(reference)]


def _pibt_score(reference: ReferenceSet, seed: int) -> Score:
    results = [
        experts.pibt(instance, max_steps=int(limit), seed=seed)
        for instance, limit in zip(reference.instances, reference.max_steps, strict=True)
    ]
    success = np.array([result.solution is not None for result in results])
    # Where PIBT fails it keeps no paths: all robots count T_max, an upper bound of its flowtime.
    failed = reference.max_steps * np.array([each.num_agents for each in reference.instances])
    costs = np.array([failed[i] if result.cost is None else result.cost for i, result in enumerate(results)])
    increase = reference.increase(costs)
    makespans = np.array([each.solution.makespan for each in results if each.solution is not None], np.float64)
    return Score(
        "PIBT*",
        Estimate.proportion(success),
        Estimate.average(increase),
        Estimate.average(increase[success]),
        Estimate.average(makespans),
        float(success.mean()),
    )


def _expert_score(reference: ReferenceSet) -> Score:
    makespans = np.array([each.makespan for each in reference.solutions], np.float64)
    zero = Estimate(0.0, 0.0, 0.0)
    solved = np.ones(len(reference.instances), np.bool_)
    return Score("expert*", Estimate.proportion(solved), zero, zero, Estimate.average(makespans), 1.0)


LIFELONG_BASELINES = {"random": RandomActor(), "greedy*": GreedyActor(), "PIBT*": GreedyActor(shield="pibt")}
"""The baselines of a lifelong table; those with a star know the whole map."""


def compare_lifelong(
    instances: Sequence[Instance],
    policy: DecentralizedPolicy,
    executions: Sequence[Execution],
    *,
    steps: int,
    seed: int = 0,
    cluster: str | None = None,
    progress: Callable[[str], None] = lambda phase: None,
) -> tuple[dict[str, Any], list[Rollouts]]:
    """Return the throughput of a policy and of `LIFELONG_BASELINES` on the same cases as plain data.

    Returns:
        The table, the executions' rows first, and the policy's rollouts in each execution.
    """
    rows, played = [], []
    mark = "*" if policy.config.needs_map else ""
    settings: dict[str, Any] = {
        "task": "lifelong",
        "seed": seed,
        "max_steps": steps,
        "batch_size": TEAMS_AT_A_TIME,
        "cluster": cluster,
    }
    for execution in executions:
        progress(execution.name)
        played.append(rollout(policy, instances, execution=execution, **settings))
        rows.append(_throughput(execution.name + mark, played[-1]))
    for name, actor in LIFELONG_BASELINES.items():
        progress(name)
        rows.append(_throughput(name, rollout(actor, instances, **settings)))
    return {"cases": len(instances), "steps": steps, "rows": rows}, played


def _throughput(name: str, played: Rollouts) -> dict[str, Any]:
    return {"name": name, "throughput": _finite(asdict(Estimate.average(played.throughput)))}


def as_json(rows: Sequence[Score], reference: ReferenceSet) -> dict[str, Any]:
    """Return the rows as plain data, with null for numbers that are not finite."""
    plain = [_finite(asdict(row)) for row in rows]
    return {
        "cases": len(reference.instances),
        "unsolved_by_expert": reference.unsolved,
        "expert_over_bound": _over_bound(reference),
        "rows": plain,
    }


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(each) for name, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _over_bound(reference: ReferenceSet) -> float:
    """Return the expert's flowtime divided by its lower bound, as a mean over the cases."""
    return float((np.maximum(reference.flowtimes, 1) / np.maximum(reference.lower_bounds, 1)).mean())
