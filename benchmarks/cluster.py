"""Costs and gains of a Ray cluster: seconds of a case, of its way through the calling process, and the speed-up.

    python benchmarks/cluster.py

Two workers on this machine solve and play cases. The speed-up of larger clusters is predicted: a worker takes as long
as a core does here, and the calling process, which hands out all parts and reads all results, is as fast as here.
Times are CPU seconds, so that other programs disturb them little.
"""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

import experts
import gnn_policy
from experts.cluster import connect
from mapf_env import Instance, random_instance

CORES = (16, 128, 1024)


@dataclass(frozen=True)
class Options:
    """Measure what a cluster costs and predict what it gains."""

    cases: int = 2000
    """Cases of each kind; those of teams of 64 are a tenth of it."""
    hours: float = 1.0
    """Length of the work on one core for which speed-ups are predicted."""


@dataclass(frozen=True)
class Row:
    """One kind of work."""

    name: str
    case_milliseconds: float
    """CPU time of a case on one core."""
    caller_milliseconds: float
    """CPU time of the calling process for a case on a cluster."""
    bytes_out: float
    """Bytes of a case as it is sent."""

    def speed_up(self, cores: int, seconds: float, start: float) -> float:
        """The predicted speed-up of work that takes so many seconds on one core."""
        cases = 1000 * seconds / self.case_milliseconds
        return seconds / (start + max(seconds / cores, cases * self.caller_milliseconds / 1000))


def measured(name: str, instances: Sequence[Instance], work: Callable[..., Any]) -> Row:
    """Do the work here and on the cluster that this process is connected to."""
    seconds = []
    for where in ({"cluster": "local"}, {}, {"cluster": "local"}):  # the first starts the workers' libraries
        began = time.process_time()
        work(instances, **where)
        seconds.append(time.process_time() - began)
    _, here, calling = (1000 * each / len(instances) for each in seconds)
    return Row(name, here, calling, len(pickle.dumps(list(instances))) / len(instances))


def main(options: Options) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    few = max(options.cases // 10, 1)
    small = [random_instance(num_agents=10, seed=seed) for seed in range(options.cases)]
    large = [random_instance(height=40, width=40, num_agents=64, seed=seed) for seed in range(few)]
    jobs: list[tuple[str, Sequence[Instance], Callable[..., Any]]] = [
        ("solve_many, ECBS, 10 robots", small, partial(experts.solve_many, w=1.05)),
        ("solve_many, optimal (w=1), 10 robots", small, partial(experts.solve_many, w=1.0)),
        ("label_plans, 64 robots", large, experts.label_plans),
        ("rollout of n12, 10 robots", small, partial(gnn_policy.rollout, gnn_policy.load("n12"), batch_size=64)),
    ]
    began = time.perf_counter()
    with connect("local", workers=2):
        start = time.perf_counter() - began
        rows = [measured(*job) for job in track(jobs, console=Console(stderr=True))]
    columns = ("ms a case", "caller's ms a case", "bytes a case", *(f"x on {cores:,} cores" for cores in CORES))
    table = Table("work", title=f"{options.hours:g} h of work; Ray started in {start:.1f} s on {os.cpu_count()} cores")
    for column in columns:
        table.add_column(column, justify="right")
    for row in rows:
        gains = (f"{row.speed_up(cores, 3600 * options.hours, start):.0f}" for cores in CORES)
        figures = (f"{row.case_milliseconds:.3f}", f"{row.caller_milliseconds:.3f}", f"{row.bytes_out:,.0f}")
        table.add_row(row.name, *figures, *gains)
    Console(width=max(Console().width, 110)).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
