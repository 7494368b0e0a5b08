"""Results of solvers: the status of the search, the plan found, and the lower bound proved."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from mapf_env import arguments
from mapf_env.solution import Solution


class Status(StrEnum):
    """The outcome of a search."""

    SOLVED = "solved"
    NODE_LIMIT = "node_limit"
    TIME_LIMIT = "time_limit"
    INFEASIBLE = "infeasible"
    STEP_LIMIT = "step_limit"


class FoundBy(StrEnum):
    """The part of a solver that found a plan."""

    ECBS = "ecbs"
    """The best-first search of ECBS."""
    REPAIR = "repair"
    """Large neighbourhood search, which repaired the first joint plan of ECBS."""
    PROOF = "proof"
    """The search that proves lower bounds."""
    LACAM = "lacam"
    """LaCAM: its first plan."""
    IMPROVEMENT = "improvement"
    """LaCAM's plan, improved by large neighbourhood search."""
    PRIORITISED = "prioritised"
    """Prioritised planning."""
    PIBT = "pibt"
    """PIBT, step by step."""


@dataclass(frozen=True, slots=True)
class Result:
    """The outcome of one search.

    A solved result always has a solution, and that of `solve` is proved: `cost <= w * lower_bound`. A search that ends
    at its node or time limit may have one, too: the cheapest plan that it found. It has no conflicts, but it is not
    proved to be within `w` of the optimum: `cost > w * lower_bound`. Results with another status have none. Test
    `solved` for a proof, and `solution is not None` for a plan.

    Attributes:
        status: The outcome of the search; `infeasible` is a proof that no solution exists.
        solution: The paths, or None without a plan.
        cost: The sum of costs of the solution in steps, or None without one.
        lower_bound: No solution costs less; proved by the search as far as it got.
        expansions: High-level nodes expanded (PIBT: joint steps; prioritised planning: orders tried).
        generated: High-level nodes generated, the same way.
        seconds: Wall-clock time of the search, distance tables included.
        found_by: The part of the solver that found the solution, a `FoundBy` of the solvers here; None without a
            solution, or where a solver of your own does not say.

    Raises:
        ValueError: If status, cost or bound contradict the solution, or a number is negative.
        TypeError: If an argument has the wrong type.
    """

    status: Status
    solution: Solution | None
    cost: int | None
    lower_bound: int
    expansions: int
    generated: int
    seconds: float
    found_by: str | None = None

    def __post_init__(self) -> None:
        arguments.instance_of(self.status, Status, "status")
        if self.solution is not None:
            arguments.instance_of(self.solution, Solution, "solution")
        if self.solution is None and self.status is Status.SOLVED:
            raise ValueError("a solved result needs a solution, got none")
        if self.solution is not None and self.status not in _WITH_SOLUTION:
            raise ValueError(
                f"a result has a solution only if its status is {', '.join(_WITH_SOLUTION)}, got {self.status} with one"
            )
        paid = None if self.solution is None else self.solution.sum_of_costs
        if self.cost != paid:
            raise ValueError(f"the cost must be the solution's sum of costs, {paid}, got {self.cost!r}")
        arguments.integer(self.lower_bound, "lower_bound", 0, paid)
        for name in ("expansions", "generated"):
            arguments.integer(getattr(self, name), name, 0)
        if not arguments.number(self.seconds, "seconds") >= 0:
            raise ValueError(f"seconds must not be negative, got {self.seconds}")
        if self.found_by is not None:
            arguments.instance_of(self.found_by, str, "found_by")

    @classmethod
    def of(cls, solution: Solution, *, lower_bound: int = 0, seconds: float = 0.0) -> Result:
        """Make the result of your own solver: a solution, and the lower bound it has proved, if any.

        Raises:
            ValueError: If a number is negative, or the bound is above the cost.
            TypeError: If an argument has the wrong type.
        """
        arguments.instance_of(solution, Solution, "solution")
        return cls(Status.SOLVED, solution, solution.sum_of_costs, lower_bound, 0, 0, seconds)

    @property
    def solved(self) -> bool:
        """True if the status is `solved`: for `solve`, the cost is proved to be within `w` times the optimum."""
        return self.status is Status.SOLVED


_WITH_SOLUTION = (Status.SOLVED, Status.NODE_LIMIT, Status.TIME_LIMIT)
_STATUSES = tuple(Status)  # the native enumeration has the same order
FINDERS = (None, *FoundBy)
"""The parts that find plans, in the order of the native enumeration."""

Parts = tuple[int, npt.NDArray[np.int32] | None, int, int, int, int, float, int]
"""A native result: status number, paths, cost, bound, expansions, generated, seconds, number of the finder."""


def as_result(parts: Parts) -> Result:
    """Make a result from native parts."""
    status, paths, cost, lower_bound, expansions, generated, seconds, finder = parts
    solution = None if paths is None else Solution(paths)
    paid = None if paths is None else cost
    return Result(_STATUSES[status], solution, paid, lower_bound, expansions, generated, seconds, FINDERS[finder])
