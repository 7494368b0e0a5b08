"""The configuration that defines a policy apart from its weights; importable without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gnn_policy.settings import check_types
from mapf_env.arguments import MOST_INT, integer, lists_settings
from mapf_env.senses import Senses

ENCODER_NAMES = ("released", "lean")
GRAPH_LAYER_NAMES = ("filter", "attention")


@lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyConfig(Senses):
    """All that defines a policy besides its weights: the network, and what its robots perceive.

    The defaults are the paper's.

    Raises:
        ValueError: If a setting is out of its range.
        TypeError: If a setting has the wrong type.
    """

    encoder: str = "released"
    """CNN that reads a view: "released" is that of the paper's released code (5 convolutions, 3 poolings), "lean" has
    3 convolutions without poolings and costs a third; or a class of your own as "module:Class", made as `lean_encoder`
    is."""
    graph_layer: str = "filter"
    """The use of messages: "filter" is the paper's graph filter, "attention" weighs messages by edge
    features; or a class of your own as "module:Class", made and called as `GraphFilter` is."""
    features: int = 128
    """Features F that a robot extracts and communicates."""
    taps: int = 3
    """Filter taps K: K - 1 rounds of messages; K = 1 means no communication."""

    def __post_init__(self) -> None:
        Senses.__post_init__(self)
        check_types(self)
        for name, parts in (("encoder", ENCODER_NAMES), ("graph_layer", GRAPH_LAYER_NAMES)):
            given = getattr(self, name)
            if given not in parts and ":" not in given:
                raise ValueError(f"{name} must be one of {', '.join(parts)}, or 'module:Class', got {given!r}")
        for name, least in (("features", 1), ("taps", 1), ("fov_radius", 2)):
            integer(getattr(self, name), name, least, MOST_INT)

    def require_perceived(self, view: Sequence[int], scalars: int) -> None:
        """Compare what a robot perceives with what the policy reads.

        Args:
            view: The shape (C, S, S) of a view.
            scalars: The number of robot features; those that the policy does not read come last.

        Raises:
            ValueError: If they do not fit.
        """
        expected = (self.num_channels, self.fov_side, self.fov_side)
        if tuple(view) != expected:
            raise ValueError(
                f"views are {tuple(view)}, this policy reads {expected}: make the environment with "
                f"fov_radius={self.fov_radius} and extra_channels={self.extra_channels}"
            )
        if scalars < self.num_robot_features:
            raise ValueError(
                f"robots have {scalars} scalars, this policy reads {self.num_robot_features}: make the environment "
                f"with robot_features={self.robot_features} and memory={self.memory}"
            )

    def decoded(self, view: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """Return a view (C, S, S) of float or uint8 as float32."""
        values = np.array(view, np.float32)
        if view.dtype == np.uint8:
            for channel, (unit, low) in enumerate(zip(self.channel_unit, self.channel_low, strict=True)):
                if unit != 1 or low != 0:
                    values[channel] = values[channel] / unit + low
        return values

    @property
    def plugins(self) -> dict[str, str]:
        """The settings that name a class of the user's own, and the names, as "module:Class"."""
        return {name: part for name in ("encoder", "graph_layer") if ":" in (part := getattr(self, name))}
