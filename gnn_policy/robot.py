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

from gnn_policy.acting import facts_of
from gnn_policy.execution import Execution, gumbel
from gnn_policy.finite import require_finite
from gnn_policy.layers import Links, MessageLayer, State
from gnn_policy.network import DecentralizedPolicy
from mapf_env.senses import HISTORY

Features = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """The message that a robot sends to all its neighbours in one round."""

    features: Features
    """(G,) the message of the policy's graph layer."""
    stuck: bool
    """True if the robot is stuck: off its goal and back on a cell where it stood in one of its last 16 steps."""

    def to_bytes(self) -> bytes:
        """Return one byte, then the features as little-endian float32: 4 G + 1 bytes, 513 for the paper's G = 128."""
        return struct.pack("<?", self.stuck) + self.features.astype("<f4").tobytes()

    @staticmethod
    def from_bytes(data: bytes) -> Message:
        """Read what `to_bytes` wrote.

        Raises:
            ValueError: If the length is not that of a message, or a feature is not a finite number.
        """
        if len(data) % 4 != 1 or data[0] > 1:
            raise ValueError(
                f"{len(data)} bytes are not a message: a message has one byte, 0 or 1, and 4 for each feature"
            )
        features = np.frombuffer(data, "<f4", offset=1).astype(np.float32)
        if not np.isfinite(features).all():
            raise ValueError("a message with features that are not finite is damaged: leave it out as if it were lost")
        return Message(features, bool(data[0]))


