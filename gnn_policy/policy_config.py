"""The configuration that defines a policy apart from its weights; importable without torch."""

from __future__ import annotations

from dataclasses import dataclass

from gnn_policy.settings import check_types
from mapf_env.arguments import MOST_INT, integer
from mapf_env.senses import Senses

ENCODER_NAMES = ("released", "lean")
GRAPH_LAYER_NAMES = ("filter", "attention")


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

    @property
    def plugins(self) -> dict[str, str]:
        """The settings that name a class of the user's own, and the names, as "module:Class"."""
        return {name: part for name in ("encoder", "graph_layer") if ":" in (part := getattr(self, name))}
