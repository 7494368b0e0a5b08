"""Time and memory of a step from a hundred robots to a million, and the bars that they are held against.

    python benchmarks/scale.py              measure what is missing in docs/scale.csv and draw docs/scale.png
    python benchmarks/scale.py --million    and a million robots under the policy, 100 steps: most of an hour

Each measurement runs in a process of its own, whose greatest memory is recorded, and is written as soon as it is there:
a run that was stopped goes on where it was. CPU seconds are disturbed little by other programs, seconds by the clock
need a machine at rest.
"""

from __future__ import annotations

import csv
import math
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from mapf_env import BatchedEnv, Instance, random_instance
from mapf_env.files import replacing, write_whole

DOCS = Path(__file__).parents[1] / "docs"

Kind = Literal["environment", "pibt", "policy", "policy with the map"]
KINDS: tuple[Kind, ...] = ("environment", "pibt", "policy", "policy with the map")
POLICIES = {"policy": "n12", "policy with the map": "n12-informed"}
MARKERS = dict(zip(KINDS, "osD^", strict=True))


@dataclass(frozen=True)
class Options:
    """The settings of the measurements."""

    robots: tuple[int, ...] = (100, 1_000, 10_000, 100_000, 1_000_000)
    """Team sizes."""
    million: bool = False
    """Measure a million robots under the policy, too: `million_steps` steps."""
    million_steps: int = 100
    """Steps of that measurement."""
    threads: int = 2
    """CPU threads of the network; steps of the environment take one."""
    kinds: tuple[Kind, ...] = KINDS
    """Steps to measure: the environment's with what robots perceive, under the paper's shield; the PIBT shield's alone;
    and those of a policy, which perceives, computes, and steps."""
    steps: int = 10
    """Steps of each measurement; small teams take as many as 10,000 robots do in that many."""
    most_with_map: int = 10_000
    """The largest team that knows the map: it searches for the way of each robot."""
    most_with_policy: int = 100_000
    """The largest team under the policy, except for the million."""
    seed: int = 0
    """Seed of maps, teams and actions."""
    table: Path = DOCS / "scale.csv"
    """The file of the measurements; those that are there are not repeated."""
    figure: Path = DOCS / "scale.png"
    """The plot."""


@dataclass(frozen=True)
class Row:
    """One measurement."""

    kind: str
    robots: int
    height: int
    width: int
    steps: int
    reset_seconds: float
    """CPU seconds from the instance to the first step."""
    step_microseconds: float
    """CPU time of a step a robot, the median over the steps."""
    step_seconds: float
    """Seconds of a step by the clock, the median over the steps."""
    bytes_per_robot: float
    """The process's greatest memory beyond what it had before the instance was drawn, a robot."""
    peak_mib: float
    """The process's greatest memory."""
    first_mib: float
    """Memory of the process after its second step."""
    last_mib: float
    """Memory of the process after its last step."""


def side_of(kind: Kind, robots: int) -> int:
    """Rows and columns of the map: ten cells a robot, for a million 4096 x 4096; a warehouse of 26 if it is known."""
    if kind == "policy with the map":
        return max(round(512 * math.sqrt(robots / 10_000)), 24)
    return 4096 if robots == 1_000_000 else round(1024 * math.sqrt(robots / 100_000))


def instance_of(kind: Kind, robots: int, seed: int) -> Instance:
    """A random team on a map with obstacles on a tenth of the cells, or on that of a warehouse."""
    side = side_of(kind, robots)
    if kind == "policy with the map":
        return random_instance(height=side, width=side, style="warehouse", num_agents=robots, seed=seed)
    return random_instance(height=side, width=side, density=0.1, num_agents=robots, seed=seed)


def environment(instance: Instance, **settings: Any) -> BatchedEnv:
    """An environment of one team in which an episode of the instance has begun."""
    height, width = instance.grid.shape
    sizes = {"num_agents": instance.num_agents, "height": height, "width": width, "density": 0.0, "style": "empty"}
    env = BatchedEnv(1, max_cycles=10**9, **sizes, **settings)
    env.reset(0, instances=[instance], observe=False)
    return env