class Robot:
    """A robot that runs a policy by itself.

    A step is: `begin` with what it perceives and whom it hears, then for each of `rounds` exchanges send `message` and
    `hear` the messages of the same round, then `act`. All robots of a team together do exactly what the network does
    for the team at once.

    A message that is lost adds nothing to what the robot gathers in that round. Messages carry neither names nor the
    number of the round: the radio says who sent one, and delivers it in the round in which it was sent or not at all.

    Args:
        policy: The policy; its weights are shared, and it is put into evaluation mode.
        execution: The choice of actions, the policy's own if not given; shield and communication range belong to
            the environment and are ignored here.
        seed: Seed of its draws; robots of one team need different ones.

    Raises:
        ValueError: If the policy's graph layer cannot be run on one robot, its weights are not finite, or the seed is
            out of range.
    """

    def __init__(self, policy: DecentralizedPolicy, execution: Execution | None = None, seed: int = 0) -> None:
        if not 0 <= seed < 2**64:
            raise ValueError(f"seed must lie in 0..2**64 - 1, got {seed}")
        if not isinstance(policy.graph_layer, MessageLayer):
            raise ValueError(
                f"the graph layer {policy.config.graph_layer!r} has no start, send, receive, combine and finish "
                "(gnn_policy.layers.MessageLayer), so it cannot run on one robot: play the policy by rollout"
            )
        require_finite(policy.state_dict())
        self._policy, self._layer = policy.eval(), policy.graph_layer
        self._execution = policy.execution if execution is None else execution
        self._seed = np.array([seed], np.uint64)
        self.reset()

    def reset(self) -> None:
        """Forget all steps: the next is the first one of another episode."""
        self._track: deque[tuple[int, ...]] = deque(maxlen=HISTORY)
        self._time = -1
        self._weights: dict[Hashable, float] = {}
        self._edge_attr: dict[Hashable, Features] = {}
        self._state: State = ()
        self._round = -1
        self._stuck = self._alarmed = False
        self._greedy: npt.NDArray[np.bool_] | None = None
        self._jammed = np.zeros(1, np.bool_)

    @property
    def rounds(self) -> int:
        """The number of messages that it sends in a step."""
        return self._layer.rounds

    @property
    def links(self) -> Mapping[Hashable, float]:
        """The neighbours that it hears in this step and the weights of their links."""
        return self._weights

    def begin(
        self,
        view: npt.NDArray[Any],
        links: Mapping[Hashable, float],
        cell: Iterable[int],
        *,
        scalars: npt.ArrayLike = (),
        edge_attr: Mapping[Any, npt.ArrayLike] | None = None,
    ) -> None:
        """Start a step; anything left of another is dropped.

        Args:
            view: (C, S, S) its field of view, as `mapf_env` makes it.
            links: The weights of the links to the neighbours that it hears, by whatever names they have: 1, or 1 /
                distance for a policy whose comm_weights are "distance".
            cell: Row and column of where it stands, in any frame that stays the same, such as its odometry's.
            scalars: (K,) the robot features that the policy reads; where stuck robots fall back on their shortest way,
                those of `Execution.robot_features`.
            edge_attr: (D,) the edge features of each link, by the same names, if the policy reads any.

        Raises:
            ValueError: If something is not what the policy reads, or not finite, or a weight is not positive.
        """
        wrong = [name for name, weight in links.items() if not 0 < weight < np.inf]
        if wrong:
            raise ValueError(f"links must have positive weights, got {links[wrong[0]]} to {wrong[0]!r}")
        columns = self._policy.config.num_edge_features
        facts = {name: np.asarray((edge_attr or {}).get(name, ()), np.float32) for name in links}
        for name, fact in facts.items():
            if fact.shape != (columns,) or not np.isfinite(fact).all():
                raise ValueError(
                    f"the policy reads {columns} finite edge features ({', '.join(self._policy.config.edge_features)}) "
                    f"of each link, got {fact.tolist()} of {name!r}"
                )
        own = np.asarray(scalars, np.float32)
        if own.ndim != 1 or not np.isfinite(own).all():
            raise ValueError(f"scalars must be a row of finite numbers, got {own.tolist()}")
        if self._execution.actions == "fallback":
            self._greedy = facts_of(own[None], self._policy.config, self._execution)["greedy_moves"]
        with torch.inference_mode():
            extracted = self._policy.extract(self._tensor(view)[None], self._tensor(own)[None])
            if not bool(torch.isfinite(extracted).all()):
                raise ValueError("the features of the view are not finite: check the view and the policy's weights")
            self._weights, self._edge_attr = dict(links), facts
            self._state = self._layer.start(extracted, self._links(links))
        self._time += 1
        self._round = 0
        place, centre = tuple(int(each) for each in cell), view.shape[-1] // 2
        on_goal = bool(view[1, centre, centre])
        self._stuck = self._alarmed = not on_goal and place in self._track
        cells = len({*self._track, place})
        self._jammed = np.array([not on_goal and len(self._track) == HISTORY and cells <= 3])
        self._track.append(place)

    @property
    def message(self) -> Message:
        """The message for its neighbours in this round."""
        if not 0 <= self._round < self.rounds:
            raise RuntimeError(f"there are {self.rounds} rounds in a step: begin() the next step or act()")
        with torch.inference_mode():
            sent = self._layer.send(self._state, self._round)[0].float().cpu().numpy()
        return Message(sent, self._stuck)

    def hear(self, messages: Mapping[Any, Message]) -> None:
        """Take the messages of this round that came, by the names of the links.

        Raises:
            ValueError: If one came over no link, or is of another policy, or has features that are not finite.
            RuntimeError: If the rounds of the step are over.
        """
        size = self.message.features.shape
        if strange := messages.keys() - self._weights.keys():
            raise ValueError(f"got a message of {next(iter(strange))!r}, to whom begin() was given no link")
        for name, message in messages.items():
            if message.features.shape != size:
                raise ValueError(f"{name!r} sent {message.features.shape} features, this policy has {size}")
            if not np.isfinite(message.features).all():
                raise ValueError(
                    f"{name!r} sent features that are not finite: leave the message out as if it were lost"
                )
            self._alarmed |= message.stuck and self._execution.actions == "stuck"
        names = [name for name in self._weights if name in messages]  # in the links' order, as the network sums them
        heard = np.array([messages[name].features for name in names], np.float32).reshape(len(names), *size)
        with torch.inference_mode():
            received = self._layer.receive(self._state, self._tensor(heard), self._links(names), self._round)
            self._state = self._layer.combine(self._state, received, self._round)
        self._round += 1

    def logits(self) -> Features:
        """Return the logits (5,) of its moves.

        Raises:
            RuntimeError: If rounds are missing.
            ValueError: If they are not finite.
        """
        if self._round != self.rounds:
            raise RuntimeError(f"it heard {max(self._round, 0)} of {self.rounds} rounds: begin() and hear() first")
        with torch.inference_mode():
            logits = self._policy.decide(self._layer.finish(self._state))[0].float().cpu().numpy()
        if not np.isfinite(logits).all():
            raise ValueError("the logits are not finite numbers: check the messages and the policy's weights")
        return logits

    def scores(self) -> Features:
        """Return a score (5,) for each move: its logits and the noise of its draws. The PIBT shield takes their order.

        Raises:
            RuntimeError: If rounds are missing.
        """

        def noise(drawn: npt.NDArray[np.bool_]) -> Features:
            return gumbel(self._seed, np.array([self._time]))

        return self._execution.scores(
            self.logits()[None], np.array([self._alarmed]), noise, self._greedy, self._jammed
        )[0]

    def act(self) -> int:
        """Return the move that it wants, 0..4, the one with the greatest score; the environment's shield decides.

        Raises:
            RuntimeError: If rounds are missing.
        """
        return int(self.scores().argmax())

    def _links(self, names: Iterable[Hashable]) -> Links:
        chosen = list(names)
        attr = np.array([self._edge_attr[name] for name in chosen], np.float32)
        return Links(
            torch.zeros(len(chosen), dtype=torch.int64, device=self._policy.head.weight.device),
            self._tensor(np.array([self._weights[name] for name in chosen], np.float32)),
            self._tensor(attr.reshape(len(chosen), self._policy.config.num_edge_features)),
        )

    def _tensor(self, array: npt.NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._policy.head.weight.device)
