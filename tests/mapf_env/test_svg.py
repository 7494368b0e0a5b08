import re
from itertools import combinations
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapf_env import svg


@given(st.lists(st.tuples(st.integers(-1, 1), st.integers(-1, 1)), min_size=1, max_size=30))
def test_a_track_is_known_from_its_bends_and_needs_each_of_them(moves):
    track = np.cumsum(np.array([(0, 0), *moves]), axis=0)

    def between(times):
        return np.stack([np.interp(range(len(track)), times, track[times, axis]) for axis in (0, 1)], axis=1)

    bends = svg.bends(track)
    assert between(bends) == pytest.approx(track)
    for bend in bends[1:-1]:
        assert not np.allclose(between([time for time in bends if time != bend]), track)


@pytest.mark.parametrize("robots", [2, 10, 20, 60])
def test_colours_can_be_told_apart(robots):
    colours = svg.colours(robots)
    assert all(re.fullmatch("#[0-9a-f]{6}", colour) for colour in colours)
    channels = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours])
    least = min(np.abs(a - b).sum() for a, b in combinations(channels, 2))
    assert least >= {2: 100, 10: 60, 20: 40, 60: 12}[robots]


@given(st.text())
def test_printable_text_is_xml(text):
    shown = svg.printable(text)
    ElementTree.fromstring(f"<t>{shown.replace('&', '&amp;').replace('<', '&lt;')}</t>".encode())
    assert len(shown) == len(text)
    assert svg.printable(shown) == shown
