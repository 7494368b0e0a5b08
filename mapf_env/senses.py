"""Settings of perception that environments and policies share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from mapf_env import _native, arguments

CommRange = Literal["fixed", "connected"]
CommWeights = Literal["binary", "distance"]

HISTORY: int = _native.HISTORY
"""Number of last moves that every robot remembers."""

_PAPER = 3


class Channel(NamedTuple):
    """A channel of the views, as the native core declares it. As a byte, a value v is (v - low) * unit."""

    name: str
    low: float
    high: float
    unit: float
    needs_map: bool
    needs_history: bool


class Feature(NamedTuple):
    """A feature of a robot or of an edge, as the native core declares it: `width` columns of values in low..high."""

    name: str
    width: int
    low: float
    high: float
    needs_map: bool
    needs_history: bool


@cache
def channels(fov_radius: int = 4) -> dict[str, Channel]:
    """All channels by name, the paper's three first."""
    return {row[0]: Channel(*row) for row in _native.channels(fov_radius)}


@cache
def robot_features(memory: int = 4) -> dict[str, Feature]:
    """All features of robots by name."""
    return {row[0]: Feature(*row) for row in _native.robot_features(memory)}


@cache
def edge_features(memory: int = 4) -> dict[str, Feature]:
    """All features of edges by name."""
    return {row[0]: Feature(*row) for row in _native.edge_features(memory)}


@arguments.lists_settings
@dataclass(frozen=True, slots=True, kw_only=True)
class Senses:
    """The settings of a robot's perception: views, features and communication; the defaults are the paper's.

    Raises:
        ValueError: If a setting is out of its range, or a name is unknown or given twice.
        TypeError: If a setting has the wrong type.
    """

    fov_radius: int = 4
    """Cells that a robot sees in each direction (the paper's r_FOV)."""
    extra_channels: tuple[str, ...] = ()
    """Channels of the views after the paper's three, by name; `docs/environment.md` lists them."""
    robot_features: tuple[str, ...] = ()
    """Features of the robot itself, by name, as columns of `scalars`."""
    edge_features: tuple[str, ...] = ()
    """Features of each robot that it hears, by name, as columns of `edge_attr`."""
    memory: int = 4
    """Number of last moves that the features "last_moves" show, 1..16."""
    comm_radius: float = 5.0
    """Robots closer than this hear each other, in cells (the paper's r_COMM)."""
    comm_range: CommRange = "fixed"
    """"connected": at reset comm_radius grows by 10 % until the team is connected, as in the authors' code."""
    comm_weights: CommWeights = "binary"
    """Weights of the communication graph: 1, or with "distance" 1 / distance."""

    def __post_init__(self) -> None:
        radius = arguments.integer(self.fov_radius, "fov_radius", 1, arguments.MOST_INT)
        object.__setattr__(self, "fov_radius", radius)
        object.__setattr__(self, "memory", arguments.integer(self.memory, "memory", 1, HISTORY))
        known = (
            ("extra_channels", list(channels(1))[_PAPER:]),
            ("robot_features", robot_features(1)),
            ("edge_features", edge_features(1)),
        )
        for name, names in known:
            object.__setattr__(self, name, _names(getattr(self, name), name, names))
        if not arguments.number(self.comm_radius, "comm_radius") >= 0.0:
            raise ValueError(f"comm_radius must not be negative, got {self.comm_radius}")
        arguments.choice(self.comm_range, get_args(CommRange), "comm_range")
        arguments.choice(self.comm_weights, get_args(CommWeights), "comm_weights")
        if self.comm_range == "connected" and self.comm_radius == 0.0:
            raise ValueError('comm_radius must be positive to grow, got 0.0 with comm_range="connected"')

    def senses(self) -> dict[str, Any]:
        """Return exactly the fields of `Senses`, to pass them on as settings of an environment."""
        return {each.name: getattr(self, each.name) for each in fields(Senses)}

    @property
    def fov_side(self) -> int:
        """Rows and columns of a view, its ring included."""
        return 2 * self.fov_radius + 3

    @property
    def num_channels(self) -> int:
        """Channels C of a view: the paper's three and the extra ones."""
        return _PAPER + len(self.extra_channels)

    @property
    def num_robot_features(self) -> int:
        """Columns K of `scalars`."""
        return sum(each.width for each in self._robot_features())

    @property
    def num_edge_features(self) -> int:
        """Columns D of `edge_attr`."""
        return sum(each.width for each in self._edge_features())

    @property
    def needs_map(self) -> bool:
        """True if a channel or feature needs the whole map."""
        chosen = (*self._channels(), *self._robot_features(), *self._edge_features())
        return any(each.needs_map for each in chosen)

    @property
    def channel_low(self) -> npt.NDArray[np.float32]:
        """(C,) the least value of each channel; the value of a byte is byte / unit + low."""
        return np.array([each.low for each in self._channels()], np.float32)

    @property
    def channel_high(self) -> npt.NDArray[np.float32]:
        """(C,) the greatest value of each channel."""
        return np.array([each.high for each in self._channels()], np.float32)

    @property
    def channel_unit(self) -> npt.NDArray[np.float32]:
        """(C,) the steps of a byte that are 1; the value of a byte is byte / unit + low."""
        return np.array([each.unit for each in self._channels()], np.float32)

    @property
    def robot_feature_bounds(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """The least and greatest values of each column of `scalars`, (K,) each."""
        return _bounds(self._robot_features())

    @property
    def edge_feature_bounds(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """The least and greatest values of each column of `edge_attr`, (D,) each."""
        return _bounds(self._edge_features())

    def _channels(self) -> list[Channel]:
        known = channels(self.fov_radius)
        return [known[name] for name in (*list(known)[:_PAPER], *self.extra_channels)]

    def _robot_features(self) -> list[Feature]:
        return [robot_features(self.memory)[name] for name in self.robot_features]

    def _edge_features(self) -> list[Feature]:
        return [edge_features(self.memory)[name] for name in self.edge_features]


def require_bytes(senses: Senses) -> None:
    """Raise ValueError if a channel takes more values than a byte has."""
    for channel in senses._channels():
        values = round((channel.high - channel.low) * channel.unit) + 1
        if values > 256:
            raise ValueError(
                f"{channel.name} takes {values} values with fov_radius={senses.fov_radius}, a byte has 256: "
                "use a smaller fov_radius, or float32 instead of uint8"
            )


def _bounds(chosen: list[Feature]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    widths = [each.width for each in chosen]
    low, high = ([getattr(each, side) for each in chosen] for side in ("low", "high"))
    return np.repeat(np.array(low, np.float32), widths), np.repeat(np.array(high, np.float32), widths)


def _names(given: Iterable[str], name: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return the given names as a tuple; each must be known and occur once."""
    if isinstance(given, str):
        raise TypeError(f'{name} must be a sequence of names such as ("{given}",), got {given!r}')
    names = tuple(arguments.each_of(given, str, name))
    unknown = [each for each in names if each not in known]
    if unknown or len(set(names)) < len(names):
        fault = f"{unknown[0]!r} is not one of them" if unknown else f"{names} has one twice"
        raise ValueError(f"{name} must be some of {', '.join(known)}: {fault}")
    return names
