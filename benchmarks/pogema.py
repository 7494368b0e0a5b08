"""POGEMA's benchmark: policies, PIBT, LaCAM and greedy robots on its instances, next to published results.

    python benchmarks/pogema.py FOLDER
    python benchmarks/pogema.py FOLDER --sets 02-mazes --sizes 32 64 --methods pibt n12-informed,argmax --cases 16
    python benchmarks/pogema.py FOLDER --lifelong --methods greedy pibt n12-informed,argmax

FOLDER has the sets of the benchmark: NAME/NAME.yaml and NAME/maps.yaml as POGEMA has them. Two more files are optional:
NAME/instances.npz, to check the instances, and published.csv, whose rows the tables show. Each finished cell (a set, a
team size, a method) is a file; give the command again after an interruption. The benchmark is a test set: do not choose
anything on it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import torch
import tyro
from rich.console import Console
from rich.progress import Progress

import pogema_methods
from experts.cluster import connect
from gnn_policy.command_line import run_command
from gnn_policy.cores import cpu_threads
from gnn_policy.metrics import Estimate
from gnn_policy.results_json import refuse_other_settings
from mapf_env import instance_hash
from mapf_env.files import write_whole
from pogema_cases import BenchmarkSet, Case, Published, load_published, load_sets
from pogema_methods import Method
from pogema_tables import Score, draw, markdown, tables

LIFELONG_STEPS = 256
"""The length of an episode in POGEMA's lifelong benchmark."""
LIFELONG_RESULTS = Path(__file__).with_name("pogema_lifelong.csv")
"""Means of published lifelong results, some team sizes of each set."""
BATCH, BATCH_OF_CLUSTER = 32, 512
"""Teams that are played at a time, between two steps of the progress bar: here, and on a cluster."""


@dataclass(frozen=True)
class Options:
    """Play methods on POGEMA's benchmark; print and draw the results."""

    folder: Annotated[Path, tyro.conf.Positional]
    """The folder of the benchmark's sets."""
    sets: tuple[str, ...] = ()
    """Names of the sets to play; all of them if not given."""
    sizes: tuple[int, ...] = ()
    """Team sizes to play; those of each set's configuration if not given."""
    lifelong: bool = False
    """Measure the throughput over 256 steps instead: a robot on its goal gets the next of those that POGEMA draws."""
    methods: tuple[str, ...] = ("pibt", "n12-informed")
    """Methods: "pibt"; "pibt_swap"; "greedy"; "lacam", its first plan within two seconds, or "lacam,SECONDS", its
    plan improved for that long; "rolling", plans of a few steps, or "rolling,ROUNDS", improved for so many rounds; a
    policy by its name, file or run folder, or with an execution of gnn_policy.evaluate, as in "n12-informed,argmax"
    (its own execution if none is given)."""
    cases: int | None = None
    """Cases to play of each set and team size, spread evenly over all; all of them if not given."""
    published: tuple[str, ...] = ()
    """Published methods to show; all of them if not given."""
    out: Path = Path("runs/pogema")
    """Folder for results, tables and figures."""
    seed: int = 0
    """Random seed for sampling, PIBT's order and LaCAM."""
    threads: int = 1
    """CPU threads of the network; 0 takes all that the process may use."""
    cluster: str | None = None
    """Address of a Ray cluster that plays one-shot teams of policies, PIBT and greedy robots: "auto" for the cluster of
    this machine, or "local" for as many processes here as there are threads. Seconds a step are then those of the whole
    cluster. Needs the extra `cluster`."""


@dataclass(frozen=True)
class Cell:
    """One method on one set and team size."""

    path: Path
    method: Method
    group: BenchmarkSet
    num_agents: int
    cases: tuple[Case, ...]
    settings: dict[str, object]

    @property
    def title(self) -> str:
        """The text of the progress bar."""
        return f"{self.group.name}, {self.num_agents} robots: {self.method.name}"


