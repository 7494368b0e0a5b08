"""Layers in which robots exchange messages over the communication graph.

A layer that is written as `start`, `send`, `receive`, `combine` and `finish` runs on a whole bag of robots at once
(`exchange`) and on one robot alone (`gnn_policy.Robot`): a robot sees its own state and the messages that it hears, and
nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mapf_env import Bag

State = tuple[Tensor, ...]
"""The state that a layer keeps for each of M robots between rounds: tensors (M, ...)."""


class Links(NamedTuple):
    """The E links on which M robots hear."""

    receiver: Int[Tensor, " E"]
    """The robot that hears, 0..M-1."""
    weight: Float[Tensor, " E"]
    """The link's weight in the communication graph."""
    attr: Float[Tensor, "E D"]
    """The edge features: facts about the sender, as `mapf_env.Senses.edge_features` names them."""


@runtime_checkable
class MessageLayer(Protocol):
    """A graph layer that works by rounds of messages; all tensors hold one row for each robot or link."""

    rounds: int
    """Number of messages a robot sends in a step."""

    def start(self, features: Tensor, links: Links) -> State:
        """Return the robots' first states from their features (M, F) and the links on which they hear."""
        ...

    def send(self, state: State, number: int) -> Tensor:
        """Return the message (M, G) that each robot sends to all its neighbours in round `number`."""
        ...

    def receive(self, state: State, heard: Tensor, links: Links, number: int) -> Tensor:
        """Return what each robot gathers (M, R) from the messages (E, G) that came over the links."""
        ...

    def combine(self, state: State, received: Tensor, number: int) -> State:
        """Return the robots' states after round `number`."""
        ...

    def finish(self, state: State) -> Tensor:
        """Return the robots' new features (M, F') after the last round."""
        ...


def exchange(layer: MessageLayer, features: Float[Tensor, "M F"], bag: Bag) -> Float[Tensor, "M G"]:
    """Run all rounds of `layer` for all robots of a bag at once."""
    sender, receiver = bag.edge_index[0], bag.edge_index[1]
    links = Links(receiver, bag.edge_weight, bag.edge_attr)
    state = layer.start(features, links)
    for number in range(layer.rounds):
        heard = layer.send(state, number).index_select(0, sender)
        state = layer.combine(state, layer.receive(state, heard, links, number), number)
    return layer.finish(state)


def exchange_in_parts(
    layer: MessageLayer, features: Iterator[Float[Tensor, "m F"]], bag: Bag, size: int
) -> Iterator[Float[Tensor, "m G"]]:
    """Do what `exchange` does for `size` robots at a time, so that no more memory is needed for each link.

    Args:
        layer: The layer.
        features: The features of the first `size` robots, of the next, and so on.
        bag: The bag.
        size: Robots at a time.

    Yields:
        The new features of the same robots.
    """
    if (bag.edge_index[1, 1:] < bag.edge_index[1, :-1]).any():
        order = bag.edge_index[1].argsort(stable=True)
        bag = bag._replace(
            edge_index=bag.edge_index[:, order], edge_weight=bag.edge_weight[order], edge_attr=bag.edge_attr[order]
        )
    sender, receiver = bag.edge_index[0], bag.edge_index[1]
    firsts = torch.arange(0, len(bag.team), size)
    ends = torch.searchsorted(receiver, torch.cat([firsts, firsts[-1:] + size]).to(receiver.device)).tolist()
    parts = [slice(begin, end) for begin, end in pairwise(ends)]
    links = [
        Links(receiver[part] - first, bag.edge_weight[part], bag.edge_attr[part])
        for first, part in zip(firsts.tolist(), parts, strict=True)
    ]
    states = [layer.start(each, links[part]) for part, each in enumerate(features)]
    for number in range(layer.rounds):
        sent = torch.cat([layer.send(state, number) for state in states])
        for part, state in enumerate(states):
            heard = sent.index_select(0, sender[parts[part]])
            states[part] = layer.combine(state, layer.receive(state, heard, links[part], number), number)
    yield from map(layer.finish, states)


def gather(values: Float[Tensor, "E ..."], receiver: Int[Tensor, " E"], count: int) -> Float[Tensor, "M ..."]:
    """Sum the values of all links of each receiver, of which there are `count`."""
    return values.new_zeros(count, *values.shape[1:]).index_add(0, receiver, values)