def prepared(kind: Kind, instance: Instance, seed: int, threads: int) -> Callable[[], object]:
    """Reset, and return what makes a step."""
    generator = np.random.default_rng(seed)
    if kind in ("environment", "pibt"):
        env = environment(instance, shield="idle" if kind == "environment" else "pibt", dtype="uint8")
        actions = [generator.integers(0, 5, (1, instance.num_agents), np.int64) for _ in range(4)]

        def step() -> None:
            env.step(actions[env.times[0] % 4], observe=False)
            if kind == "environment":
                env.bag()

        return step
    import torch

    import gnn_policy
    from gnn_policy.rollout import PolicyActor

    torch.set_num_threads(threads)
    policy = gnn_policy.load(POLICIES[kind]).eval()
    actor = PolicyActor(policy, policy.execution)
    acting = environment(instance, **actor.env_settings())
    return lambda: acting.step(actor.act(acting), observe=False)


def resident() -> float:
    """MiB of memory that the process holds now."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def peak() -> float:
    """The greatest memory that the process held so far, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform == "linux" else 2**20)


def measure(kind: Kind, robots: int, steps: int, seed: int, threads: int) -> Row:
    """One measurement, in the process that calls this, with a progress bar over its steps."""
    if kind in POLICIES:
        prepared(kind, instance_of(kind, 100, seed), seed, threads)()  # libraries are loaded before memory is counted
    before = resident()
    instance = instance_of(kind, robots, seed)
    began = time.process_time()
    step = prepared(kind, instance, seed, threads)
    ready = time.process_time() - began
    seconds, by_clock, first = list[float](), list[float](), 0.0
    count = max(steps, steps * 10_000 // robots // 4)
    for number in track(range(count), f"{kind}, {robots:,} robots", transient=True):
        began, began_by_clock = time.process_time(), time.perf_counter()
        step()
        seconds.append(time.process_time() - began)
        by_clock.append(time.perf_counter() - began_by_clock)
        first = resident() if number == 1 else first
    height, width = instance.grid.shape
    return Row(
        kind=kind,
        robots=robots,
        height=height,
        width=width,
        steps=len(seconds),
        reset_seconds=round(ready, 3),
        step_microseconds=round(float(np.median(seconds)) / robots * 1e6, 3),
        step_seconds=round(float(np.median(by_clock)), 6),
        bytes_per_robot=round(max(peak() - before, 0.0) * 2**20 / robots, 1),
        peak_mib=round(peak(), 1),
        first_mib=round(first, 1),
        last_mib=round(resident(), 1),
    )


def read(path: Path) -> list[Row]:
    """The measurements that a table holds.

    Raises:
        ValueError: If the table is not one of this benchmark.
    """
    if not path.exists():
        return []
    types = {each.name: {"str": str, "int": int, "float": float}[str(each.type)] for each in fields(Row)}
    with path.open(encoding="utf-8", newline="") as file:
        lines = csv.DictReader(file)
        if lines.fieldnames != list(types):
            raise ValueError(f"{path} must have the columns {', '.join(types)}: give another --table")
        return [Row(**{name: types[name](value) for name, value in line.items()}) for line in lines]


def write(path: Path, rows: list[Row]) -> None:
    """Write the table, whole or not at all."""
    place: dict[str, int] = {kind: number for number, kind in enumerate(KINDS)}
    ordered = sorted(rows, key=lambda row: (place[row.kind], row.robots))
    lines = [
        ",".join(each.name for each in fields(Row)),
        *(",".join(map(str, asdict(row).values())) for row in ordered),
    ]
    write_whole(path, "\n".join(lines) + "\n")


def draw(rows: list[Row], path: Path) -> None:
    """Time and memory over the size of the team, on logarithmic axes."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for kind in KINDS:
        chosen = sorted((row for row in rows if row.kind == kind), key=lambda row: row.robots)
        robots = [row.robots for row in chosen]
        seconds = [row.step_microseconds * row.robots / 1e6 for row in chosen]
        axes[0].plot(robots, seconds, marker=MARKERS[kind], label=kind)
        axes[1].plot(robots, [row.peak_mib * 2**20 for row in chosen], marker=MARKERS[kind], label=kind)
    for axis, title in zip(axes, ("CPU seconds of a step", "Memory of the process in bytes"), strict=True):
        axis.set(xscale="log", yscale="log", xlabel="robots", title=title)
        axis.grid(alpha=0.3)
        axis.legend()
    with replacing(path) as draft:
        figure.savefig(draft, dpi=110, format="png")
    plt.close(figure)


def bars(rows: list[Row]) -> Table:
    """Return a table of what was asked for, next to what was measured."""
    found = {(row.kind, row.robots): row for row in rows}
    table = Table("bar", "measured", "met", title="Bars")

    def add(bar: str, needed: Sequence[tuple[Kind, int]], judge: Callable[..., tuple[str, bool]]) -> None:
        missing = [f"{kind}, {robots:,} robots" for kind, robots in needed if (kind, robots) not in found]
        shown, met = (
            ("not measured: " + "; ".join(missing), False) if missing else judge(*(found[key] for key in needed))
        )
        table.add_row(bar, shown, "" if missing else "yes" if met else "no")

    def ratio(few: Row, many: Row) -> tuple[str, bool]:
        times = many.step_microseconds / few.step_microseconds
        return f"{times:.2f} times ({many.step_microseconds:.2f} and {few.step_microseconds:.2f} µs)", times <= 1.5

    def below(seconds: float) -> Callable[[Row], tuple[str, bool]]:
        return lambda row: (f"{1000 * row.step_seconds:.1f} ms", row.step_seconds < seconds)

    def million(row: Row) -> tuple[str, bool]:
        shown = f"{row.peak_mib / 1024:.1f} GiB at most, {row.steps} steps of {row.step_seconds:.1f} s"
        growth = f"; memory after the second step {row.first_mib:,.0f} MiB, after the last {row.last_mib:,.0f} MiB"
        return shown + growth, row.steps >= 100 and row.peak_mib * 2**20 < 12e9

    add(
        "environment: CPU time a robot and step of 100,000 at most 1.5 times that of 1,000",
        [("environment", 1_000), ("environment", 100_000)],
        ratio,
    )
    add("policy: 1,000 robots in less than 20 ms a step", [("policy", 1_000)], below(0.02))
    add("policy with the map: 1,000 robots in less than 20 ms a step", [("policy with the map", 1_000)], below(0.02))
    add("policy with the map: 10,000 robots on 512 x 512 in less than 1 s", [("policy with the map", 10_000)], below(1))
    add("policy: a million robots on 4096 x 4096, 100 steps in less than 12 GB", [("policy", 1_000_000)], million)
    return table


def main(options: Options) -> None:
    """Measure what is missing, and show and draw all there is."""
    rows = read(options.table)
    known = {(row.kind, row.robots) for row in rows}
    most = {"policy": options.most_with_policy, "policy with the map": options.most_with_map}
    wanted: list[tuple[Kind, int, int]] = [
        (kind, robots, options.steps)
        for robots in options.robots
        for kind in options.kinds
        if robots <= most.get(kind, robots)
    ]
    if options.million:
        wanted.append(("policy", 1_000_000, options.million_steps))
    wanted = [each for each in wanted if each[:2] not in known]
    spawn = multiprocessing.get_context("spawn")
    for number, (kind, robots, steps) in enumerate(wanted, start=1):
        Console().print(f"measurement {number} of {len(wanted)}: {kind}, {robots:,} robots")
        with ProcessPoolExecutor(1, spawn) as worker:
            rows.append(worker.submit(measure, kind, robots, steps, options.seed, options.threads).result())
        write(options.table, rows)
    draw(rows, options.figure)
    table = Table("kind", "robots", "map", "steps", "reset s", "CPU µs a robot", "s a step", "bytes a robot", "MiB")
    for row in read(options.table):
        shape = f"{row.height} x {row.width}"
        times = (f"{row.reset_seconds:.2f}", f"{row.step_microseconds:.2f}", f"{row.step_seconds:.4f}")
        memory = (f"{row.bytes_per_robot:,.0f}", f"{row.peak_mib:,.0f}")
        table.add_row(row.kind, f"{row.robots:,}", shape, str(row.steps), *times, *memory)
    wide = Console(width=max(Console().width, 110))
    wide.print(table)
    wide.print(bars(rows))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