def plan(options: Options) -> list[Cell]:
    """Read the benchmark, and list what is to be played.

    Raises:
        ValueError: If an option or a file is wrong.
        OSError: If a file is missing.
        FileExistsError: If existing results have other settings.
    """
    if options.cases is not None and options.cases < 1:
        raise ValueError(f"--cases must be at least 1, got {options.cases}")
    wrong = [size for size in options.sizes if size < 1]
    if wrong:
        raise ValueError(f"--sizes must be at least 1, got {wrong[0]}")
    if options.cluster is not None and options.lifelong:
        raise ValueError("--cluster plays one-shot teams: leave it out with --lifelong")
    methods = [pogema_methods.method_named(words, options.cluster) for words in options.methods]
    names = [method.name for method in methods]
    endless = [method.name for method in methods if method.serve is None] if options.lifelong else []
    if endless:
        raise ValueError(f"{endless[0]} plans to the end of an instance, and lifelong play has none: leave it out")
    twins = [name for name in names if names.count(name) > 1]
    if twins:
        raise ValueError(f"--methods has {twins[0]!r} twice: give each method once")
    cells = []
    for group in load_sets(options.folder, options.sets):
        for size in options.sizes or group.sizes:
            cases = _spread(group.cases(size), options.cases)
            cells += [_cell(options, group, size, cases, method) for method in methods]
    return cells


