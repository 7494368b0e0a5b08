"""Messages in fewer bits: how far they may be from what was meant."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gnn_policy import Message
from gnn_policy.robot.message import Precision

FEATURES = arrays(
    np.float32, st.integers(0, 20), elements=st.floats(-(2.0**100), 2.0**100, width=32, allow_subnormal=False)
)


@given(features=FEATURES, stuck=st.booleans())
def test_int8_is_within_half_a_step_of_the_greatest_feature(features, stuck):
    data = Message(features, stuck).to_bytes("int8")
    assert len(data) == Message.size(len(features), "int8") == 5 + len(features)
    again = Message.from_bytes(data, "int8")
    assert again.stuck is stuck
    step = np.abs(features.astype(np.float64)).max(initial=0) / 127
    assert (np.abs(again.features - features.astype(np.float64)) <= 0.5001 * step + 1e-38).all()


@given(features=FEATURES, stuck=st.booleans())
def test_float16_is_the_nearest_and_what_it_cannot_hold_becomes_its_greatest(features, stuck):
    data = Message(features, stuck).to_bytes("float16")
    assert len(data) == Message.size(len(features), "float16") == 1 + 2 * len(features)
    again = Message.from_bytes(data, "float16")
    assert again.stuck is stuck
    held = features.astype(np.float64).clip(-65504, 65504)
    assert (np.abs(again.features - held) <= 2**-11 * np.abs(held) + 2**-25).all()


def test_messages_of_other_sizes_or_with_numbers_that_are_not_finite_are_refused():
    cases: list[tuple[Precision, bytes]] = [
        ("int8", b"\0\0\0\0"),
        ("float16", b"\0\0"),
        ("float16", b""),
        ("int8", b"\2" + bytes(8)),
    ]
    for precision, wrong in cases:
        with pytest.raises(ValueError, match="are not a message"):
            Message.from_bytes(wrong, precision)
    cases = [("float16", b"\0\xff\xff"), ("int8", b"\0\0\0\xc0\x7f\1"), ("int8", b"\0\0\0\x80\x7f\1")]
    for precision, data in cases:
        with pytest.raises(ValueError, match="not finite"):
            Message.from_bytes(data, precision)
