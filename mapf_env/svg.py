"""Parts of SVG documents: elements that change with time, outlines of obstacles, colours and clean text."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from mapf_env.instance import Obstacles


class Clock:
    """Converts values at the times 0..`last` of a loop to SVG animation elements."""

    def __init__(self, last: int, step_seconds: float) -> None:
        self.last = last
        self.repeat = f'dur="{last * step_seconds:.6g}s" repeatCount="indefinite"'

    def smooth(self, attribute: str, track: npt.NDArray[np.number], element: str = "animate") -> str:
        """A value (last + 1, D) that moves linearly in between; only times where its velocity changes are written."""
        if (track == track[0]).all():
            return ""
        times = bends(track)
        return self._element(element, attribute, times, (",".join(f"{v:.6g}" for v in track[t]) for t in times))

    def sudden(self, attribute: str, states: Sequence[object], element: str = "animate") -> str:
        """A value for each time 0..last that is kept until the next time at which it differs."""
        times = [t for t in range(len(states)) if t == 0 or states[t] != states[t - 1]]
        if len(times) == 1:
            return ""
        return self._element(element, attribute, times, (str(states[t]) for t in times), ' calcMode="discrete"')

    def _element(
        self, element: str, attribute: str, times: Iterable[int], values: Iterable[str], mode: str = ""
    ) -> str:
        kind = ' type="translate"' if element == "animateTransform" else ""
        moments = ";".join(f"{t / self.last:.6g}" for t in times)
        return (
            f'<{element} attributeName="{attribute}"{kind}{mode} values="{";".join(values)}" '
            f'keyTimes="{moments}" {self.repeat}/>'
        )


def bends(track: npt.NDArray[np.number]) -> list[int]:
    """The times 0..T at which the velocity of `track` (T + 1, D) changes, and both ends."""
    velocity = np.diff(track, axis=0)
    changes = (velocity[1:] != velocity[:-1]).any(axis=1)
    return [0, *(np.flatnonzero(changes) + 1).tolist(), len(velocity)]


def outline(grid: Obstacles, side: int) -> str:
    """SVG path data around all obstacles: every border edge once, straight runs merged, obstacles on the right hand."""
    walls = np.pad(grid, 1)
    inner = walls[1:-1, 1:-1]
    ends: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for neighbour, tail, head in (
        (walls[:-2, 1:-1], (0, 0), (0, 1)),
        (walls[1:-1, 2:], (0, 1), (1, 1)),
        (walls[2:, 1:-1], (1, 1), (1, 0)),
        (walls[1:-1, :-2], (1, 0), (0, 0)),
    ):
        for row, col in np.argwhere(inner & ~neighbour).tolist():
            ends.setdefault((row + tail[0], col + tail[1]), []).append((row + head[0], col + head[1]))
    data = []
    for start in sorted(ends):
        while ends[start]:
            data.append(_loop(start, ends, side))
    return "".join(data)


def _loop(start: tuple[int, int], ends: dict[tuple[int, int], list[tuple[int, int]]], side: int) -> str:
    """Follow the edges from `start` until they close, using them up."""
    runs: list[list[int]] = []
    here = start
    while not runs or here != start:
        there = ends[here].pop()
        step = [there[0] - here[0], there[1] - here[1]]
        if runs and (runs[-1][0] * step[0] > 0 or runs[-1][1] * step[1] > 0):
            runs[-1] = [runs[-1][0] + step[0], runs[-1][1] + step[1]]
        else:
            runs.append(step)
        here = there
    sides = "".join(f"v{side * down}" if down else f"h{side * right}" for down, right in runs[:-1])
    return f"M{side * start[1]} {side * start[0]}{sides}z"


def printable(title: str) -> str:
    """The title with characters that XML cannot hold replaced."""
    return re.sub("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", title)


def colours(num_agents: int) -> list[str]:
    """A colour for each robot: hues all around the circle in four shades of equal chroma (Ottosson's Oklab)."""
    return [
        _oklch((0.42, 0.68, 0.52, 0.6)[i % 4], 0.16, math.radians(255 + 360 * i / num_agents))
        for i in range(num_agents)
    ]


def _oklch(lightness: float, chroma: float, hue: float) -> str:
    a, b = chroma * math.cos(hue), chroma * math.sin(hue)
    long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    linear = (
        4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short,
        -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short,
        -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short,
    )
    gamma = (
        12.92 * v if v < 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055 for v in (min(max(v, 0), 1) for v in linear)
    )
    return "#" + "".join(f"{round(255 * v):02x}" for v in gamma)
