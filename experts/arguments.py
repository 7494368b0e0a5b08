"""The arguments that all solvers share, with their defaults and checks."""

from __future__ import annotations

import math

from mapf_env.arguments import MOST_THREADS, cells, each_of, flag, instance_of, integer, number, seed

__all__ = [
    "MOST_THREADS",
    "address",
    "at_least_one",
    "cells",
    "each_of",
    "flag",
    "improvement",
    "instance_of",
    "seconds",
    "seed",
    "suboptimality",
]

DEFAULT_W = 1.05
DEFAULT_TIME_LIMIT = 10.0
DEFAULT_NODE_LIMIT = 1_000_000
DEFAULT_RELABEL_NODE_LIMIT = 10_000
DEFAULT_LABEL_W = 1.2
DEFAULT_LABEL_STEPS = 32
DEFAULT_LABEL_NODE_LIMIT = 20_000
DEFAULT_ROUNDS = 400
DEFAULT_WINDOW = 10
DEFAULT_WINDOW_ROUNDS = 200
DEFAULT_BACKLOG = 64
DEFAULT_MAX_STEPS = 1_000
DEFAULT_MAX_ORDERS = 100
MAX_STEPS = 2**31 - 2
MAX_ORDERS = 2**31 - 1
MAX_WINDOW = 1_000
MAX_ROUNDS = 2**31 - 1


def suboptimality(w: float) -> float:
    """Return the factor `w` as a finite float of at least 1."""
    value = number(w, "w")
    if not (math.isfinite(value) and value >= 1):
        raise ValueError(f"w must be a finite number >= 1 (1 is optimal, 1.05 allows 5% above the optimum), got {w!r}")
    return value


def improvement(w: float) -> float:
    """Return LaCAM's factor `w`: as `suboptimality`, or `math.inf` for the first plan without improvement."""
    value = number(w, "w")
    return value if value == math.inf else suboptimality(value)


def seconds(time_limit: float) -> float:
    """Return a time limit in seconds, above 0 and possibly infinite."""
    value = number(time_limit, "time_limit")
    if not value > 0:
        raise ValueError(f"time_limit must be a number of seconds > 0 (math.inf for no limit), got {time_limit!r}")
    return value


def address(cluster: str) -> str:
    """Return the address of a cluster, a word that is not empty."""
    if not instance_of(cluster, str, "cluster"):
        raise ValueError('cluster must be the address of a Ray cluster, "auto" or "local", got an empty string')
    return cluster


def at_least_one(value: int, name: str, maximum: int = 2**63 - 1) -> int:
    """Return an integer argument in 1..maximum."""
    found = integer(value, name)
    if not 1 <= found <= maximum:
        raise ValueError(f"{name} must be an integer in 1..{maximum}, got {value!r}")
    return found
