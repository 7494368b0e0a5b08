"""Public calls of the solvers: the message names the wrong argument."""

from collections.abc import Callable
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import pytest

import experts
from mapf_env import Instance, Solution
from wrong_arguments import (
    ARRAY,
    COUNT,
    FLAG,
    INTEGER,
    NUMBER,
    OBJECT,
    PATH,
    SEED,
    SEVERAL,
    STRING,
    assert_refused,
    but,
    table,
)

INSTANCE = Instance(np.zeros((3, 3), bool), [[0, 0]], [[0, 1]])
SOLUTION = Solution(np.stack([INSTANCE.starts, INSTANCE.goals]))
LIMITS: dict[str, tuple[Any, ...]] = {
    "time_limit": (*NUMBER, 0.0, -1.0),
    "node_limit": (*COUNT, 2**63),
    "seed": (*SEED, None),
}
FACTOR = (*NUMBER, 0.9)
MANY = LIMITS | {
    "instances": (*SEVERAL, INSTANCE),
    "solver": (*STRING, "a"),
    "w": (*but(FACTOR, NoneType), float("inf")),
    "threads": (*COUNT, 1025),
    "progress": but(OBJECT, NoneType),
    "cluster": (*but(STRING, NoneType), ""),
}
ONE = {"instance": INSTANCE}
CALLS: dict[str, Any] = {
    "solve": (experts.solve, ONE, LIMITS | {"instance": OBJECT, "w": (*FACTOR, float("inf"))}),
    "lacam": (experts.lacam, ONE, LIMITS | {"instance": OBJECT, "w": FACTOR}),
    "prioritised": (
        experts.prioritised,
        ONE,
        {"instance": OBJECT, "max_orders": COUNT, "time_limit": LIMITS["time_limit"], "seed": LIMITS["seed"]},
    ),
    "pibt": (experts.pibt, ONE, {"instance": OBJECT, "max_steps": COUNT, "seed": LIMITS["seed"], "swap": FLAG}),
    "label_plans": (
        experts.label_plans,
        {"instances": [INSTANCE]},
        {
            "instances": (*SEVERAL, INSTANCE),
            "steps": COUNT,
            "w": (*FACTOR, float("inf")),
            "node_limit": LIMITS["node_limit"],
            "rounds": COUNT,
            "threads": MANY["threads"],
            "seed": LIMITS["seed"],
            "cluster": MANY["cluster"],
        },
    ),
    "next_moves": (
        experts.next_moves,
        {"instances": [INSTANCE]},
        {
            "instances": (*SEVERAL, INSTANCE),
            "window": (*COUNT, 1001),
            "rounds": COUNT,
            "threads": MANY["threads"],
            "seed": LIMITS["seed"],
            "cluster": MANY["cluster"],
        },
    ),
    "solve_many": (experts.solve_many, {"instances": [INSTANCE]}, MANY),
    "solve_stream": (
        lambda **arguments: list(experts.solve_stream(**arguments)),
        {"instances": [INSTANCE]},
        MANY | {"backlog": COUNT},
    ),
    "relabel": (
        experts.relabel,
        {"instances": INSTANCE, "positions": INSTANCE.starts[None]},
        {
            "instances": SEVERAL,
            "positions": ARRAY,
            "w": (*FACTOR, float("inf")),
            "node_limit": COUNT,
            "threads": COUNT,
            "seed": LIMITS["seed"],
            "cluster": MANY["cluster"],
        },
    ),
    "Result.of": (
        experts.Result.of,
        {"solution": SOLUTION},
        {"solution": OBJECT, "lower_bound": (*INTEGER, -1), "seconds": (*NUMBER, -1.0)},
    ),
    "load_paths": (experts.load_paths, {"path": "a.paths"}, {"path": PATH}),
    "save_paths": (experts.save_paths, {"path": "b.paths", "solution": SOLUTION}, {"path": PATH, "solution": OBJECT}),
}


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the files that are read to the working folder."""
    monkeypatch.chdir(tmp_path)
    experts.save_paths("a.paths", SOLUTION)


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(("call", "sound", "argument", "wrong"), table(CALLS))
def test_wrong_arguments_are_refused_by_name(
    call: Callable[..., Any], sound: dict[str, Any], argument: str, wrong: tuple[Any, ...]
) -> None:
    assert_refused(call, sound, argument, wrong)


def test_every_public_call_is_among_these() -> None:
    found = {name.partition(".")[0] for name in CALLS}
    assert found | {"FoundBy", "PlanLabels", "RollingHorizon", "Solver", "Status", "audited"} == set(experts.__all__)


def test_a_stream_refuses_its_arguments_before_the_first_result_is_asked_for() -> None:
    with pytest.raises(TypeError, match=r"instances must be a sequence of mapf_env.Instance, got int"):
        experts.solve_stream(5)  # pyright: ignore[reportArgumentType]
