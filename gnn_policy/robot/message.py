"""The message of a robot in a round of the policy, and its bytes."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

Precision = Literal["float32", "float16", "int8"]
"""In which numbers features travel."""

_BYTES: dict[Precision, int] = {"float32": 4, "float16": 2, "int8": 1}
_LARGEST_FLOAT16 = 65504.0


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """The message that a robot sends to all its neighbours in one round."""

    features: npt.NDArray[np.float32]
    """(G,) the message of the policy's graph layer."""
    stuck: bool
    """True if the robot is stuck: off its goal and back on a cell where it stood in one of its last 16 steps."""

    def to_bytes(self, precision: Precision = "float32") -> bytes:
        """Return one byte, then the features, little-endian: 4 G + 1 bytes, 513 for the paper's G = 128.

        As float16 they take 2 G + 1 bytes; as int8 G + 5, a float32 scale first, of which each feature is a multiple in
        -127..127.
        """
        flag = struct.pack("<?", self.stuck)
        if precision == "int8":
            scale = np.float32(np.abs(self.features).max(initial=0) / 127)
            steps = np.zeros_like(self.features) if scale == 0 else np.rint(self.features / scale).clip(-127, 127)
            return flag + struct.pack("<f", scale) + steps.astype(np.int8).tobytes()
        if precision == "float16":
            return flag + self.features.clip(-_LARGEST_FLOAT16, _LARGEST_FLOAT16).astype("<f2").tobytes()
        return flag + self.features.astype("<f4").tobytes()

    @staticmethod
    def from_bytes(data: bytes, precision: Precision = "float32") -> Message:
        """Read what `to_bytes` wrote.

        Raises:
            ValueError: If the length is not that of a message, or a feature is not a finite number.
        """
        first = 5 if precision == "int8" else 1
        if len(data) < first or (len(data) - first) % _BYTES[precision] or data[0] > 1:
            raise ValueError(
                f"{len(data)} bytes are not a message: a message has one byte, 0 or 1, and {_BYTES[precision]} for "
                f"each {precision} feature{', after 4 bytes for their scale' if precision == 'int8' else ''}"
            )
        if precision == "int8":
            (scale,) = struct.unpack_from("<f", data, 1)
            with np.errstate(all="ignore"):
                features = np.frombuffer(data, np.int8, offset=first).astype(np.float32) * np.float32(scale)
        else:
            features = np.frombuffer(data, f"<f{_BYTES[precision]}", offset=first).astype(np.float32)
        if not np.isfinite(features).all():
            raise ValueError("a message with features that are not finite is damaged: leave it out as if it were lost")
        return Message(features, bool(data[0]))

    @staticmethod
    def size(features: int, precision: Precision = "float32") -> int:
        """Return the bytes of a message with that many features."""
        return (5 if precision == "int8" else 1) + features * _BYTES[precision]
