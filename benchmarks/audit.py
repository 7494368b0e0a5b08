"""Random joint actions by the million through the environment, with an independent audit of every executed step.

The audit reads the positions before and after a step and shares no code with the environment. The exit status is 1 if
it finds a collision or any other fault.

    python benchmarks/audit.py
    python benchmarks/audit.py --robots 100000 --steps 1000000
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import tyro
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from mapf_env import BatchedEnv

ROW = np.array([-1, 0, 1, 0, 0])
COL = np.array([0, -1, 0, 1, 0])
IDLE = 4

Positions = npt.NDArray[np.integer]


@dataclass(frozen=True)
class Options:
    """The options of the audit."""

    steps: int = 10_000_000
    """Agent-steps in all, shared out equally over the scenes."""
    seed: int = 0
    """The seed of instances and actions."""
    robots_at_once: int = 4096
    """Robots that are stepped in one call."""
    robots: tuple[int, ...] = ()
    """Team sizes to audit instead of the scenes, on square maps of ten cells for each robot, a tenth are obstacles."""

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """The scenes to play."""
        sides = (math.ceil(math.sqrt(10 * robots)) for robots in self.robots)
        large = tuple(Scene(side, side, 0.1, robots) for side, robots in zip(sides, self.robots, strict=True))
        return large or SCENES


@dataclass(frozen=True)
class Scene:
    """Maps of one size, density and style, and a team."""

    height: int
    width: int
    density: float
    num_agents: int
    style: Literal["cells", "walls"] = "cells"


SCENES = (
    Scene(20, 20, 0.1, 10),
    Scene(20, 20, 0.1, 10, "walls"),
    Scene(20, 20, 0.1, 64),
    Scene(20, 20, 0.2, 64, "walls"),
    Scene(20, 20, 0.4, 100),
    Scene(20, 20, 0.4, 239),
    Scene(20, 20, 0.0, 399),
    Scene(50, 50, 0.1, 60),
    Scene(50, 50, 0.3, 500),
    Scene(5, 5, 0.0, 20),
    Scene(5, 5, 0.0, 24),
    Scene(5, 5, 0.0, 25),
    Scene(5, 5, 0.2, 19),
    Scene(8, 8, 0.3, 12),
    Scene(10, 30, 0.2, 40, "walls"),
    Scene(1, 12, 0.0, 6),
    Scene(2, 2, 0.0, 3),
    Scene(2, 2, 0.0, 4),
    Scene(2, 3, 0.0, 5),
    Scene(3, 3, 0.1, 7),
)


@dataclass
class Tally:
    """The counts of the audit for one scene."""

    agent_steps: int = 0
    moves: int = 0
    replaced: int = 0
    collisions: int = 0
    other_faults: int = 0
    seconds: float = 0.0

    def add(self, other: Tally) -> None:
        """Count what another tally counted."""
        for name in self.__dataclass_fields__:
            setattr(self, name, getattr(self, name) + getattr(other, name))


def audit_step(
    grids: npt.NDArray[np.bool_],
    before: Positions,
    wanted: npt.NDArray[np.integer],
    after: Positions,
    replaced: npt.NDArray[np.bool_],
) -> Tally:
    """Audit one step of B teams on maps (B, H, W): positions (B, N, 2) before and after, wanted actions (B, N).

    Collisions are robots that share a cell afterwards and robots that exchanged cells. Other faults are steps off the
    map or into obstacles, robots that neither stay nor make the wanted move, robots stopped without a reason, and
    wrong flags of replaced actions.
    """
    num_envs, height, width = grids.shape
    num_agents = before.shape[1]
    aim_row, aim_col = before[..., 0] + ROW[wanted], before[..., 1] + COL[wanted]
    stays = (after == before).all(axis=2)
    as_wanted = (after[..., 0] == aim_row) & (after[..., 1] == aim_col)

    def cell(row: npt.NDArray[np.integer], col: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
        """A number for each cell of each map, with a border of one cell, so that every target has one."""
        maps = np.arange(num_envs)[:, None] * (height + 2) * (width + 2)
        return (maps + (row + 1) * (width + 2) + col + 1).ravel()

    size = num_envs * (height + 2) * (width + 2)
    closed = np.pad(grids, ((0, 0), (1, 1), (1, 1)), constant_values=True).ravel()
    here, there = (
        cell(before[..., 0], before[..., 1]),
        cell(after[..., 0].clip(-1, height), after[..., 1].clip(-1, width)),
    )
    aim = cell(aim_row, aim_col)
    robots = np.arange(num_envs * num_agents)
    standing = np.full(size, -1)
    standing[here] = robots
    crowd = np.bincount(there, minlength=size)
    shared = int((crowd[crowd > 1] - 1).sum())
    met = standing[there]
    swapped = (met >= 0) & (met != robots) & (there[met] == here)
    facing = standing[aim]
    wants_swap = (facing >= 0) & (facing != robots) & (aim[facing] == here)
    needless = ~as_wanted.ravel() & ~closed[aim] & ~wants_swap & (crowd[aim] == 0)
    return Tally(
        agent_steps=len(robots),
        moves=int((~stays).sum()),
        replaced=int((~as_wanted).sum()),
        collisions=shared + int(swapped.sum()) // 2,
        other_faults=int(
            closed[there].sum() + (~stays & ~as_wanted).sum() + needless.sum() + (replaced == as_wanted).sum()
        ),
    )


def audit(scene: Scene, steps: int, robots_at_once: int, seed: int) -> Iterator[Tally]:
    """Play the scene for at least `steps` agent-steps and yield the tally of each joint step."""
    num_envs = max(1, robots_at_once // scene.num_agents)
    env = BatchedEnv(
        num_envs,
        num_agents=scene.num_agents,
        height=scene.height,
        width=scene.width,
        density=scene.density,
        style=scene.style,
        max_cycles=50,
        dtype="uint8",
    )
    generator = np.random.default_rng(seed)
    # Dense observations of a large team would take most of the time, or do not fit.
    observe = scene.num_agents <= robots_at_once
    env.reset(seed, observe=observe)
    grids, played = env.grids, 0
    while played < steps:
        began = time.perf_counter()
        before, wanted = env.positions, generator.integers(0, IDLE + 1, (num_envs, scene.num_agents))
        step = env.step(wanted, observe=observe)
        tally = audit_step(grids, before, wanted, env.positions, step.replaced)
        ended = step.terminated | step.truncated
        if ended.any():
            env.reset(mask=ended, observe=observe)
            grids = env.grids
        tally.seconds = time.perf_counter() - began
        played += tally.agent_steps
        yield tally


def report(tallies: dict[Scene, Tally]) -> Table:
    """The tallies as a table."""
    table = Table(title="Audit of executed steps", box=box.SIMPLE_HEAD)
    table.add_column("maps", no_wrap=True)
    for name in ("robots", "agent-steps", "moved", "replaced", "collisions", "faults", "s"):
        table.add_column(name, justify="right", no_wrap=True)
    total = Tally()
    for scene, tally in tallies.items():
        total.add(tally)
        maps = f"{scene.height}x{scene.width} {scene.density:.2f} {scene.style}"
        table.add_row(maps, str(scene.num_agents), *figures(tally))
    table.add_section()
    table.add_row("all", "", *figures(total), style="bold")
    return table


def figures(tally: Tally) -> tuple[str, ...]:
    """The cells of one row."""
    shares = (f"{count / tally.agent_steps:.1%}" for count in (tally.moves, tally.replaced))
    return f"{tally.agent_steps:,}", *shares, str(tally.collisions), str(tally.other_faults), f"{tally.seconds:.1f}"


def main(options: Options) -> int:
    """Audit all scenes; returns the exit code."""
    scenes = options.scenes
    tallies = {scene: Tally() for scene in scenes}
    share = -(-options.steps // len(scenes))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("agent-steps", total=options.steps)
        for number, scene in enumerate(scenes):
            for tally in audit(scene, share, options.robots_at_once, options.seed + number):
                tallies[scene].add(tally)
                progress.advance(bar, tally.agent_steps)
    Console(width=max(Console().width, 96)).print(report(tallies))
    return int(any(tally.collisions or tally.other_faults for tally in tallies.values()))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
