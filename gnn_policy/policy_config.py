"""What defines a policy besides its weights; importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gnn_policy.settings import check_types
from mapf_env.arguments import MOST_INT, integer

CommRange = Literal["fixed", "connected"]
CommWeights = Literal["binary", "distance"]

ENCODER_NAMES = ("released", "lean")
GRAPH_LAYER_NAMES = ("filter",)


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyConfig:
    """All that defines a policy besides its weights; the defaults are the paper's.

    Raises:
        ValueError: If a setting is out of its range.
        TypeError: If a setting has the wrong type.
    """

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
        check_types(self)
        for name, parts in (("encoder", ENCODER_NAMES), ("graph_layer", GRAPH_LAYER_NAMES)):
            given = getattr(self, name)
            if given not in parts and ":" not in given:
                raise ValueError(f"{name} must be one of {', '.join(parts)}, or 'module:Class', got {given!r}")
        for name, least in (("features", 1), ("taps", 1), ("fov_radius", 2)):
            integer(getattr(self, name), name, least, MOST_INT)
        if not self.comm_radius >= 0:
            raise ValueError(f"comm_radius must not be negative, got {self.comm_radius}")
        if self.comm_range == "connected" and self.comm_radius == 0:
            raise ValueError('comm_radius must be positive to grow, got 0.0 with comm_range "connected"')

    @property
    def channels(self) -> int:
        """Channels C of a view."""
        return 4 if self.cost_to_go else 3

    @property
    def plugins(self) -> dict[str, str]:
        """The settings that name a class of the user's own, and the names, as "module:Class"."""
        return {name: part for name in ("encoder", "graph_layer") if ":" in (part := getattr(self, name))}
