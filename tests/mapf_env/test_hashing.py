"""Hashes against the definition of SplitMix64 in whole numbers of any size."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import oracles
from mapf_env.hashing import mix

words = st.integers(0, 2**64 - 1)


@given(st.lists(words, min_size=1, max_size=4), st.lists(words, min_size=1, max_size=3))
def test_hashes_are_splitmix64_of_all_pairs(seeds: list[int], counters: list[int]) -> None:
    found = mix(np.array(seeds, np.uint64)[:, None], np.array(counters, np.uint64))
    assert found.dtype == np.uint64
    assert found.tolist() == [[oracles.mixed(seed, counter) for counter in counters] for seed in seeds]


def test_single_numbers_are_hashed_too() -> None:
    assert int(mix(7, 3)) == oracles.mixed(7, 3)
    assert mix([], []).shape == (0,)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="seeds must not be negative, got -1"):
        mix([-1], [0])
    with pytest.raises(TypeError, match="counters must be integers, got dtype float64"):
        mix([1], [0.5])
    with pytest.raises(ValueError, match="broadcast"):
        mix([1, 2], [1, 2, 3])
