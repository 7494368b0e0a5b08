"""Agent-steps a CPU second on one thread, our environment beside POGEMA's in one run.

Same team sizes, map size, density, radius of view and kind of actions (uniform, drawn beforehand); ours delivers the
communication graph as well. The competitors take turns, so that a slower spell of the machine hits both. POGEMA lives
in a virtual environment of its own, because it pins old packages; it is made on the first run.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import time
import venv
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

ROOT = Path(__file__).parents[1]
PEER_VENV = ROOT / ".cache" / "pogema-venv"
PEER = "pogema==1.4.0"

Dtype = Literal["float32", "uint8"]
DTYPES: tuple[Dtype, ...] = ("float32", "uint8")


@dataclass(frozen=True)
class Options:
    """What to measure."""

    num_agents: tuple[int, ...] = (8, 32, 64)
    """Team sizes."""
    robots_at_once: int = 512
    """Robots in our batch: so many environments that their views stay in the cache."""
    rounds: int = 5
    """How often the competitors take turns; medians are reported."""
    seconds: float = 0.4
    """CPU seconds of each measurement."""
    size: int = 20
    """Rows and columns of the maps."""
    density: float = 0.1
    """Share of obstacles."""
    fov_radius: int = 4
    """Cells seen in each direction (POGEMA's obs_radius)."""
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
    beside: str
    """The competitor of which it is a multiple."""


def calls_per_second(call: Callable[[], object], seconds: float) -> float:
    """How often `call` runs in a CPU second."""
    call()
    calls, began = 0, time.process_time()
    while time.process_time() - began < seconds:
        call()
        calls += 1
    return calls / (time.process_time() - began)


def batched(
    options: Options, dtype: Dtype = "float32", *, own_memory: bool = False, **settings: Any
) -> Callable[[int], Rates]:
    """Our `BatchedEnv`, with fresh observations or in memory of the caller's own."""

    def measure(num_agents: int) -> Rates:
        num_envs = options.num_envs(num_agents)
        env = mapf_env.BatchedEnv(num_envs, **(options.settings(num_agents, dtype) | settings))
        env.reset(seed=0)
        actions = cycle(np.random.default_rng(0).integers(0, 5, (64, num_envs, num_agents)))
        out = env.buffers() if own_memory else None
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


def bare_loop(options: Options, dtype: Dtype, program: Path) -> Callable[[int], Rates]:
    """The bare C++ loop, which has no resets; it is written for the paper's radius of 4."""

    def measure(num_agents: int) -> Rates:
        sizes = options.num_envs(num_agents), num_agents, options.size, options.density, options.seconds
        done = subprocess.run([str(program), *map(str, sizes), dtype], capture_output=True, text=True, check=True)
        return Rates(float(done.stdout), float("nan"))

    return measure


def compiled_bare_loop() -> Path:
    """The program, compiled anew; raises CalledProcessError or OSError where there is no compiler."""
    program = PEER_VENV.parent / "bare_loop"
    program.parent.mkdir(exist_ok=True)
    source = str(ROOT / "benchmarks" / "bare_loop.cpp")
    subprocess.run(["c++", "-O3", "-std=c++20", source, "-o", str(program)], capture_output=True, text=True, check=True)
    return program


def threads_table(options: Options) -> Table:
    """Wall-clock rates: two threads beside one, and a thousand robots on a large map beside the largest team."""

    def rate(num_agents: int, num_envs: int, **settings: Any) -> float:
        env = mapf_env.BatchedEnv(num_envs, **(options.settings(num_agents) | settings))
        env.reset(seed=0)
        actions = cycle(np.random.default_rng(0).integers(0, 5, (16, num_envs, num_agents)))
        out, best = env.buffers(), 0.0
        for _ in range(options.rounds):
            calls, began = 0, time.perf_counter()
            while time.perf_counter() - began < options.seconds:
                env.step(next(actions), out=out)
                calls += 1
            best = max(best, calls * num_envs * num_agents / (time.perf_counter() - began))
        return best

    largest = max(options.num_agents)
    result = Table(title="agent-steps per second of wall-clock time, best round, float32", box=box.SIMPLE_HEAD)
    for name in ("", "agent-steps", "ratio"):
        result.add_column(name, justify="right" if name else "left", no_wrap=True)
    num_envs = 4 * options.num_envs(largest)
    one, two = (rate(largest, num_envs, threads=threads) for threads in (1, 2))
    thousand = rate(1000, 1, height=256, width=256)
    result.add_row(f"N={largest}, one thread", f"{one:,.0f}", "")
    result.add_row(f"N={largest}, two threads", f"{two:,.0f}", f"{two / one:.2f}x")
    result.add_row("N=1000 on 256x256, one thread", f"{thousand:,.0f}", f"{thousand / one:.2f}x")
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


def peer_python() -> Path:
    """The interpreter of POGEMA's virtual environment, which is made if there is none.

    Raises:
        subprocess.CalledProcessError: If POGEMA cannot be installed.
    """
    python = PEER_VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if python.exists() and subprocess.run([python, "-c", "import pogema"], capture_output=True).returncode == 0:
        return python
    uv = shutil.which("uv")
    if uv:
        commands = [
            [uv, "venv", "--clear", "--python", ">=3.11,<3.13", str(PEER_VENV)],
            [uv, "pip", "install", "--python", str(python), PEER],
        ]
    else:
        venv.create(PEER_VENV, clear=True, with_pip=True)
        commands = [[str(python), "-m", "pip", "install", PEER]]
    for command in commands:
        subprocess.run(command, capture_output=True, text=True, check=True)
    return python


def competitors(options: Options, console: Console) -> list[Competitor]:
    """Who takes part; ours only, with a warning, if POGEMA cannot be installed."""
    peer = "POGEMA, list API"
    ours = [
        Competitor("BatchedEnv, float32", batched(options), peer),
        Competitor("float32, caller's memory", batched(options, own_memory=True), peer),
        Competitor("BatchedEnv, uint8", batched(options, "uint8"), peer),
        Competitor("uint8, caller's memory", batched(options, "uint8", own_memory=True), peer),
        Competitor("float32 + cost-to-go", batched(options, extra_channels=("cost_to_go",)), peer),
        Competitor("float32 + PIBT shield", batched(options, shield="pibt"), peer),
        Competitor("float32 + message loss 10%", batched(options, message_loss=0.1), peer),
        Competitor("float32 + lifelong", batched(options, task="lifelong"), peer),
        Competitor("PettingZoo, fresh observations", pettingzoo_view(options), "POGEMA, PettingZoo"),
        Competitor("PettingZoo, reused buffers", pettingzoo_view(options, reuse_buffers=True), "POGEMA, PettingZoo"),
    ]
    try:
        program = compiled_bare_loop()
        ours += [Competitor(f"bare loop, {dtype}", bare_loop(options, dtype, program), peer) for dtype in DTYPES]
    except (subprocess.CalledProcessError, OSError) as error:
        console.print(f"[bold red]The bare loop is not measured: {error}[/]")
    if not options.pogema:
        return ours
    try:
        with console.status(f"{PEER} in {PEER_VENV.relative_to(ROOT)}"):
            python = peer_python()
    except (subprocess.CalledProcessError, OSError) as error:
        reason = str(getattr(error, "stderr", None) or error).strip()
        console.print(f"[bold red]POGEMA is not measured: {PEER} could not be installed.[/]\n{reason}")
        return ours
    return [
        Competitor("POGEMA, list API", pogema(options, "list", python), "POGEMA, list API"),
        *ours,
        Competitor("POGEMA, PettingZoo", pogema(options, "pettingzoo", python), "POGEMA, PettingZoo"),
    ]


def table(
    title: str, field: str, everyone: list[Competitor], measured: dict[tuple[str, int], list[Rates]], options: Options
) -> Table:
    """Medians and ratios of one field of the measurements."""

    def median(name: str, num_agents: int) -> float | None:
        rates = measured.get((name, num_agents))
        return statistics.median(getattr(rate, field) for rate in rates) if rates else None

    result = Table(title=title, box=box.SIMPLE_HEAD)
    result.add_column("")
    for num_agents in options.num_agents:
        result.add_column(f"N={num_agents}", justify="right", no_wrap=True)
        result.add_column("ratio", justify="right", no_wrap=True)
    for one in everyone:
        cells: list[str] = []
        for num_agents in options.num_agents:
            value, peer = median(one.name, num_agents), median(one.beside, num_agents)
            cells += [f"{value:,.0f}", f"{value / peer:.1f}x" if peer else ""] if value else ["", ""]
        if field != "resets" or not one.name.startswith("bare"):
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
    console = Console(width=max(Console().width, 110))
    everyone = competitors(options, console)
    measured: dict[tuple[str, int], list[Rates]] = defaultdict(list)
    with Progress(console=Console(stderr=True)) as progress:
        bar = progress.add_task("rounds", total=options.rounds * len(options.num_agents) * len(everyone))
        for _ in range(options.rounds):
            for num_agents in options.num_agents:
                for one in everyone:
                    measured[one.name, num_agents].append(one.measure(num_agents))
                    progress.advance(bar)
    maps = f"{options.size}x{options.size}, density {options.density}, radius {options.fov_radius}"
    batch = f"BatchedEnv: {options.robots_at_once} robots at once, graph included"
    console.print(provenance())
    console.print(f"{maps}; one thread; {batch}; medians of {options.rounds} rounds, per CPU second")
    for title, field in (("agent-steps", "agent_steps"), ("resets with a new random instance", "resets")):
        console.print(table(title, field, everyone, measured, options))
    console.print(threads_table(options))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
