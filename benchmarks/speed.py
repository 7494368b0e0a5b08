"""Agent-steps per CPU second on one thread, our environment and POGEMA's in one run.

Same team sizes, map size, density, radius of view and kind of actions (uniform, drawn beforehand); ours delivers the
communication graph as well. A bare C++ loop that writes the same bytes shows the limit of the machine. The competitors
take turns, so that slower periods of the machine affect all. POGEMA has its own virtual environment, because it
pins old packages; it is created by the first run.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import cycle
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import mapf_env
from cpu_clock import calls_per_second
from peer_venv import CACHE, peer_python

ROOT = Path(__file__).parents[1]
PEER = "pogema==1.4.0"

Dtype = Literal["float32", "uint8"]
DTYPES: tuple[Dtype, ...] = ("float32", "uint8")


@dataclass(frozen=True)
class Options:
    """The options of the measurement."""

    num_agents: tuple[int, ...] = (8, 32, 64)
    """Team sizes."""
    robots_at_once: int = 512
    """Robots in our batch: so many environments that their views stay in the cache."""
    rounds: int = 5
    """Number of turns of each competitor; medians are reported."""
    seconds: float = 0.4
    """CPU seconds of each measurement."""
    size: int = 20
    """Rows and columns of the maps."""
    density: float = 0.1
    """Share of obstacles."""
    fov_radius: int = 4
    """Cells seen in each direction (POGEMA's obs_radius)."""
    parts: tuple[Literal["peers", "threads"], ...] = ("peers", "threads")
    """The tables to measure: all environments with POGEMA and the bare loop; two threads and a large team."""
    pogema: bool = True
    """Measure POGEMA as well."""

    def num_envs(self, num_agents: int) -> int:
        """Environments in our batch."""
        return max(1, self.robots_at_once // num_agents)

    def settings(self, num_agents: int, dtype: Dtype = "float32") -> dict[str, Any]:
        """Settings of our environments."""
        return {
            "num_agents": num_agents,
            "height": self.size,
            "width": self.size,
            "density": self.density,
            "fov_radius": self.fov_radius,
            "max_cycles": 10**9,
            "dtype": dtype,
        }


@dataclass(frozen=True)
class Rates:
    """One measurement, per CPU second."""

    agent_steps: float
    resets: float
    """Resets of one environment with a new random instance."""


@dataclass(frozen=True)
class Competitor:
    """A row of the tables."""

    name: str
    measure: Callable[[int], Rates]
    compared_with: str
    """The competitor of which it is a multiple."""
    bare: str = ""
    """The bare loop that writes the same bytes, of which it is a share."""


def batched(
    options: Options, dtype: Dtype = "float32", *, own_buffers: bool = False, **settings: Any
) -> Callable[[int], Rates]:
    """Our `BatchedEnv`, with new observations or in the caller's buffers."""

    def measure(num_agents: int) -> Rates:
        num_envs = options.num_envs(num_agents)
        env = mapf_env.BatchedEnv(num_envs, **(options.settings(num_agents, dtype) | settings))
        env.reset(seed=0)
        actions = cycle(np.random.default_rng(0).integers(0, 5, (64, num_envs, num_agents)))
        out = env.buffers() if own_buffers else None
        return Rates(
            num_envs * num_agents * calls_per_second(lambda: env.step(next(actions), out=out), options.seconds),
            num_envs * calls_per_second(env.reset, options.seconds),
        )

    return measure


def pettingzoo_view(options: Options, **settings: Any) -> Callable[[int], Rates]:
    """Our PettingZoo environment."""

    def measure(num_agents: int) -> Rates:
        env = mapf_env.parallel_env(**options.settings(num_agents), **settings)
        env.reset(seed=0)
        drawn = np.random.default_rng(0).integers(0, 5, (64, num_agents)).tolist()
        actions = cycle([dict(zip(env.agents, joint, strict=True)) for joint in drawn])
        return Rates(
            num_agents * calls_per_second(lambda: env.step(next(actions)), options.seconds),
            calls_per_second(env.reset, options.seconds),
        )

    return measure


def bare_loop(
    options: Options, dtype: Dtype, program: Path, kind: Literal["views", "stores"] = "views", threads: int = 1
) -> Callable[[int], Rates]:
    """The bare C++ loop, or its stores alone; it has no resets and is written for the paper's radius of 4."""

    def measure(num_agents: int) -> Rates:
        sizes = options.num_envs(num_agents), num_agents, options.size, options.density, options.seconds
        arguments = [*map(str, sizes), dtype, kind, str(threads)]
        done = subprocess.run([str(program), *arguments], capture_output=True, text=True, check=True)
        return Rates(float(done.stdout), float("nan"))

    return measure


def compiled_bare_loop() -> Path:
    """Compile the program for this processor.

    Raises:
        CalledProcessError: If it does not compile.
        OSError: If a compiler is missing.
    """
    program = CACHE / "bare_loop"
    program.parent.mkdir(exist_ok=True)
    source = str(ROOT / "benchmarks" / "bare_loop.cpp")
    flags = ["-O3", "-march=native", "-std=c++20", "-pthread"]
    subprocess.run(["c++", *flags, source, "-o", str(program)], capture_output=True, text=True, check=True)
    return program


def threads_table(options: Options, program: Path | None) -> Table:
    """Compare two threads with one (wall-clock time), and a thousand robots on a large map with the largest team.

    The environments take turns of some milliseconds, and the best turn of each counts. Ratios have differed between
    runs of one commit: run it more than once.
    """
    turn_steps = 128
    largest = max(options.num_agents)

    def stepper(num_agents: int, num_envs: int, **settings: Any) -> Callable[[], float]:
        env = mapf_env.BatchedEnv(num_envs, **(options.settings(num_agents) | settings))
        env.reset(seed=0)
        actions = cycle(np.random.default_rng(0).integers(0, 5, (16, num_envs, num_agents)))
        out = env.buffers()

        def turn() -> float:
            began = time.perf_counter()
            for _ in range(turn_steps):
                env.step(next(actions), out=out)
            return turn_steps * num_envs * num_agents / (time.perf_counter() - began)

        return turn

    def best(*turns: Callable[[], float]) -> list[float]:
        rates, began = [0.0] * len(turns), time.perf_counter()
        while time.perf_counter() - began < len(turns) * options.rounds * options.seconds:
            rates = [max(rate, turn()) for rate, turn in zip(rates, turns, strict=True)]
        return rates

    result = Table(title="agent-steps per second, best turns, float32, caller's buffers", box=box.SIMPLE_HEAD)
    for name in ("", "one thread", "two threads", "ratio"):
        result.add_column(name, justify="right" if name else "left", no_wrap=True)
    for num_agents in options.num_agents:
        num_envs = 4 * options.num_envs(num_agents)
        one, two = best(*(stepper(num_agents, num_envs, threads=threads) for threads in (1, 2)))
        name = f"N={num_agents}, {num_envs} environments"
        result.add_row(name, f"{one:,.0f}", f"{two:,.0f}", f"{two / one:.2f}x")
    kinds: tuple[tuple[str, Literal["views", "stores"]], ...] = (("bare loop", "views"), ("its stores alone", "stores"))
    for name, kind in kinds if program else ():
        rates = [[0.0], [0.0]]
        for _ in range(options.rounds):
            for threads in (1, 2):
                measure = bare_loop(options, "float32", program, kind, threads)  # pyright: ignore[reportArgumentType]
                rates[threads - 1].append(measure(largest).agent_steps)
        one, two = map(max, rates)
        result.add_row(f"{name}, N={largest}", f"{one:,.0f}", f"{two:,.0f}", f"{two / one:.2f}x")
    one, thousand = best(stepper(largest, options.num_envs(largest)), stepper(1000, 1, height=256, width=256))
    result.add_row(f"N=1000 on 256x256 vs N={largest}", f"{thousand:,.0f}", "", f"{thousand / one:.2f}x")
    return result


def pogema(options: Options, interface: Literal["list", "pettingzoo"], python: Path) -> Callable[[int], Rates]:
    """POGEMA in its own process."""

    def measure(num_agents: int) -> Rates:
        sizes = {"num-agents": num_agents, "size": options.size, "density": options.density}
        rest = {"radius": options.fov_radius, "seconds": options.seconds}
        arguments = [f"--interface={interface}", *(f"--{name}={value}" for name, value in (sizes | rest).items())]
        command = [str(python), str(ROOT / "benchmarks" / "pogema_peer.py"), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return Rates(**json.loads(done.stdout))

    return measure


def competitors(options: Options, console: Console, program: Path | None) -> list[Competitor]:
    """Return the competitors; only ours, with a warning, if POGEMA cannot be installed."""
    peer, view = "POGEMA, list API", "POGEMA, PettingZoo"
    floats, ints = ("bare loop, float32", "bare loop, uint8") if program else ("", "")
    ours = [
        Competitor("BatchedEnv, float32", batched(options), peer, floats),
        Competitor("float32, caller's buffers", batched(options, own_buffers=True), peer, floats),
        Competitor("BatchedEnv, uint8", batched(options, "uint8"), peer, ints),
        Competitor("uint8, caller's buffers", batched(options, "uint8", own_buffers=True), peer, ints),
        Competitor("float32 + cost-to-go", batched(options, extra_channels=("cost_to_go",)), peer),
        Competitor("float32 + PIBT shield", batched(options, shield="pibt"), peer, floats),
        Competitor("float32 + message loss 10%", batched(options, message_loss=0.1), peer, floats),
        Competitor("float32 + lifelong", batched(options, task="lifelong"), peer, floats),
        Competitor("PettingZoo, fresh observations", pettingzoo_view(options), view, floats),
        Competitor("PettingZoo, reused buffers", pettingzoo_view(options, reuse_buffers=True), view, floats),
    ]
    if program:
        for dtype, name in zip(DTYPES, (floats, ints), strict=True):
            ours.append(Competitor(name, bare_loop(options, dtype, program), peer, name))
            ours.append(Competitor(f"bare stores, {dtype}", bare_loop(options, dtype, program, "stores"), peer, name))
    if not options.pogema:
        return ours
    try:
        with console.status(f"{PEER} in an environment of its own"):
            python = peer_python("pogema-venv", [PEER], ["pogema"], python=">=3.11,<3.13")
    except (subprocess.CalledProcessError, OSError) as error:
        reason = str(getattr(error, "stderr", None) or error).strip()
        console.print(f"[bold red]POGEMA is not measured: {PEER} could not be installed.[/]\n{reason}")
        return ours
    return [
        Competitor(peer, pogema(options, "list", python), peer),
        *ours,
        Competitor(view, pogema(options, "pettingzoo", python), view),
    ]


def table(
    title: str, field: str, everyone: list[Competitor], measured: dict[tuple[str, int], list[Rates]], options: Options
) -> Table:
    """Medians and ratios of one field of the measurements."""

    def median(name: str, num_agents: int) -> float | None:
        rates = measured.get((name, num_agents))
        return statistics.median(getattr(rate, field) for rate in rates) if rates else None

    shares = field == "agent_steps"
    result = Table(title=title, box=box.SIMPLE_HEAD)
    result.add_column("", no_wrap=True)
    for num_agents in options.num_agents:
        for name in (f"N={num_agents}", "ratio", *(["bare"] if shares else [])):
            result.add_column(name, justify="right", no_wrap=True)
    for one in everyone:
        cells: list[str] = []
        for num_agents in options.num_agents:
            value, peer, bare = (median(name, num_agents) for name in (one.name, one.compared_with, one.bare))
            cells += [f"{value:,.0f}", f"{value / peer:.1f}x" if peer else ""] if value else ["", ""]
            cells += [f"{value / bare:.2f}" if value and bare else ""] if shares else []
        if shares or not one.name.startswith("bare"):
            result.add_row(one.name, *cells)
    return result


def provenance() -> str:
    """Date, commit and machine."""
    git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip() or "unknown"
    return f"{datetime.now(UTC):%Y-%m-%d}, commit {commit}, {cpu_name()}, {os.cpu_count()} cores, Python " + (
        f"{platform.python_version()}, {platform.system()}"
    )


def cpu_name() -> str:
    """The processor as the system names it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def main(options: Options) -> int:
    """Measure everyone in turns and print medians."""
    console = Console(width=max(Console().width, 130))
    program = None
    try:
        program = compiled_bare_loop()
    except (subprocess.CalledProcessError, OSError) as error:
        reason = str(getattr(error, "stderr", None) or error).strip()
        console.print(f"[bold red]The bare loop is not measured: it could not be compiled.[/]\n{reason}")
    maps = f"{options.size}x{options.size}, density {options.density}, radius {options.fov_radius}"
    console.print(provenance())
    if "peers" in options.parts:
        everyone = competitors(options, console, program)
        measured: dict[tuple[str, int], list[Rates]] = defaultdict(list)
        with Progress(console=Console(stderr=True)) as progress:
            bar = progress.add_task("rounds", total=options.rounds * len(options.num_agents) * len(everyone))
            for _ in range(options.rounds):
                for num_agents in options.num_agents:
                    for one in everyone:
                        measured[one.name, num_agents].append(one.measure(num_agents))
                        progress.advance(bar)
        batch = f"BatchedEnv: {options.robots_at_once} robots at once, graph included"
        console.print(f"{maps}; one thread; {batch}; medians of {options.rounds} rounds, per CPU second")
        console.print('"ratio": times POGEMA; "bare": share of the bare loop that writes the same bytes')
        for title, field in (("agent-steps", "agent_steps"), ("resets with a new random instance", "resets")):
            console.print(table(title, field, everyone, measured, options))
    if "threads" in options.parts:
        console.print(threads_table(options, program))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
