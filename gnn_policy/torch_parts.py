"""A policy's parts for one robot, computed by torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from gnn_policy.finite import require_finite
from gnn_policy.layers import Links, MessageLayer
from gnn_policy.robot.parts import Features, Heard, State

if TYPE_CHECKING:
    from gnn_policy.network import DecentralizedPolicy


class TorchParts:
    """The modules of a policy, which is put into evaluation mode; the weights are shared (`gnn_policy.robot.parts`).

    Raises:
        ValueError: If the graph layer cannot be run on one robot, or a weight is not finite.
    """

    def __init__(self, policy: DecentralizedPolicy) -> None:
        self.layer = message_layer(policy)
        require_finite(policy.state_dict())
        self.policy = policy.eval()
        self.config, self.execution, self.rounds = policy.config, policy.execution, self.layer.rounds

    def encode(self, view: Features, scalars: Features, links: Heard) -> State:
        """Return the first state of the graph layer."""
        with torch.inference_mode():
            features = self.policy.extract(self._tensor(view[None]), self._tensor(scalars[None]))
            return _arrays(self.layer.start(features, self._links(links)))

    def send(self, state: State, number: int) -> Features:
        """Return the message (G,) of round `number`."""
        with torch.inference_mode():
            return self.layer.send(self._tensors(state), number)[0].float().cpu().numpy()

    def combine(self, state: State, messages: Features, links: Heard, number: int) -> State:
        """Return the state after round `number`."""
        with torch.inference_mode():
            own = self._tensors(state)
            received = self.layer.receive(own, self._tensor(messages), self._links(links), number)
            return _arrays(self.layer.combine(own, received, number))

    def decide(self, state: State) -> Features:
        """Return the logits (5,)."""
        with torch.inference_mode():
            return self.policy.decide(self.layer.finish(self._tensors(state)))[0].float().cpu().numpy()

    def _links(self, links: Heard) -> Links:
        receiver = torch.zeros(len(links.weight), dtype=torch.int64, device=self.policy.head.weight.device)
        return Links(receiver, self._tensor(links.weight), self._tensor(links.attr))

    def _tensors(self, state: State) -> tuple[torch.Tensor, ...]:
        return tuple(self._tensor(part) for part in state)

    def _tensor(self, array: npt.NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.policy.head.weight.device)


def message_layer(policy: DecentralizedPolicy) -> MessageLayer:
    """Return the graph layer of a policy, which must work by messages.

    Raises:
        ValueError: If it does not.
    """
    if not isinstance(policy.graph_layer, MessageLayer):
        raise ValueError(
            f"the graph layer {policy.config.graph_layer!r} has no start, send, receive, combine and finish "
            "(gnn_policy.layers.MessageLayer), so it cannot run on one robot: play the policy by rollout"
        )
    return policy.graph_layer


def _arrays(state: tuple[torch.Tensor, ...]) -> State:
    return tuple(part.cpu().numpy() for part in state)
