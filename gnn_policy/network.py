"""The paper's network: a CNN reads each view, a graph filter exchanges features, a shared MLP picks a move."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from gnn_policy.convolution import StridedConvolution
from gnn_policy.plugins import import_by_name
from gnn_policy.policy_config import PolicyConfig
from mapf_env import Action


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
    part = import_by_name(name, what, known)
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
        if config.cost_to_go and fov.dtype == torch.uint8:  # counted from -2 r
            views[:, 3] = views[:, 3] / (2 * config.fov_radius) - 1
        return self.encoder(views)

    def decide(self, filtered: Float[Tensor, "*B F"]) -> Float[Tensor, "*B 5"]:
        """Logits from what the graph layer gives."""
        return self.head(torch.relu(filtered))
