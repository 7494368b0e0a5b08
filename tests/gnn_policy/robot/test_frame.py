"""Frames: what was sent comes back, and nothing else is taken for a frame."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnn_policy.robot.frame import HEADER_BYTES, MOST_BODY, Content, Frame, FrameError, Seal

FRAMES = st.builds(
    Frame,
    content=st.sampled_from(Content),
    sender=st.integers(0, 2**16 - 1),
    step=st.integers(0, 2**32 - 1),
    round=st.integers(0, 2**32 - 1),
    body=st.binary(max_size=60),
)


@given(frame=FRAMES, key=st.binary(max_size=64), episode=st.integers(0, 2**64 - 1))
def test_a_frame_comes_back_as_it_was_sent(frame, key, episode):
    seal = Seal(key, episode)
    data = seal.pack(frame)
    assert HEADER_BYTES == 40
    assert len(data) == 40 + len(frame.body)
    assert seal.unpack(data) == frame


@given(frame=FRAMES, key=st.binary(max_size=64), change=st.integers(1, 255), data=st.data())
def test_a_frame_with_one_wrong_byte_is_dropped(frame, key, change, data):
    sent = Seal(key).pack(frame)
    place = data.draw(st.integers(0, len(sent) - 1))
    came = sent[:place] + bytes([sent[place] ^ change]) + sent[place + 1 :]
    with pytest.raises(FrameError):
        Seal(key).unpack(came)


@given(st.binary(max_size=200))
def test_noise_is_not_a_frame(noise):
    with pytest.raises(FrameError):
        Seal(b"key").unpack(noise)


@given(frame=FRAMES, cut=st.integers(1, 40))
def test_lengths_are_not_believed(frame, cut):
    sent = Seal().pack(frame)
    for came in (sent[:-cut], sent + bytes(cut), sent + bytes(MOST_BODY)):
        with pytest.raises(FrameError, match="damaged"):
            Seal().unpack(came)


def test_frames_of_another_team_episode_or_version_are_foreign():
    frame = Frame(Content.RESERVATION, 3, 7, 1, b"abc")
    sent = Seal(b"ours", 5).pack(frame)
    with pytest.raises(FrameError, match=r"damaged: the tag .* forged"):
        Seal(b"theirs", 5).unpack(sent)
    with pytest.raises(FrameError, match="foreign: of another episode"):
        Seal(b"ours", 6).unpack(sent)
    with pytest.raises(FrameError, match="foreign: version 2"):
        Seal(b"ours", 5).unpack(b"\2" + sent[1:])


def test_what_does_not_fit_into_a_frame_is_refused():
    for wrong in ({"sender": 2**16}, {"step": -1}, {"round": 2**32}):
        with pytest.raises(ValueError, match="does not fit"):
            Seal().pack(Frame(**{"content": Content.END, "sender": 0, "step": 0, "round": 0, "body": b"", **wrong}))
    with pytest.raises(ValueError, match="a frame holds"):
        Seal().pack(Frame(Content.END, 0, 0, 0, bytes(MOST_BODY + 1)))
    with pytest.raises(ValueError, match="64 bytes"):
        Seal(bytes(65))
    with pytest.raises(ValueError, match="episode"):
        Seal(b"", 2**64)
