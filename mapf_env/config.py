"""The settings of an environment, each with its default."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mapf_env import arguments
from mapf_env.generation import Style, check_map, style_name
from mapf_env.rewards import SCHEMES, Rewards

Channel = Literal["cost_to_go", "other_goals", "previous_positions"]
CHANNELS: tuple[Channel, ...] = ("cost_to_go", "other_goals", "previous_positions")
"""Channels beyond the paper, in the native core's order."""

_CHOICES = {
    "comm_range": ("fixed", "connected"),
    "comm_weights": ("binary", "distance"),
    "shield": ("idle", "pibt"),
    "task": ("one_shot", "lifelong"),
    "dtype": ("float32", "uint8"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvConfig:
    """The settings of an environment; the defaults are the paper's setup.

    Raises:
        ValueError: If a setting is out of its range, or the map has no room for the robots.
        TypeError: If a number or a sequence of channels is none.
    """

    num_agents: int = 10
    """Robots N in a team."""
    height: int = 20
    """Rows of random maps."""
    width: int = 20
    """Columns of random maps."""
    density: float = 0.1
    """Share of obstacles on the random maps."""
    style: Style = "cells"
    """Random maps of independent "cells", short "walls" as in the paper's released generator, or of a style that has no
    density: "maze", "room", "warehouse", whose parts have sizes as `Maze`, `Rooms` or `Warehouse`, and "empty"."""
    fov_radius: int = 4
    """How many cells a robot sees in each direction (the paper's r_FOV)."""
    extra_channels: tuple[Channel, ...] = ()
    """Channels of the views after the paper's three: "cost_to_go", "other_goals", "previous_positions"."""
    comm_radius: float = 5.0
    """Robots closer than this hear each other, in cells (the paper's r_COMM)."""
    comm_range: Literal["fixed", "connected"] = "fixed"
    """"connected": at reset comm_radius grows by 10% until the team is connected, as in the paper's released code."""
    comm_weights: Literal["binary", "distance"] = "binary"
    """Weights of the communication graph: 1, or 1 / distance."""
    message_loss: float = 0.0
    """Probability that an edge of the communication graph fails in a step."""
    shield: Literal["idle", "pibt"] = "idle"
    """Collision shielding: "idle" is the paper's, "pibt" pushes robots aside by priority."""
    task: Literal["one_shot", "lifelong"] = "one_shot"
    """"lifelong": a robot on its goal gets a new one at the end of the step, and only max_cycles ends the episode."""
    reward: str | Rewards = "flowtime"
    """A scheme of `mapf_env.SCHEMES`, or `Rewards` of one's own."""
    max_cycles: int = 128
    """Steps after which an episode is truncated (T_max)."""
    dtype: Literal["float32", "uint8"] = "float32"
    """The dtype of the views."""

    def __post_init__(self) -> None:
        for name in ("num_agents", "height", "width", "fov_radius", "max_cycles"):
            object.__setattr__(self, name, arguments.integer(getattr(self, name), name, 1, arguments.MOST_INT))
        check_map(self.height, self.width, self.density, self.fov_radius)
        if not arguments.number(self.comm_radius, "comm_radius") >= 0.0:
            raise ValueError(f"comm_radius must not be negative, got {self.comm_radius}")
        arguments.share(self.message_loss, "message_loss")
        for name, known in _CHOICES.items():
            arguments.choice(getattr(self, name), known, name)
        if self.comm_range == "connected" and self.comm_radius == 0.0:
            raise ValueError('comm_radius must be positive to grow, got 0.0 with comm_range="connected"')
        object.__setattr__(self, "extra_channels", tuple(arguments.each_of(self.extra_channels, str, "extra_channels")))
        unknown = [channel for channel in self.extra_channels if channel not in CHANNELS]
        if unknown or len(set(self.extra_channels)) < len(self.extra_channels):
            raise ValueError(f"extra_channels must be some of {', '.join(CHANNELS)}, got {self.extra_channels}")
        if "cost_to_go" in self.extra_channels and self.dtype == "uint8" and self.fov_radius > 63:
            raise ValueError(f"cost_to_go in uint8 needs a fov_radius of at most 63, got {self.fov_radius}")
        if not isinstance(self.reward, Rewards) and (not isinstance(self.reward, str) or self.reward not in SCHEMES):
            raise ValueError(f"reward must be Rewards or one of {', '.join(SCHEMES)}, got {self.reward!r}")
        if style_name(self.style) not in ("cells", "walls"):
            return  # whether there is room shows when a map is drawn
        free = self.height * self.width - round(self.density * self.height * self.width)
        if free < max(self.num_agents, 2):
            raise ValueError(
                f"a {self.height}x{self.width} map of density {self.density} has {free} free cells, too few for "
                f"{self.num_agents} agents with goals of their own: ask for fewer agents or a lower density"
            )

    @property
    def fov_side(self) -> int:
        """Rows and columns of a view, its ring included."""
        return 2 * self.fov_radius + 3

    @property
    def num_channels(self) -> int:
        """Channels of a view: the paper's three and the extra ones."""
        return 3 + len(self.extra_channels)

    @property
    def rewards(self) -> Rewards:
        """The parts of the reward."""
        return self.reward if isinstance(self.reward, Rewards) else SCHEMES[self.reward]

    @property
    def needs_distances(self) -> bool:
        """Whether the environment has to know every robot's distances to its goal."""
        return "cost_to_go" in self.extra_channels or self.rewards.closer != 0.0