def _spread(cases: Sequence[Case], count: int | None) -> tuple[Case, ...]:
    """Return `count` of the cases, evenly spaced; all if there are not more."""
    if count is None or count >= len(cases):
        return tuple(cases)
    return tuple(cases[len(cases) * place // count] for place in range(count))


def _cell(options: Options, group: BenchmarkSet, size: int, cases: tuple[Case, ...], method: Method) -> Cell:
    hashed = blake2b("".join(instance_hash(case.instance) for case in cases).encode(), digest_size=8)
    settings: dict[str, object] = {
        "set": group.name,
        "robots": size,
        "cases": len(cases),
        "instances": hashed.hexdigest(),
        "task": "lifelong" if options.lifelong else "one_shot",
        "max_steps": LIFELONG_STEPS if options.lifelong else group.max_steps,
        "method": method.name,
        "seed": options.seed,
        **method.settings,
    }
    file = "".join(letter if letter.isalnum() or letter in "-_.," else "-" for letter in method.name)
    task = "lifelong" if options.lifelong else "mapf"
    path = options.out / task / group.name / f"N{size}" / f"{file}.json"
    refuse_other_settings(path, settings, "--out")
    return Cell(path, method, group, size, cases, settings)


def play(cells: Sequence[Cell], seed: int, console: Console, size: int = BATCH) -> None:
    """Play what has no result yet, `size` teams at a time; each result is written as soon as it is there."""
    todo = [cell for cell in cells if not cell.path.exists()]
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("", total=sum(len(cell.cases) for cell in todo))
        for cell in todo:
            progress.update(task, description=cell.title)
            play_batch = _serve if cell.settings["task"] == "lifelong" else _play
            parts, seconds = [], 0.0
            for first in range(0, len(cell.cases), size):
                batch = cell.cases[first : first + size]
                began = time.perf_counter()
                parts.append(play_batch(cell, batch, seed))
                seconds += time.perf_counter() - began
                progress.advance(task, len(batch))
            columns = {name: [value for part in parts for value in part[name]] for name in parts[0]}
            cell.path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(cell.path, json.dumps({"settings": cell.settings, **columns, "seconds": seconds}) + "\n")


def _play(cell: Cell, batch: Sequence[Case], seed: int) -> dict[str, list[Any]]:
    """The columns of `Played` for some cases."""
    played = cell.method.play([case.instance for case in batch], cell.group.max_steps, seed)
    return {name: column.tolist() for name, column in asdict(played).items()}


def _serve(cell: Cell, batch: Sequence[Case], seed: int) -> dict[str, list[Any]]:
    """The arrivals and joint steps of some cases in lifelong play."""
    if cell.method.serve is None:
        raise ValueError(f"{cell.method.name} cannot play lifelong tasks")
    goals = [
        cell.group.maps[each.map_name].goal_sequences(cell.num_agents, each.seed, LIFELONG_STEPS) for each in batch
    ]
    arrivals = cell.method.serve([case.instance for case in batch], goals, LIFELONG_STEPS, seed)
    return {"arrivals": arrivals, "steps": [LIFELONG_STEPS] * len(batch)}


def score(cell: Cell) -> Score:
    """The result of a cell that has been played.

    Raises:
        ValueError: If the file is damaged.
    """
    lifelong = cell.settings["task"] == "lifelong"
    names = ("arrivals", "steps") if lifelong else ("success", "home", "flowtime", "makespan", "steps")
    try:
        stored = json.loads(cell.path.read_text(encoding="utf-8"))
        columns = {name: np.array(stored[name], np.float64) for name in names}
        seconds = float(stored["seconds"])
        if {column.shape for column in columns.values()} != {(len(cell.cases),)}:
            raise ValueError(f"not {len(cell.cases)} cases")
    except (ValueError, KeyError, TypeError) as damage:
        raise ValueError(f"{cell.path} is damaged ({type(damage).__name__}: {damage}): delete it") from None
    if lifelong:
        measures = {"throughput": Estimate.average(columns["arrivals"] / columns["steps"])}
    else:
        measures = {
            "CSR": Estimate.proportion(columns["success"] > 0),
            "ISR": _share(columns["home"]),
            "SoC": Estimate.average(columns["flowtime"]),
            "makespan": Estimate.average(columns["makespan"]),
        }
    step_seconds = seconds / max(columns["steps"].sum(), 1.0)
    return Score(cell.group.name, cell.num_agents, cell.method.name, len(cell.cases), measures, step_seconds)


def _share(values: npt.NDArray[np.float64]) -> Estimate:
    """The mean of shares, whose interval ends at 0 and 1."""
    estimate = Estimate.average(values)
    return Estimate(estimate.mean, max(estimate.low, 0.0), min(estimate.high, 1.0))


def show(scores: Sequence[Score], published: Sequence[Published], out: Path, console: Console) -> None:
    """Print the tables, and write them and the figures."""
    page = []
    for name in dict.fromkeys(score.set_name for score in scores):
        of_set = [score for score in scores if score.set_name == name]
        for table in tables(name, of_set, published):
            console.print(table)
            page.append(markdown(table))
        draw(out / f"{name}.png", name, of_set, published)
        console.print(f"figure: {out / f'{name}.png'}", highlight=False, soft_wrap=True)
    write_whole(out / "results.md", "\n".join(page))
    console.print(f"tables: {out / 'results.md'}", highlight=False, soft_wrap=True)


def main(options: Options) -> None:
    """Run the command."""
    torch.set_num_threads(cpu_threads(options.threads))
    console = Console(markup=False)  # names come from files
    published = [*load_published(options.folder / "published.csv"), *load_published(LIFELONG_RESULTS)]
    unknown = set(options.published) - {row.method for row in published}
    if unknown:
        known = ", ".join(sorted({row.method for row in published}))
        raise ValueError(f"--published: nobody has published a method {min(unknown)!r}: choose among {known}")
    cells = plan(options)
    with nullcontext() if options.cluster is None else connect(options.cluster, workers=torch.get_num_threads()):
        play(cells, options.seed, console, BATCH if options.cluster is None else BATCH_OF_CLUSTER)
    shown = [row for row in published if not options.published or row.method in options.published]
    show([score(cell) for cell in cells], shown, options.out / ("lifelong" if options.lifelong else "mapf"), console)


if __name__ == "__main__":
    run_command(lambda arguments: tyro.cli(Options, args=arguments, description=__doc__), main)
