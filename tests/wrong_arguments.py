"""Wrong arguments by the expected kind, and the check that the error names them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from types import NoneType
from typing import Any

import numpy as np
import pytest

TEXT: tuple[Any, ...] = ("a", "5")
NOTHING: tuple[Any, ...] = (None, math.nan, object(), {}, b"x")

INTEGER = (*TEXT, *NOTHING, True, 1.5, 1.0, math.inf, [1], np.array([1, 2]))
COUNT = (*INTEGER, 0, -1)
COUNT_32_BITS = (*COUNT, 2**70)
NUMBER = (*TEXT, *NOTHING, True, 1j, [1.0], np.array([1.0, 2.0]))
FLAG = (*TEXT, *NOTHING, 0, 1, [])
WORD = (*TEXT, *NOTHING, 5, ["idle"], np.array(["idle", "pibt"]))
STRING = (*NOTHING, 5, ["a"])
OBJECT = (*TEXT, *NOTHING, 5, [1], "instance")
SEVERAL = (*TEXT, None, math.nan, object(), 5, [1], [None], [[]])
ARRAY = (
    *TEXT,
    *NOTHING,
    5,
    [None],
    [[1], [1, 2]],
    [[[0, 0]], [[0, 0], [0, 1]]],
    [[math.nan, 0]],
    [["a", "b"]],
    [[[["a"]]]],
    [[0.5, 1]],
    np.zeros((2, 2, 2, 2, 2)),
)


def but(values: tuple[Any, ...], *sound: type) -> tuple[Any, ...]:
    """The values without those of types that are sound here."""
    return tuple(value for value in values if type(value) not in sound)


SEED = (*but(INTEGER, NoneType), -1, 2**64)
PATH = (*but(NOTHING, dict), 5, [])


def table(calls: Mapping[str, tuple[Callable[..., Any], dict[str, Any], dict[str, tuple[Any, ...]]]]) -> list[Any]:
    """A test for each call and argument of it: the call, sound arguments, and the values that are wrong for one."""
    return [
        pytest.param(call, sound, argument, wrong, id=f"{name}-{argument}")
        for name, (call, sound, arguments) in calls.items()
        for argument, wrong in arguments.items()
    ]


def assert_refused(call: Callable[..., Any], sound: dict[str, Any], argument: str, wrong: tuple[Any, ...]) -> None:
    """Each wrong value is a ValueError or TypeError whose message names the argument, in words of this package."""
    call(**sound)
    for value in wrong:
        with pytest.raises((ValueError, TypeError)) as refused:
            call(**sound | {argument: value})
        message = str(refused.value)
        assert re.search(argument.rstrip("s"), message), f"{argument}={value!r}: {message}"
        assert not re.search(
            "incompatible function|not supported between|object is not|inhomogeneous|NoneType'", message
        )
