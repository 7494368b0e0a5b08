"""One robot on its own: a policy executed from its own view and the messages of its neighbours."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from gnn_policy.execution import STUCK_MEMORY, Execution
from gnn_policy.finite import require_finite
from gnn_policy.network import DecentralizedPolicy, GraphFilter

Features = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """What a robot sends to all its neighbours in one round."""

    features: Features
    """(F,) what it has gathered, over the root of its degree."""
    stuck: bool
    """Whether it is stuck (`gnn_policy.execution.is_stuck`)."""

    def to_bytes(self) -> bytes:
        """One byte, then the features as little-endian float32: 4 F + 1 bytes, 513 for the paper's F = 128."""
        return struct.pack("<?", self.stuck) + self.features.astype("<f4").tobytes()

    @staticmethod
    def from_bytes(data: bytes) -> Message:
        """What `to_bytes` wrote.

        Raises:
            ValueError: If the length is not that of a message, or a feature is not a finite number.
        """
        if len(data) % 4 != 1 or data[0] > 1:
            raise ValueError(f"{len(data)} bytes are no message: it has one byte, 0 or 1, and 4 for each feature")
        features = np.frombuffer(data, "<f4", offset=1).astype(np.float32)
        if not np.isfinite(features).all():
            raise ValueError("a message with features that are not finite is damaged: leave it out as if it were lost")
        return Message(features, bool(data[0]))


class Robot:
    """A robot that runs a policy by itself.

    A step is: `begin` with what it sees and whom it hears, then for each of `rounds` exchanges send `message` and
    `hear` those of the same round, then `act`. All robots of a team together do exactly what the network does for the
    team at once.

    The graph shift D^-1/2 A D^-1/2 needs the degree of each neighbour. A robot knows its own, the sum of the weights of
    the links on which it hears; it divides what it sends by the degree's root, and what it has received likewise, so
    degrees travel inside the features and cost no byte.

    A message that is lost adds nothing to what the robot gathers in that round. Messages carry neither names nor the
    number of the round: the radio says who sent one, and delivers it in the round in which it was sent or not at all.

    Args:
        policy: The policy; its weights are shared, and it is put into evaluation mode.
        execution: How it chooses moves; shield and communication range are matters of the world and of no account here.
        seed: Of its draws; robots of one team need different ones.

    Raises:
        ValueError: If the policy has another graph layer than the graph filter or weights that are not finite, or the
            seed is out of range.
    """

    def __init__(self, policy: DecentralizedPolicy, execution: Execution = Execution(), seed: int = 0) -> None:
        if not 0 <= seed < 2**64:
            raise ValueError(f"seed must lie in 0..2**64 - 1, got {seed}")
        if not isinstance(policy.filter, GraphFilter):
            raise ValueError(
                f"robots on their own exchange the messages of a graph filter, but this policy has the graph layer "
                f"{policy.config.graph_layer!r}: play it by rollout"
            )
        require_finite(policy.state_dict())
        self._policy, self._filter, self._execution = policy.eval(), policy.filter, execution
        self._seed = np.array(seed, np.uint64)
        self.reset()

    def reset(self) -> None:
        """Forget all steps: the next is the first one of another case."""
        self._track: deque[tuple[int, ...]] = deque(maxlen=STUCK_MEMORY)
        self._time = -1
        self._links: dict[Hashable, float] = {}
        self._gathered: list[Features] = []
        self._stuck = self._alarmed = False

    @property
    def rounds(self) -> int:
        """How many messages it sends in a step: K - 1."""
        return self._policy.config.taps - 1

    @property
    def links(self) -> Mapping[Hashable, float]:
        """The neighbours that it hears in this step and the weights of their links."""
        return self._links

    def begin(self, view: npt.NDArray[Any], links: Mapping[Hashable, float], cell: Iterable[int]) -> None:
        """Start a step; what is left of another is dropped.

        Args:
            view: (C, S, S) what it sees, as `mapf_env` shows it.
            links: The weights of the links to the neighbours that it hears, by whatever names they have: 1, or 1 /
                distance for a policy whose comm_weights are "distance".
            cell: Row and column of where it stands, in any frame that stays the same, as its odometry's.

        Raises:
            ValueError: If the view is not one that the policy reads, a feature of it is not finite, or a weight is not
            positive and finite.
        """
        wrong = [name for name, weight in links.items() if not 0 < weight < np.inf]
        if wrong:
            raise ValueError(f"links must have positive weights, got {links[wrong[0]]} to {wrong[0]!r}")
        with torch.inference_mode():
            extracted = self._policy.extract(self._tensor(view)[None])[0].cpu().numpy()
        if not np.isfinite(extracted).all():
            raise ValueError("the features of the view are not finite numbers: check the view and the policy's weights")
        self._time += 1
        self._links, self._gathered = dict(links), [extracted]
        place, centre = tuple(int(each) for each in cell), view.shape[-1] // 2
        on_goal = bool(view[1, centre, centre])
        self._stuck = self._alarmed = not on_goal and place in self._track
        self._track.append(place)

    @property
    def message(self) -> Message:
        """What it sends to its neighbours in this round."""
        if not self._gathered or len(self._gathered) > self.rounds:
            raise RuntimeError(f"there are {self.rounds} rounds in a step: begin() the next step or act()")
        return Message(self._scaled(self._gathered[-1]), self._stuck)

    def hear(self, messages: Mapping[Any, Message]) -> None:
        """Take the messages of this round that came, by the names of the links.

        Raises:
            ValueError: If one is of no link, or of another policy, or has features that are not finite.
            RuntimeError: If the rounds of the step are over.
        """
        own = self.message.features
        if strange := messages.keys() - self._links.keys():
            raise ValueError(f"got a message of {next(iter(strange))!r}, to whom begin() was given no link")
        total = np.zeros_like(own)
        for name, message in messages.items():
            if message.features.shape != own.shape:
                raise ValueError(f"{name!r} sent {message.features.shape} features, this policy has {own.shape}")
            if not np.isfinite(message.features).all():
                raise ValueError(
                    f"{name!r} sent features that are not finite: leave the message out as if it were lost"
                )
            total += np.float32(self._links[name]) * message.features
            self._alarmed |= message.stuck
        self._gathered.append(self._scaled(total))

    def logits(self) -> Features:
        """(5,) the logits of its moves.

        Raises:
            RuntimeError: If rounds are missing.
            ValueError: If they are not finite.
        """
        if len(self._gathered) != self.rounds + 1:
            raise RuntimeError(f"it heard {len(self._gathered) - 1} of {self.rounds} rounds: begin() and hear() first")
        with torch.inference_mode():
            filtered = self._filter.mix(self._tensor(np.concatenate(self._gathered)))
            logits = self._policy.decide(filtered).cpu().numpy()
        if not np.isfinite(logits).all():
            raise ValueError("the logits are not finite numbers: check the messages and the policy's weights")
        return logits

    def values(self) -> Features:
        """(5,) what each move is worth to it: logits and the noise of its draws. The PIBT shield heeds their order.

        Raises:
            RuntimeError: If rounds are missing.
        """
        return self._execution.values(self.logits(), np.array(self._alarmed), self._seed, self._time)

    def act(self) -> int:
        """The move that it wants, 0..4, that of the greatest value; the world's shield has the last word.

        Raises:
            RuntimeError: If rounds are missing.
        """
        return int(self.values().argmax())

    def _scaled(self, features: Features) -> Features:
        degree = sum(self._links.values())
        return features / np.float32(degree) ** np.float32(0.5) if degree > 0 else np.zeros_like(features)

    def _tensor(self, array: npt.NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._policy.head.weight.device)
