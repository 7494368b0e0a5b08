"""A robot's driver: it perceives at the start of each step, and carries out moves."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from gnn_policy.execution import Execution
from gnn_policy.policy_config import PolicyConfig
from mapf_env.senses import robot_features

_HEADER = struct.Struct("<IiiHH")
_MOST_LINKS = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Sensed:
    """The perception of one robot at the start of a step."""

    step: int
    """The number of the step in the episode, the same for all robots."""
    cell: tuple[int, int]
    """Row and column of where it stands."""
    view: npt.NDArray[np.float32]
    """(C, S, S) what it sees, as `mapf_env` shows it; channel 0 has the obstacles, channel 1 the goal."""
    scalars: npt.NDArray[np.float32]
    """(K,) the robot features, `Execution.robot_features` of the policy."""
    links: Mapping[int, float]
    """The robots that it hears, by number, and the weights of their links."""
    edge_attr: Mapping[int, npt.NDArray[np.float32]]
    """(D,) the edge features of each link."""
    nearby: Mapping[int, tuple[int, int]]
    """The robots within two cells, by number, and their cells; a negative number if it cannot be told."""

    def to_bytes(self) -> bytes:
        """Return a header, the arrays, and the tables of links and of robots nearby, little-endian."""
        ids, near = list(self.links), list(self.nearby)
        attr = [np.asarray(self.edge_attr[name], "<f4") for name in ids]
        parts = (
            np.asarray(self.view, "<f4"),
            np.asarray(self.scalars, "<f4"),
            np.array(ids, "<i4"),
            np.array([self.links[name] for name in ids], "<f4"),
            *attr,
            np.array(near, "<i4"),
            np.array([self.nearby[name] for name in near], "<i4"),
        )
        head = _HEADER.pack(self.step, *self.cell, len(ids), len(near))
        return head + b"".join(part.tobytes() for part in parts)

    @staticmethod
    def from_bytes(data: bytes, policy: PolicyConfig, execution: Execution) -> Sensed:
        """Read what `to_bytes` wrote, for a policy that says how large the arrays are.

        Raises:
            ValueError: If the length is another one.
        """
        if len(data) < _HEADER.size:
            raise ValueError(f"{len(data)} bytes are not what a robot senses")
        step, row, col, links, near = _HEADER.unpack_from(data)
        known = robot_features(policy.memory)
        C, S, D = policy.num_channels, policy.fov_side, policy.num_edge_features
        K = sum(known[name].width for name in execution.robot_features(policy))
        counts = (C * S * S, K, links, links, links * D, near, 2 * near)
        if max(links, near) > _MOST_LINKS or len(data) != _HEADER.size + 4 * sum(counts):
            raise ValueError(
                f"{len(data)} bytes are not what a robot of this policy senses: do world and robot have the same one?"
            )
        arrays, first = [], _HEADER.size
        for count, dtype in zip(counts, ("<f4", "<f4", "<i4", "<f4", "<f4", "<i4", "<i4"), strict=True):
            arrays.append(np.frombuffer(data, dtype, count, first))
            first += 4 * count
        view, scalars, ids, weights, attr, names, cells = arrays
        senders = ids.tolist()
        return Sensed(
            *(step, (row, col), view.reshape(C, S, S), scalars),
            dict(zip(senders, weights.tolist(), strict=True)),
            dict(zip(senders, attr.reshape(links, D), strict=True)),
            {name: (r, c) for name, (r, c) in zip(names.tolist(), cells.reshape(near, 2).tolist(), strict=True)},
        )


class Driver(Protocol):
    """A robot's body. In the simulation the world process plays it; in a lab you write it.

    `gnn_policy.robot.reservation` says what it must promise so that robots never collide.
    """

    def sense(self, timeout: float) -> Sensed | None:
        """Return what is perceived at the start of the next step, one that begins after this call.

        Returns:
            None if no step has begun within `timeout` seconds.

        Raises:
            EndOfWorld: If there are no more steps.
        """
        ...

    def accept(self, step: int, move: int) -> bool | None:
        """Take a move, 0..4, for this step; it is carried out even if the robot's process ends now.

        Returns:
            False if it is refused, as after the end of the step; None if no answer came.
        """
        ...

    def propose(self, step: int, scores: npt.NDArray[np.float32]) -> None:
        """Take the scores (5,) of all moves, where the world shields the team."""
        ...


class EndOfWorld(Exception):  # noqa: N818 (an end, not an error)
    """There are no more steps."""
