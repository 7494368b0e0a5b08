"""Throughput of lifelong play on maps of several kinds: `python benchmarks/lifelong.py [--movingai FOLDER]`.

Rows are random mazes, rooms, warehouses and cells, and maps of MovingAI's benchmark where a folder of them is given.
Starts and goals are the same for each method; later goals are drawn uniformly from the cells that a robot can reach. It
prints a table in Markdown: goals reached per step with 95 % intervals, and milliseconds a step of one team.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
import tyro
from rich.console import Console
from rich.progress import Progress

from gnn_policy.command_line import run_command
from gnn_policy.cores import cpu_threads
from gnn_policy.metrics import Estimate
from mapf_env import Instance, Maze, Rooms, Warehouse, distances, load_map, random_instance, random_map
from mapf_env.generation import Style
from pogema_methods import Method, method_named

SEED = 2
"""Seed of maps, starts and goals; no training has it."""
RANDOM: dict[str, tuple[Style, int, int, float, int]] = {
    "cells, 20 %": ("cells", 32, 32, 0.2, 100),
    "maze, corridors of 1": (Maze(loops=0.3), 21, 21, 0.0, 32),
    "maze, corridors of 2": (Maze(corridor_width=2, loops=0.3), 31, 31, 0.0, 64),
    "rooms": (Rooms(room_size=5), 31, 31, 0.0, 64),
    "warehouse": (Warehouse(shelf_length=8), 21, 34, 0.0, 60),
}
"""Style, rows, columns, density and robots of each row."""
MOVINGAI = {
    "random-32-32-20": 100,
    "maze-32-32-4": 50,
    "room-32-32-4": 50,
    "warehouse-10-20-10-2-1": 150,
    "den312d": 100,
    "Berlin_1_256": 200,
}
"""Robots on each map."""


@dataclass(frozen=True)
class Options:
    """Compare methods in lifelong play and print a table."""

    movingai: Path | None = None
    """The folder of MovingAI's maps."""
    methods: tuple[str, ...] = ("pibt", "pibt_swap", "rolling", "general")
    """As for benchmarks/pogema.py."""
    cases: int = 16
    """Instances of each row."""
    steps: int = 256
    """Steps of an episode."""
    threads: int = 1
    """CPU threads of the network; 0 takes all that the process may use."""


def problem(grid: npt.NDArray[np.bool_], robots: int, steps: int, seed: int) -> tuple[Instance, npt.NDArray[np.int32]]:
    """Return an instance and the goals (N, steps, 2) that follow."""
    instance = random_instance(grid=grid, num_agents=robots, seed=10**6 * SEED + seed)
    rng, ways = np.random.default_rng([SEED, seed]), distances(grid, instance.starts)
    following = []
    for way in ways:
        region = np.argwhere(way >= 0)
        following.append(region[rng.integers(len(region), size=steps)])
    return instance, np.array(following, np.int32)


def rows(options: Options) -> Iterator[tuple[str, list[tuple[Instance, npt.NDArray[np.int32]]]]]:
    """Yield the name and the problems of each row."""
    for name, (style, height, width, density, robots) in RANDOM.items():
        grids = [
            random_map(height=height, width=width, density=density, style=style, seed=10**6 * SEED + case)
            for case in range(options.cases)
        ]
        yield f"{name}, {robots}", [problem(grid, robots, options.steps, case) for case, grid in enumerate(grids)]
    for name, robots in MOVINGAI.items() if options.movingai is not None else ():
        grid = load_map(Path(options.movingai or "") / f"{name}.map")
        yield f"{name}, {robots}", [problem(grid, robots, options.steps, case) for case in range(options.cases)]


def measured(
    method: Method, problems: list[tuple[Instance, npt.NDArray[np.int32]]], steps: int
) -> tuple[Estimate, float]:
    """Return the throughput, and the seconds of a joint step of one team."""
    if method.serve is None:
        raise ValueError(f"{method.name} plans to the end of an instance, and lifelong play has none: leave it out")
    instances, goals = [each for each, _ in problems], [own for _, own in problems]
    began = time.perf_counter()
    arrivals = method.serve(instances, goals, steps, 0)
    seconds = time.perf_counter() - began
    return Estimate.average(np.array(arrivals, np.float64) / steps), seconds / steps / len(problems)


def main(options: Options) -> None:
    """Run the command."""
    if options.cases < 1 or options.steps < 1:
        raise ValueError(f"--cases and --steps must be at least 1, got {options.cases} and {options.steps}")
    torch.set_num_threads(cpu_threads(options.threads))
    methods = [method_named(words) for words in options.methods]
    console = Console(markup=False, soft_wrap=True, highlight=False)
    console.print("| map, robots | " + " | ".join(method.name for method in methods) + " |")
    console.print("|---|" + "---|" * len(methods))
    problems = list(rows(options))
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("", total=len(problems) * len(methods))
        for name, own in problems:
            cells = []
            for method in methods:
                progress.update(task, description=f"{name}: {method.name}")
                found, seconds = measured(method, own, options.steps)
                cells.append(f"{found.mean:.2f} [{found.low:.2f}, {found.high:.2f}], {1000 * seconds:.2f} ms")
                progress.advance(task)
            console.print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    run_command(lambda arguments: tyro.cli(Options, args=arguments, description=__doc__), main)
