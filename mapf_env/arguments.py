"""Checks of arguments to public calls: each error says which one is wrong, what is allowed and what was given."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import fields
from difflib import get_close_matches
from functools import cache, wraps
from numbers import Real
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

T = TypeVar("T")

_INT32, _INT64 = np.iinfo(np.int32), np.iinfo(np.int64)
MOST_INT = int(_INT32.max)
"""The native core counts robots, steps and a map's cells, its border included, in 32 bits."""
MOST_THREADS = 1024


def instance_of(value: object, kind: type[T], name: str) -> T:
    """Return `value`, which must be a `kind`."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be a {_public_name(kind)}, got {type(value).__name__}")
    return value


def each_of(values: Iterable[T], kind: type[T], name: str) -> Iterator[T]:
    """Iterate over `values`, each of which must be a `kind`; that they are iterable is checked at once."""
    try:
        iterator = iter(values)
    except TypeError:
        raise TypeError(f"{name} must be a sequence of {_public_name(kind)}, got {type(values).__name__}") from None
    return (instance_of(value, kind, f"{name}[{index}]") for index, value in enumerate(iterator))


def known_settings(given: Iterable[str], known: Iterable[str], owner: str = "") -> None:
    """Raise TypeError if a setting is not one of those `known`; the message names the owner, if any, and lists them."""
    every = sorted(known)
    for name in given:
        if name not in every:
            near = get_close_matches(name, every, 1)
            listed = f"he settings are {', '.join(every)}"
            advice = f"did you mean {near[0]!r}? T{listed}" if near else f"t{listed}"
            where = f"{owner} has" if owner else "there is"
            raise TypeError(f"{where} no setting {name!r}: {advice}")


def lists_settings(kind: type[T]) -> type[T]:
    """Let a dataclass refuse an unknown setting with a message that lists its settings, as `known_settings` does."""
    made: Callable[..., None] = kind.__init__
    known = [each.name for each in fields(kind) if each.init]  # pyright: ignore[reportArgumentType]

    @wraps(made)
    def init(self: T, *values: Any, **settings: Any) -> None:
        known_settings(settings, known, kind.__name__)
        made(self, *values, **settings)

    kind.__init__ = init
    return kind


def choice(value: object, known: Sequence[str], name: str) -> None:
    """Raise ValueError unless `value` is one of the words `known`."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")


def flag(value: object, name: str) -> bool:
    """Return `value`, which must be a bool."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def integer(value: object, name: str, least: int | None = None, most: int | None = None) -> int:
    """Return `value` as an integer in least..most; a bool is not an integer."""
    found = _as_int(value, name)
    if least is not None and found < least:
        raise ValueError(f"{name} must be at least {least}, got {found}")
    if most is not None and found > most:
        raise ValueError(f"{name} must be at most {most}, got {found}")
    return found


def seed(value: object, name: str = "seed") -> int:
    """Return `value` as an integer in 0..2**64 - 1."""
    found = _as_int(value, name)
    if not 0 <= found < 2**64:
        raise ValueError(f"{name} must not be negative and fit into 64 bits, got {found}")
    return found


def number(value: object, name: str) -> float:
    """Return `value` as a real number, which may be infinite or NaN; a bool is not a number."""
    if type(value) is float:  # before the slow question
        return value
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r}")
    try:
        return float(value)
    except OverflowError:
        raise ValueError(f"{name} must fit into 64 bits of floating point, got an integer beyond") from None


def finite(value: object, name: str) -> float:
    """Return `value` as a finite number."""
    found = number(value, name)
    if not np.isfinite(found):
        raise ValueError(f"{name} must be a finite number, got {found}")
    return found


def share(value: object, name: str) -> float:
    """Return `value` as a number in [0, 1]."""
    found = number(value, name)
    if not 0.0 <= found <= 1.0:
        raise ValueError(f"{name} must lie in [0, 1], got {found}")
    return found


def array(values: npt.ArrayLike, name: str) -> npt.NDArray[Any]:
    """Return `values` as an array."""
    try:
        return np.asarray(values)
    except ValueError:
        raise ValueError(f"{name} must be an array, but its rows differ in length: make them equally long") from None


def numbers(values: npt.ArrayLike, name: str) -> npt.NDArray[Any]:
    """Return `values` as an array that does not mix numbers and bools; integers beyond 64 bits are clipped."""
    found = array(values, name)
    if found.dtype != np.bool_ and not isinstance(values, np.ndarray) and _holds_bool(values):
        raise TypeError(f"{name} must be numbers, got True or False among them")
    if found.dtype == np.object_ or (found.dtype.kind == "f" and isinstance(values, list | tuple)):
        try:  # integers that NumPy has no common type for, such as 1 and 2**63
            exact = [operator.index(value) for value in np.array(values, np.object_).ravel().tolist()]
        except TypeError:
            return found
        found = np.array([min(max(value, _INT64.min), _INT64.max) for value in exact], np.int64).reshape(found.shape)
    return found


def shaped(
    values: npt.ArrayLike, name: str, shape: str, meaning: str = "", *, filled: bool = False
) -> npt.NDArray[Any]:
    """Return `values` as an array of a shape such as "(B, N, 2)", in which letters stand for any length.

    The message ends with `meaning` after the shape; with `filled` no axis may have length 0.
    """
    found, wanted = array(values, name), _axes(shape)
    pairs = zip(wanted, found.shape, strict=False)
    fits = all(length == wanted if wanted is not None else length or not filled for wanted, length in pairs)
    if found.ndim != len(wanted) or not fits:
        raise ValueError(f"{name} must have shape {shape}{meaning}, got {found.shape}")
    return found


def cells(
    values: npt.ArrayLike, name: str, shape: str, meaning: str = "", *, filled: bool = False
) -> npt.NDArray[np.int32]:
    """Return a contiguous copy of rows and columns as int32; values beyond 32 bits, off every map, are clipped."""
    found = shaped(numbers(values, name), name, shape, meaning, filled=filled)
    if found.dtype.kind not in "iu":
        raise TypeError(f"{name} must be integers, got dtype {found.dtype}")
    within = found if found.dtype == np.int32 else np.clip(found, _INT32.min, _INT32.max)
    return np.array(within, np.int32, order="C")


@cache
def _axes(shape: str) -> tuple[int | None, ...]:
    """Return the lengths in a shape such as "(B, N, 2)", None where any length is allowed."""
    axes = [axis.strip() for axis in shape.strip("()").split(",") if axis]
    return tuple(int(axis) if axis.isdigit() else None for axis in axes)


def _holds_bool(values: object) -> bool:
    if isinstance(values, list | tuple):
        return any(map(_holds_bool, values))
    return isinstance(values, bool) or "bool" in str(getattr(values, "dtype", ""))  # a tensor's dtype is torch.bool


def _as_int(value: object, name: str) -> int:
    if not _holds_bool(value):
        try:
            return operator.index(value)  # pyright: ignore[reportArgumentType]
        except TypeError:
            pass
    raise TypeError(f"{name} must be an integer, got {value!r}")


def _public_name(kind: type) -> str:
    package = kind.__module__.partition(".")[0]
    return kind.__name__ if package == "builtins" else f"{package}.{kind.__name__}"
