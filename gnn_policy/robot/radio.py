"""Radios of robots: the interface, and one in memory that loses, delays, repeats and forges frames."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mapf_env.arguments import integer, share


class Radio(Protocol):
    """One robot's radio; it promises nothing: frames may be lost, late, repeated, damaged or forged."""

    def send(self, data: bytes, receivers: Iterable[int]) -> None:
        """Send to these robots; a radio that reaches everybody in range may ignore who they are."""
        ...

    def receive(self, timeout: float) -> bytes | None:
        """Return bytes that came, waiting for at most `timeout` seconds, or None."""
        ...

    def close(self) -> None:
        """Leave the air."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """The faults of a radio in memory.

    Raises:
        ValueError: If a probability is not in 0..1, or the delay is negative.
    """

    loss: float = 0.0
    """Probability that a frame is lost on its way to one receiver."""
    delay: int = 0
    """Each frame is late by 0 to this many rounds, each as likely."""
    repeat: float = 0.0
    """Probability that a frame comes twice, the second time with another delay."""
    forge: float = 0.0
    """Probability that with a frame comes another one that its sender never sent: noise, a damaged copy, the head of
    one frame on the body of another, or an old frame once more."""

    def __post_init__(self) -> None:
        for name in ("loss", "repeat", "forge"):
            share(getattr(self, name), name)
        integer(self.delay, "delay", 0)


class Ether:
    """The air of robots in one process; time goes on by `tick`, one for each round."""

    def __init__(self, faults: Faults, seed: int = 0) -> None:
        self.faults = faults
        self._random = np.random.default_rng(seed)
        self._now = 0
        self._due: dict[int, list[tuple[int, bytes]]] = {}
        self._old: list[bytes] = []
        self.sent = 0
        """Bytes sent so far, each frame once for each receiver."""

    def radio(self, number: int) -> MemoryRadio:
        """Return the radio of the robot with this number."""
        self._due.setdefault(number, [])
        return MemoryRadio(self, number)

    def tick(self) -> None:
        """Begin another round."""
        self._now += 1

    def put(self, data: bytes, receiver: int) -> None:
        """Take a frame to one robot, as the faults want it; a robot that is not there hears nothing."""
        self.sent += len(data)
        if receiver not in self._due:
            return
        faults, chance = self.faults, self._random.random
        copies = [data] if chance() >= faults.loss else []
        copies += [data] if faults.repeat and chance() < faults.repeat else []
        if faults.forge:
            copies += [self._forged(data)] if chance() < faults.forge else []
            self._old.append(data)
        for copy in copies:
            late = int(self._random.integers(faults.delay + 1)) if faults.delay else 0
            self._due[receiver].append((self._now + late, copy))

    def take(self, receiver: int) -> bytes | None:
        """Return a frame that has come to the robot, or None."""
        waiting = self._due.get(receiver, [])
        for place, (due, data) in enumerate(waiting):
            if due <= self._now:
                del waiting[place]
                return data
        return None

    def leave(self, number: int) -> None:
        """Take a robot off the air, with all that is on its way to it."""
        self._due.pop(number, None)

    def _forged(self, data: bytes) -> bytes:
        kind, other = self._random.integers(4), self._old[self._random.integers(len(self._old))] if self._old else data
        if kind == 0:
            return self._random.bytes(int(self._random.integers(2 * len(data))))
        if kind == 1:
            place = int(self._random.integers(len(data)))
            return data[:place] + bytes([data[place] ^ int(self._random.integers(1, 256))]) + data[place + 1 :]
        if kind == 2:
            half = min(len(data), len(other)) // 2
            return data[:half] + other[half:]
        return other


class MemoryRadio:
    """One robot's radio of an `Ether`."""

    def __init__(self, ether: Ether, number: int) -> None:
        self._ether, self._number = ether, number

    def send(self, data: bytes, receivers: Iterable[int]) -> None:
        """Send to these robots."""
        for receiver in receivers:
            self._ether.put(data, receiver)

    def receive(self, timeout: float = 0.0) -> bytes | None:
        """Return bytes that have come, or None; time stands still between ticks, so there is nothing to wait for."""
        return self._ether.take(self._number)

    def close(self) -> None:
        """Leave the air."""
        self._ether.leave(self._number)