class GraphFilter(nn.Module):
    """The graph convolution A(X; S) = sum over k < K of S^k X A_k (equation 1 of the paper), with a bias.

    K taps make K - 1 exchanges with neighbours, so a robot's output depends only on its (K - 1)-hop neighbourhood. The
    shift operator is S = D^-1/2 A D^-1/2 of the weighted adjacency A; the row of an isolated robot is zero. The paper
    leaves S open; this is the choice of the authors' code. A sender divides by the root of its own degree and a
    receiver by the root of its own, so no robot needs to know a neighbour's degree.
    """

    def __init__(self, in_features: int, out_features: int, taps: int, edge_features: int = 0) -> None:
        super().__init__()
        self.rounds = taps - 1
        self.mix = nn.Linear(taps * in_features, out_features)

    def forward(self, features: Float[Tensor, "M F"], bag: Bag) -> Float[Tensor, "M G"]:
        """Filter the features of all robots of a bag."""
        return exchange(self, features, bag)

    def start(self, features: Tensor, links: Links) -> State:
        """Keep the features and one over the root of the degree, the sum of the weights on which a robot hears."""
        degree = gather(links.weight, links.receiver, len(features))
        scale = torch.where(degree > 0, degree.clamp(min=1e-12).rsqrt(), 0.0).unsqueeze(-1)
        return features, scale, features

    def send(self, state: State, number: int) -> Tensor:
        """Send S^k X of the last round, divided by the root of the sender's degree."""
        _, scale, shifted = state
        return scale * shifted

    def receive(self, state: State, heard: Tensor, links: Links, number: int) -> Tensor:
        """Sum the weighted messages and divide by the root of the receiver's degree."""
        _, scale, _ = state
        return scale * gather(links.weight.unsqueeze(-1) * heard, links.receiver, len(scale))

    def combine(self, state: State, received: Tensor, number: int) -> State:
        """Append S^(k + 1) X to the features gathered so far."""
        gathered, scale, _ = state
        return torch.cat([gathered, received.to(gathered.dtype)], dim=-1), scale, received

    def finish(self, state: State) -> Tensor:
        """Mix the features of all hops with the filter taps A_k."""
        return self.mix(state[0])


class _Round(nn.Module):
    """One round of `Attention`: its maps from features and edge features to messages, scores and updates."""

    def __init__(self, features: int, edge_features: int, heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(features)
        self.own = nn.Linear(features, features)
        self.message = nn.Linear(features, features)
        self.edge = nn.Linear(edge_features, features, bias=False) if edge_features else None
        self.score = nn.Parameter(torch.randn(heads, features // heads) * (heads / features) ** 0.5)
        self.update = nn.Sequential(nn.Linear(2 * features, 2 * features), nn.ReLU(), nn.Linear(2 * features, features))


class Attention(nn.Module):
    """Attention over incoming links with edge features, `taps` - 1 rounds of it.

    In each round a robot scores every message that it hears against its own state and the edge features of the link,
    takes the softmax of the scores over its incoming links for each head, and adds an update made from its state and
    the weighted sum of the messages (residual). A robot that hears nobody gathers zeros. The weights of the
    communication graph are not used.

    Source: the scores are those of GATv2 (Brody, Alon and Yahav 2022), with edge features added to the messages.

    Raises:
        ValueError: If the features cannot be divided among the heads.
    """

    heads = 4

    def __init__(self, in_features: int, out_features: int, taps: int, edge_features: int = 0) -> None:
        super().__init__()
        if in_features % self.heads:
            raise ValueError(f"features must be a multiple of the {self.heads} attention heads, got {in_features}")
        self.rounds = taps - 1
        self.layers = nn.ModuleList(_Round(in_features, edge_features, self.heads) for _ in range(self.rounds))
        self.last = nn.Linear(in_features, out_features)

    def forward(self, features: Float[Tensor, "M F"], bag: Bag) -> Float[Tensor, "M G"]:
        """Exchange messages among all robots of a bag."""
        return exchange(self, features, bag)

    def start(self, features: Tensor, links: Links) -> State:
        """Begin with the robots' features."""
        return (features,)

    def send(self, state: State, number: int) -> Tensor:
        """Send a linear map of the normalised state."""
        layer: Any = self.layers[number]
        return layer.message(layer.norm(state[0]))

    def receive(self, state: State, heard: Tensor, links: Links, number: int) -> Tensor:
        """Weight the messages by the softmax of their scores over each robot's incoming links and sum them."""
        layer: Any = self.layers[number]
        own = layer.own(layer.norm(state[0])).index_select(0, links.receiver)
        if layer.edge is not None:
            heard = heard + layer.edge(links.attr)
        value = heard.unflatten(-1, (self.heads, -1))
        hidden = torch.nn.functional.leaky_relu(own.unflatten(-1, (self.heads, -1)) + value, 0.2)
        score = (hidden * layer.score).sum(-1).float()  # (E, heads)
        count = len(state[0])
        index = links.receiver.unsqueeze(-1).expand_as(score)
        highest = score.new_full((count, self.heads), -torch.inf).scatter_reduce(0, index, score.detach(), "amax")
        weight = (score - highest.index_select(0, links.receiver)).exp()
        total = gather(weight, links.receiver, count).clamp(min=1e-12)
        summed = gather(weight.unsqueeze(-1) * value.float(), links.receiver, count)
        return (summed / total.unsqueeze(-1)).flatten(1).to(heard.dtype)

    def combine(self, state: State, received: Tensor, number: int) -> State:
        """Add an update made from the normalised state and what was gathered."""
        layer: Any = self.layers[number]
        return (state[0] + layer.update(torch.cat([layer.norm(state[0]), received], dim=-1)),)

    def finish(self, state: State) -> Tensor:
        """Map the last state to the output features."""
        return self.last(state[0])


GRAPH_LAYERS = {"filter": GraphFilter, "attention": Attention}
