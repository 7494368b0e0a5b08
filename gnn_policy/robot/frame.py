"""Frames that go over the radio: a header of 40 bytes and a body; anything else is dropped.

A header is the version, what the body is, the round, the sender, the step, the episode, the length of the body and a
tag of 16 bytes, keyed BLAKE2b over everything else. Without a key the tag is a checksum, which finds damage. With a key
that only the team has, nobody else can make a frame, change one, or use it in another step or episode. Nothing in a
frame is code, and no length is believed before it is compared with the bytes that came.
"""

from __future__ import annotations

import hmac
import struct
from dataclasses import dataclass
from enum import IntEnum
from hashlib import blake2b

VERSION = 1
MOST_BODY = 1 << 20
"""Bytes of a body at most."""
_HEADER = struct.Struct("<BBHIIQI")
_TAG = 16
HEADER_BYTES = _HEADER.size + _TAG


class Content(IntEnum):
    """The kind of a frame's body."""

    FLOAT32 = 1
    """A message of the policy, its features as float32; the next two likewise."""
    FLOAT16 = 2
    INT8 = 3
    RESERVATION = 4
    """A message of the local shield (`gnn_policy.robot.reservation`)."""
    SENSED = 5
    """The perception of a robot at the start of a step (`gnn_policy.robot.driver`)."""
    COMMAND = 6
    """A move or scores, to the driver."""
    END = 7
    """The world has ended."""
    WELCOME = 8
    """A robot joins a world, and the world's answer."""
    READY = 9
    """A robot can take part from the next step on."""


_KNOWN = frozenset(Content)


class FrameError(ValueError):
    """Bytes that are not a frame of this team; the message begins with "damaged" or "foreign"."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame as it was sent."""

    content: Content
    sender: int
    """The number of the robot, 0..65535."""
    step: int
    round: int
    body: bytes


@dataclass(frozen=True, slots=True)
class Seal:
    """Turns frames into bytes and back, for one team and one episode.

    Raises:
        ValueError: If the key has more than 64 bytes or the episode is out of range.
    """

    key: bytes = b""
    """Shared by the team; without one, tags are checksums only."""
    episode: int = 0
    """A number that never repeats under one key: frames of other episodes are foreign."""

    def __post_init__(self) -> None:
        if len(self.key) > 64:
            raise ValueError(f"a key has 64 bytes at most, got {len(self.key)}")
        if not 0 <= self.episode < 2**64:
            raise ValueError(f"episode must lie in 0..2**64 - 1, got {self.episode}")

    def pack(self, frame: Frame) -> bytes:
        """Return the bytes of a frame.

        Raises:
            ValueError: If the body is too long, or a number is out of range.
        """
        if len(frame.body) > MOST_BODY:
            raise ValueError(f"a frame holds {MOST_BODY} bytes, got {len(frame.body)}")
        try:
            header = _HEADER.pack(
                *(VERSION, frame.content, frame.sender, frame.step, frame.round, self.episode, len(frame.body))
            )
        except struct.error as wrong:
            raise ValueError(f"sender, step or round does not fit into a header: {wrong}") from wrong
        return header + self._tag(header, frame.body) + frame.body

    def unpack(self, data: bytes) -> Frame:
        """Return the frame of these bytes.

        Raises:
            FrameError: If they are damaged, or of another version, team or episode.
        """
        if len(data) < HEADER_BYTES or len(data) > HEADER_BYTES + MOST_BODY:
            raise FrameError(f"damaged: {len(data)} bytes are not a frame")
        header, body = data[: _HEADER.size], data[HEADER_BYTES:]
        version, content, sender, step, number, episode, length = _HEADER.unpack(header)
        if version != VERSION:
            raise FrameError(f"foreign: version {version}, this is {VERSION}")
        if length != len(body):
            raise FrameError(f"damaged: {len(body)} bytes came, the header says {length}")
        if not hmac.compare_digest(self._tag(header, body), data[_HEADER.size : HEADER_BYTES]):
            raise FrameError("damaged: the tag does not fit; it may be forged")
        if episode != self.episode:
            raise FrameError("foreign: of another episode")
        if content not in _KNOWN:
            raise FrameError(f"foreign: unknown content {content}")
        return Frame(Content(content), sender, step, number, body)

    def _tag(self, header: bytes, body: bytes) -> bytes:
        return blake2b(header + body, key=self.key, digest_size=_TAG).digest()
