"""Hashes of a seed and a counter: randomness that depends on nothing but its arguments, on every machine."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments


def mix(seeds: npt.ArrayLike, counters: npt.ArrayLike) -> npt.NDArray[np.uint64]:
    """Return a well-mixed 64-bit hash of each seed and counter, which are broadcast against each other.

    It is the draw number `counter` of SplitMix64 (Steele, Lea and Flood 2014) from `seed`.

    Raises:
        ValueError: If a number is negative, or the shapes cannot be broadcast.
        TypeError: If they are not integers.
    """
    every, each = np.broadcast_arrays(_words(seeds, "seeds"), _words(counters, "counters"))
    return _native.mix(np.ascontiguousarray(every).ravel(), np.ascontiguousarray(each).ravel()).reshape(every.shape)


def _words(values: npt.ArrayLike, name: str) -> npt.NDArray[np.uint64]:
    array = arguments.array(values, name)
    if array.dtype == np.uint64:
        return array
    if array.size and array.dtype.kind not in "iu":
        raise TypeError(f"{name} must be integers, got dtype {array.dtype}")
    if array.size and array.min() < 0:
        raise ValueError(f"{name} must not be negative, got {array.min()}")
    return array.astype(np.uint64)
