"""The arguments all solvers share, checked: each error says what is wrong and what is allowed."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from numbers import Real

from mapf_env.instance import Instance

DEFAULT_W = 1.05
DEFAULT_TIME_LIMIT = 10.0
DEFAULT_NODE_LIMIT = 1_000_000
DEFAULT_RELABEL_NODE_LIMIT = 10_000
DEFAULT_BACKLOG = 64
DEFAULT_MAX_STEPS = 1_000
DEFAULT_MAX_ORDERS = 100
MAX_STEPS = 2**31 - 2
MAX_ORDERS = 2**31 - 1
MAX_THREADS = 1024


def require_instance(instance: object, name: str) -> None:
    """Raises TypeError where `instance` is something else."""
    if not isinstance(instance, Instance):
        raise TypeError(f"{name} must be a mapf_env.Instance, got {type(instance).__name__}")


def all_instances(instances: Iterable[Instance]) -> list[Instance]:
    """The instances as a list; raises TypeError where one is something else."""
    found = list(instances)
    for index, instance in enumerate(found):
        require_instance(instance, f"instances[{index}]")
    return found


def suboptimality(w: float) -> float:
    """The factor `w` as a finite float of at least 1."""
    value = _real(w, "w")
    if not (math.isfinite(value) and value >= 1):
        raise ValueError(f"w must be a finite number >= 1 (1 is optimal, 1.05 allows 5% above the optimum), got {w!r}")
    return value


def seconds(time_limit: float) -> float:
    """A time limit in seconds, above 0 and possibly infinite."""
    value = _real(time_limit, "time_limit")
    if not value > 0:
        raise ValueError(f"time_limit must be a number of seconds > 0 (math.inf for no limit), got {time_limit!r}")
    return value


def at_least_one(value: int, name: str, maximum: int = 2**63 - 1) -> int:
    """An integer argument in 1..maximum."""
    number = _integer(value, name)
    if not 1 <= number <= maximum:
        raise ValueError(f"{name} must be an integer in 1..{maximum}, got {value!r}")
    return number


def seed_number(seed: int) -> int:
    """A seed in 0..2**64 - 1."""
    number = _integer(seed, "seed")
    if not 0 <= number < 2**64:
        raise ValueError(f"seed must be an integer in 0..2**64 - 1, got {seed!r}")
    return number


def _real(value: object, name: str) -> float:
    if type(value) is float:  # before the slow question
        return value
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r}")
    return float(value)


def _integer(value: object, name: str) -> int:
    if not isinstance(value, bool):
        try:
            return operator.index(value)  # pyright: ignore[reportArgumentType]
        except TypeError:
            pass
    raise TypeError(f"{name} must be an integer, got {value!r}")
