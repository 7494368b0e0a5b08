"""Radio over eclipse-zenoh: peers that find each other through the world's process and then talk directly."""

from __future__ import annotations

import json
import queue
from collections.abc import Iterable, Sequence
from typing import Any

import zenoh

from gnn_policy.robot.frame import HEADER_BYTES, MOST_BODY

LOOPBACK = "tcp/127.0.0.1:0"
"""Listens on a free port of this machine and nowhere else."""
_MOST_WAITING = 4096


def open_session(listen: str, connect: Sequence[str] = ()) -> zenoh.Session:
    """Open a session of a peer without multicast: nothing is announced to the network, and only `listen` is open.

    Args:
        listen: An endpoint of zenoh, such as "tcp/127.0.0.1:7447".
        connect: Endpoints of peers that introduce the others.

    Raises:
        ValueError: If an endpoint cannot be used.
    """
    config = zenoh.Config()
    for key, value in (
        ("mode", "peer"),
        ("listen/endpoints", [listen]),
        ("connect/endpoints", list(connect)),
        ("scouting/multicast/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as refusal:
        raise ValueError(f"zenoh cannot listen on {listen} or reach {', '.join(connect)}: {refusal}") from refusal


class Inbox:
    """Bytes that came on one key, in order; those that find no room are lost, as on any radio."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._waiting: queue.Queue[bytes] = queue.Queue(_MOST_WAITING)
        self._subscriber = session.declare_subscriber(key, self._take)

    def get(self, timeout: float) -> bytes | None:
        """Return the next bytes, waiting for at most `timeout` seconds, or None."""
        try:
            return self._waiting.get(timeout > 0, max(timeout, 0))
        except queue.Empty:
            return None

    def _take(self, sample: Any) -> None:
        if len(sample.payload) > HEADER_BYTES + MOST_BODY:
            return
        try:
            self._waiting.put_nowait(sample.payload.to_bytes())
        except queue.Full:
            return


class ZenohRadio:
    """One robot's radio (`gnn_policy.robot.radio.Radio`): a key for each receiver.

    Args:
        session: The robot's session.
        number: The robot's number.
    """

    def __init__(self, session: zenoh.Session, number: int) -> None:
        self._session, self._inbox = session, Inbox(session, _key(number))

    def send(self, data: bytes, receivers: Iterable[int]) -> None:
        """Send to these robots."""
        for receiver in receivers:
            self._session.put(_key(receiver), data)

    def receive(self, timeout: float) -> bytes | None:
        """Return bytes that came, waiting for at most `timeout` seconds, or None."""
        return self._inbox.get(timeout)

    def close(self) -> None:
        """Leave the air: the session ends."""
        self._session.close()


def _key(number: int) -> str:
    return f"mapf/radio/{number}"
