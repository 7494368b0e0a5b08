"""The paper's network: a CNN reads each view, a graph layer exchanges features, a shared MLP picks a move."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from gnn_policy.acting import act
from gnn_policy.convolution import StridedConvolution
from gnn_policy.execution import Execution
from gnn_policy.layers import GRAPH_LAYERS, MessageLayer, exchange_in_parts
from gnn_policy.plugins import import_by_name
from gnn_policy.policy_config import PolicyConfig
from gnn_policy.torch_parts import TorchParts
from mapf_env import Action, Bag


def released_encoder(channels: int, side: int, features: int) -> nn.Sequential:
    """The CNN of the paper's released code for views (M, channels, side, side), to (M, features)."""
    layers: list[nn.Module] = []
    for width, pool in ((32, True), (32, False), (64, True), (64, False), (128, True)):
        layers += [nn.Conv2d(channels, width, 3, padding=1), nn.BatchNorm2d(width), nn.ReLU(inplace=True)]
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
        nn.ReLU(inplace=True),
        StridedConvolution(48, 64),
        nn.BatchNorm2d(64),
        nn.ReLU(inplace=True),
        *last,
        nn.BatchNorm1d(128) if kernel == side else nn.BatchNorm2d(128),
        nn.ReLU(inplace=True),
        nn.Flatten(),
        nn.Linear(128 * (side - kernel + 1) ** 2, features),
        nn.ReLU(inplace=True),
    )


_AT_ONCE = 4096
"""Robots whose views are read, and links gathered, at a time where no gradients are needed."""

ENCODERS = {"released": released_encoder, "lean": lean_encoder}


def _part(what: str, name: str, known: Mapping[str, Callable[..., nn.Module]]) -> Callable[..., nn.Module]:
    """Return the maker of the part of a network that has this name."""
    if name in known:
        return known[name]
    part = import_by_name(name, what, known)
    if not (isinstance(part, type) and issubclass(part, nn.Module)):
        raise ValueError(f"{what} must be a class of torch.nn.Module, which {name!r} is not")
    return part


class DecentralizedPolicy(nn.Module):
    """The network: what the robots of a bag see, know and hear, to the logits of every robot's move.

    All robots share the weights, whose number does not depend on the size of a team.

    Args:
        config: The network and what its robots perceive.
        execution: How the policy is executed unless a caller says otherwise; it is saved with the weights.

    Raises:
        ValueError: If the configuration names a part that cannot be found or is not a network.
    """

    def __init__(self, config: PolicyConfig = PolicyConfig(), execution: Execution = Execution()) -> None:
        super().__init__()
        self.config, self.execution = config, execution
        F, K, D = config.features, config.num_robot_features, config.num_edge_features
        make_encoder = _part("encoder", config.encoder, ENCODERS)
        make_layer = _part("graph_layer", config.graph_layer, GRAPH_LAYERS)
        self.encoder = make_encoder(config.num_channels, config.fov_side, F)
        self.join = nn.Sequential(nn.Linear(F + K, F), nn.ReLU()) if K else None
        self.graph_layer = make_layer(F, F, config.taps, D)
        self.head = nn.Linear(F, len(Action))
        self.to(memory_format=torch.channels_last)

    def forward(self, bag: Bag) -> Float[Tensor, "M 5"]:
        """Return the logits over the five moves of each robot of a bag, whose arrays are tensors.

        Raises:
            ValueError: If views, scalars or edge features are not those that the policy was made for.
        """
        D = self.config.num_edge_features
        if bag.edge_attr.shape[-1] != D:
            raise ValueError(
                f"links have {bag.edge_attr.shape[-1]} features, this policy reads {D}: make the environment with "
                f"edge_features={self.config.edge_features} and memory={self.config.memory}"
            )
        layer = self.graph_layer
        if self.training or torch.is_grad_enabled() or len(bag.team) <= _AT_ONCE or not isinstance(layer, MessageLayer):
            return self.decide(layer(self.extract(bag.fov, bag.scalars), bag))
        features = map(self.extract, bag.fov.split(_AT_ONCE), bag.scalars.split(_AT_ONCE))
        return torch.cat([self.decide(each) for each in exchange_in_parts(layer, features, bag, _AT_ONCE)])

    def extract(self, fov: Shaped[Tensor, "M C S S"], scalars: Float[Tensor, "M K"]) -> Float[Tensor, "M F"]:
        """Return the features that robots make from their views (float or uint8) and scalars, and communicate.

        Raises:
            ValueError: If views or scalars are not those that the policy was made for.
        """
        config, K = self.config, self.config.num_robot_features
        config.require_perceived(fov.shape[1:], scalars.shape[-1])
        dtype = self.head.weight.dtype
        views = fov.to(dtype, memory_format=torch.channels_last)
        if fov.dtype == torch.uint8:
            for channel, (unit, low) in enumerate(zip(config.channel_unit, config.channel_low, strict=True)):
                if unit != 1 or low != 0:
                    views[:, channel] = views[:, channel] / float(unit) + float(low)
        features = self.encoder(views)
        if self.join is None:
            return features
        return self.join(torch.cat([features, scalars[:, :K].to(features.dtype)], dim=-1))

    def decide(self, gathered: Float[Tensor, "M F"]) -> Float[Tensor, "M 5"]:
        """Return the logits from what the graph layer gives."""
        return self.head(torch.relu(gathered))

    def env_settings(self) -> dict[str, Any]:
        """Return the settings of an environment in which robots perceive what the policy needs, under its shield."""
        return self.execution.env_settings(self.config)

    def parts(self) -> TorchParts:
        """Return what a `Robot` runs.

        Raises:
            ValueError: If the graph layer cannot be run on one robot, or a weight is not finite.
        """
        return TorchParts(self)

    def act(
        self,
        observation: Any,
        *,
        execution: Execution | None = None,
        seed: int | np.random.Generator | None = None,
    ) -> Any:
        """Choose actions from the observations of an environment that was made with `env_settings`.

        Args:
            observation: What `parallel_env` (a dictionary by agent), `BatchedEnv` (an `Observation` or a `Bag`) or
                `TeamEnv` (a TensorDict) returned.
            execution: How moves are chosen from logits; the policy's own if not given.
            seed: Seed of the draws. In a loop give one generator for all calls: the same number repeats the same draws.

        Returns:
            One action for each robot in the form that the environment's `step` takes: a dictionary by agent, an array
            (B, N), or, for a `Bag`, an array (M,). With a PIBT shield scores of all five moves instead of each
            action: (5,), (B, N, 5) or (M, 5); `parallel_env` takes them with preferences=True.

        Raises:
            ValueError: If views, scalars or edge features have other shapes than those that the policy reads.
            TypeError: If it is something else.
        """
        return act(self, observation, execution or self.execution, np.random.default_rng(seed))
