"""Solvers that take an instance and return a solution."""

from experts.ecbs import solve
from experts.labels import PlanLabels, label_plans
from experts.lazy_constraints import lacam
from experts.many import Solver, audited, solve_many, solve_stream
from experts.paths import load_paths, save_paths
from experts.prioritised_planning import prioritised
from experts.priority_inheritance import pibt
from experts.relabelling import relabel
from experts.result import FoundBy, Result, Status
from experts.rolling_horizon import RollingHorizon, next_moves

__all__ = [
    "FoundBy",
    "PlanLabels",
    "Result",
    "RollingHorizon",
    "Solver",
    "Status",
    "audited",
    "label_plans",
    "lacam",
    "load_paths",
    "next_moves",
    "pibt",
    "prioritised",
    "relabel",
    "save_paths",
    "solve",
    "solve_many",
    "solve_stream",
]
