"""The settings of an environment, each with its default."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy.typing as npt

from mapf_env import arguments
from mapf_env.generation import Style, check_map, style_name
from mapf_env.instance import as_obstacles
from mapf_env.rewards import SCHEMES, Rewards
from mapf_env.senses import Senses, require_bytes

Shield = Literal["idle", "pibt", "pibt_swap"]
Task = Literal["one_shot", "lifelong"]
Dtype = Literal["float32", "uint8"]


@arguments.lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class EnvConfig(Senses):
    """The settings of an environment: those of `Senses` and these; the defaults are the paper's setup.

    Raises:
        ValueError: If a setting is out of its range, or the map has no room for the robots.
        TypeError: If a setting has the wrong type.
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
    """Random maps of independent "cells", short "walls" as the authors' generator builds them, or a style without
    density: "maze", "room", "warehouse", whose sizes `Maze`, `Rooms` or `Warehouse` set, and "empty"."""
    message_loss: float = 0.0
    """Probability that an edge of the communication graph fails in a step."""
    shield: Shield = "idle"
    """Collision shielding: "idle" is the paper's, "pibt" pushes robots aside by priority, and "pibt_swap" also lets two
    robots change places in a corridor, which needs the map."""
    task: Task = "one_shot"
    """"lifelong": a robot on its goal gets a new one at the end of the step, and only max_cycles ends the episode."""
    reward: str | Rewards = "flowtime"
    """A scheme of `mapf_env.SCHEMES`, or your own `Rewards`."""
    max_cycles: int = 128
    """Steps after which an episode is truncated (T_max)."""
    dtype: Dtype = "float32"
    """The dtype of the views."""

    def __post_init__(self) -> None:
        Senses.__post_init__(self)
        for name in ("num_agents", "height", "width", "max_cycles"):
            object.__setattr__(self, name, arguments.integer(getattr(self, name), name, 1, arguments.MOST_INT))
        check_map(self.height, self.width, self.density, self.fov_radius)
        arguments.share(self.message_loss, "message_loss")
        arguments.choice(self.shield, get_args(Shield), "shield")
        arguments.choice(self.task, get_args(Task), "task")
        arguments.choice(self.dtype, get_args(Dtype), "dtype")
        if self.dtype == "uint8":
            require_bytes(self)
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
    def rewards(self) -> Rewards:
        """The parts of the reward."""
        return self.reward if isinstance(self.reward, Rewards) else SCHEMES[self.reward]

    @property
    def needs_distances(self) -> bool:
        """True if the environment keeps every robot's distances to its goal."""
        return self.shield == "pibt_swap" or self.needs_map or self.rewards.closer != 0.0


def configured(settings: dict[str, Any], options: Iterable[str], grid: npt.ArrayLike | None) -> EnvConfig:
    """Return the configuration of an environment from its keyword arguments.

    Args:
        settings: Fields of `EnvConfig`.
        options: The other keyword arguments of the environment, which the message lists.
        grid: The map (H, W) of the environment, if given; it sets the height and the width.

    Raises:
        TypeError: If a setting is unknown; the message lists those that exist.
        ValueError: If a setting is out of range or contradicts the map.
    """
    arguments.known_settings(settings, [*(each.name for each in fields(EnvConfig)), *options])
    if grid is None:
        return EnvConfig(**settings)
    for name, length in zip(("height", "width"), as_obstacles(grid).shape, strict=True):
        if settings.get(name, length) != length:
            raise ValueError(f"the grid has a {name} of {length}, got {name}={settings[name]}: leave out {name}")
        settings = settings | {name: length}
    return EnvConfig(**{"density": 0.0, "style": "empty", **settings})
