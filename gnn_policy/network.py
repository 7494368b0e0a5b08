"""The paper's network: a CNN reads each view, a graph filter exchanges features, a shared MLP picks a move."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from gnn_policy.convolution import StridedConvolution
from gnn_policy.own_parts import own_part
from mapf_env import Action

CommRange = Literal["fixed", "connected"]
CommWeights = Literal["binary", "distance"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyConfig:
    """All that defines a policy besides its weights; the defaults are the paper's."""

    encoder: str = "released"
    """CNN that reads a view: "released" is that of the paper's released code (5 convolutions, 3 poolings), "lean" has
    3 convolutions without poolings and costs a third; or a class of your own as "module:Class", made as `lean_encoder`
    is."""
    graph_layer: str = "filter"
    """How robots use what they hear: "filter" is the paper's graph filter; or a class of your own as "module:Class",
    made and called as `GraphFilter` is."""
    features: int = 128
    """Features F that a robot extracts and communicates."""
    taps: int = 3
    """Filter taps K: K - 1 hops of communication; K = 1 is none."""
    fov_radius: int = 4
    """How many cells a robot sees in each direction (r_FOV)."""
    comm_radius: float = 5.0
    """Robots closer than this hear each other, in cells (r_COMM)."""
    comm_range: CommRange = "fixed"
    """"connected": at the start of a case comm_radius grows by 10 % until the team is connected, as in the released
    code."""
    comm_weights: CommWeights = "binary"
    """Weights of the communication graph: 1, or with "distance" 1 / distance."""
    cost_to_go: bool = False
    """See how many steps it is to the goal from each cell in view: a fourth channel, which needs the whole map."""

    def __post_init__(self) -> None:
        for name, parts in (("encoder", ENCODERS), ("graph_layer", GRAPH_LAYERS)):
            given = getattr(self, name)
            if given not in parts and ":" not in given:
                raise ValueError(f"{name} must be one of {', '.join(parts)}, or 'module:Class', got {given!r}")
        for name, known in (
            ("comm_range", get_args(CommRange)),
            ("comm_weights", get_args(CommWeights)),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")
        for name, least in (("features", 1), ("taps", 1), ("fov_radius", 2)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not self.comm_radius >= 0:
            raise ValueError(f"comm_radius must not be negative, got {self.comm_radius}")
        if self.comm_range == "connected" and self.comm_radius == 0:
            raise ValueError('comm_radius must be positive to grow, got 0.0 with comm_range "connected"')

    @property
    def channels(self) -> int:
        """Channels C of a view."""
        return 4 if self.cost_to_go else 3


def released_encoder(channels: int, side: int, features: int) -> nn.Sequential:
    """The CNN of the paper's released code for views (M, channels, side, side), to (M, features)."""
    layers: list[nn.Module] = []
    for width, pool in ((32, True), (32, False), (64, True), (64, False), (128, True)):
        layers += [nn.Conv2d(channels, width, 3, padding=1), nn.BatchNorm2d(width), nn.ReLU()]
        if pool:
            layers.append(nn.MaxPool2d(2))
            side //= 2
        channels = width
    if side == 0:
        raise ValueError("the released encoder pools three times and needs views of 8 x 8 at least: fov_radius >= 3")
    return nn.Sequential(*layers, nn.Flatten(), nn.Linear(channels * side * side, features), nn.ReLU())


def lean_encoder(channels: int, side: int, features: int) -> nn.Sequential:
    """Three convolutions for views (M, channels, side, side), to (M, features)."""
    side = ((side + 1) // 2 + 1) // 2
    kernel = min(3, side)
    # Where the last kernel covers all that is left, a convolution is a matrix product.
    last = [nn.Flatten(), nn.Linear(64 * side * side, 128)] if kernel == side else [nn.Conv2d(64, 128, kernel)]
    return nn.Sequential(
        StridedConvolution(channels, 48),
        nn.BatchNorm2d(48),
        nn.ReLU(),
        StridedConvolution(48, 64),
        nn.BatchNorm2d(64),
        nn.ReLU(),
        *last,
        nn.BatchNorm1d(128) if kernel == side else nn.BatchNorm2d(128),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(128 * (side - kernel + 1) ** 2, features),
        nn.ReLU(),
    )


ENCODERS = {"released": released_encoder, "lean": lean_encoder}


def shift_operator(graph: Float[Tensor, "*B N N"]) -> Float[Tensor, "*B N N"]:
    """The graph shift operator S = D^-1/2 A D^-1/2 of the adjacency A; the row of an isolated robot is zero.

    Source: the paper's released code; the paper leaves S open.
    """
    degree = graph.sum(-1)
    scale = torch.where(degree > 0, degree.clamp(min=1e-12).rsqrt(), 0.0)
    return scale.unsqueeze(-1) * graph * scale.unsqueeze(-2)


class GraphFilter(nn.Module):
    """The graph convolution A(X; S) = sum over k < K of S^k X A_k (equation 1 of the paper), with a bias.

    K taps make K - 1 exchanges with neighbours, so a robot's output depends on its (K - 1)-hop neighbourhood alone.
    """

    def __init__(self, in_features: int, out_features: int, taps: int) -> None:
        super().__init__()
        self.taps = taps
        self.mix = nn.Linear(taps * in_features, out_features)

    def forward(self, signal: Float[Tensor, "B N F"], graph: Float[Tensor, "B N N"]) -> Float[Tensor, "B N G"]:
        """Filter the features of all robots over the communication graph, by its shift operator."""
        shift, shifted = shift_operator(graph), [signal]
        for _ in range(self.taps - 1):
            shifted.append(torch.bmm(shift, shifted[-1]))
        return self.mix(torch.cat(shifted, dim=-1))


GRAPH_LAYERS = {"filter": GraphFilter}


def _part(what: str, name: str, known: Mapping[str, Callable[..., nn.Module]]) -> Callable[..., nn.Module]:
    """What makes the part of a network that has this name."""
    if name in known:
        return known[name]
    part = own_part(name, what, known)
    # Nothing else is called, for the name may come from a file.
    if not (isinstance(part, type) and issubclass(part, nn.Module)):
        raise ValueError(f"{what} must be a class of torch.nn.Module, which {name!r} is not")
    return part


class DecentralizedPolicy(nn.Module):
    """Views and the communication graph of a team to the logits of every robot's move.

    All robots share the weights, whose number does not depend on the team's size.

    Raises:
        ValueError: If the configuration names a part that cannot be found or is no network.
    """

    def __init__(self, config: PolicyConfig = PolicyConfig()) -> None:
        super().__init__()
        self.config = config
        make_encoder = _part("encoder", config.encoder, ENCODERS)
        make_layer = _part("graph_layer", config.graph_layer, GRAPH_LAYERS)
        self.encoder = make_encoder(config.channels, 2 * config.fov_radius + 3, config.features)
        self.filter = make_layer(config.features, config.features, config.taps)
        self.head = nn.Linear(config.features, len(Action))
        self.to(memory_format=torch.channels_last)

    def forward(self, fov: Shaped[Tensor, "B N C S S"], graph: Float[Tensor, "B N N"]) -> Float[Tensor, "B N 5"]:
        """Logits over the five moves from views (float or uint8) and adjacency."""
        features = self.extract(fov.flatten(0, 1)).unflatten(0, fov.shape[:2])
        return self.decide(self.filter(features, graph))

    def extract(self, fov: Shaped[Tensor, "M C S S"]) -> Float[Tensor, "M F"]:
        """The features that robots extract from their views and communicate."""
        config = self.config
        side = 2 * config.fov_radius + 3
        if fov.shape[-1] != side or fov.shape[-3] != config.channels:
            raise ValueError(
                f"views are {fov.shape[-3]}x{fov.shape[-2]}x{fov.shape[-1]}, this policy reads "
                f"{config.channels}x{side}x{side}: observe with fov_radius={config.fov_radius}, "
                f"{'with' if config.cost_to_go else 'without'} cost_to_go"
            )
        views = fov.to(self.head.weight.dtype, memory_format=torch.channels_last)
        if config.cost_to_go and fov.dtype == torch.uint8:  # counted from -2 r within the ring
            views[:, 3, 1:-1, 1:-1] = views[:, 3, 1:-1, 1:-1] / (2 * config.fov_radius) - 1
        return self.encoder(views)

    def decide(self, filtered: Float[Tensor, "*B F"]) -> Float[Tensor, "*B 5"]:
        """Logits from what the graph layer gives."""
        return self.head(torch.relu(filtered))
