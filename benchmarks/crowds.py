"""Solvers in crowds: `python benchmarks/crowds.py COMMAND`.

`table`: first plans, improved plans and bounded plans of dense cases; `solve` solves a case only if it proves its plan.
`limits`: plans that it returns without a proof, too. `labels`: states labelled per second. `plot`: success and cost
against time. One thread, except for `labels`.
POGEMA's maps are read from `FOLDER/NAME/maps.yaml`; without the folder its rows are left out. For lifelong play, see
`pogema.py --lifelong --methods rolling`.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import experts
from experts import Result, Solver
from mapf_env import Instance, Maze, Rooms, Warehouse, load_pogema_maps, random_instance
from solvers import commit, timed

Cases = dict[str, list[Instance]]


def main() -> None:
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--pogema", type=Path, metavar="FOLDER", help="folder of POGEMA's sets, such as 02-mazes")
    shared.add_argument("--cases", type=int, help="cases of each row (default: 32 of POGEMA's, 16 of our own)")
    shared.add_argument("--time-limit", type=float, default=2.0, help="seconds for each case (default: 2)")
    shared.add_argument("--rows", nargs="+", help="rows whose names begin with one of these words (default: all)")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for run in (table, limits, labels, plot):
        summary = (run.__doc__ or "").splitlines()[0]
        command = commands.add_parser(run.__name__, help=summary, description=summary, parents=[shared])
        command.set_defaults(run=run)
        if run is labels:
            command.add_argument("--threads", type=int, default=2, help="default: 2")
        if run is plot:
            command.add_argument("--out", type=Path, default=Path("docs/crowds.png"), help="default: docs/crowds.png")
    options = parser.parse_args()
    console = Console(width=140)
    console.print(f"commit {commit()}")
    options.run(options, console)


def table(options: argparse.Namespace, console: Console) -> None:
    """First plans, improved plans and plans within a bound of dense cases."""
    limit = options.time_limit
    solvers: dict[str, Solver] = {
        "lacam, first": partial(experts.lacam, time_limit=limit),
        f"lacam, w=1, {limit:g} s": partial(experts.lacam, w=1, time_limit=limit),
        "solve, w=1.5": partial(experts.solve, w=1.5, time_limit=limit),
        "solve, w=2": partial(experts.solve, w=2, time_limit=limit),
        "pibt, swap": partial(experts.pibt, swap=True),
    }
    columns = ("case", "solver", "solved", "median ms", "max ms", "cost", "cost / bound")
    printed = Table(*columns, title=f"crowds, {limit:g} s")
    for name, instances in chosen(options, dense_cases(options.pogema, options.cases)).items():
        for solver_name, solver in solvers.items():
            printed.add_row(name, solver_name, *summary(*timed(solver, instances)))
    console.print(printed)


def limits(options: argparse.Namespace, console: Console) -> None:
    """Plans that `solve` proves within the time limit, and those that it returns without a proof."""
    printed = Table(
        "case", "w", "proved", "with a plan", "median cost / bound", title=f"limits, {options.time_limit:g} s"
    )
    for name, instances in chosen(options, dense_cases(options.pogema, options.cases)).items():
        for w in (1.5, 2):
            results, _ = timed(partial(experts.solve, w=w, time_limit=options.time_limit), instances)
            ratios = [result.cost / lower_bound(result) for result in results if result.cost is not None]
            shares = (sum(result.solved for result in results) / len(results), len(ratios) / len(results))
            median = f"{np.median(ratios):.3f}" if ratios else ""
            printed.add_row(name, f"{w:g}", *(f"{share:.3f}" for share in shares), median)
    console.print(printed)


def labels(options: argparse.Namespace, console: Console) -> None:
    """Robot states that `label_plans` labels in a second, and what the plans cost."""
    printed = Table("case", "rounds", "solved", "team states / s", "robot states / s", "cost", "/ lacam, 100 ms")
    for name, instances in chosen(options, dense_cases(options.pogema, options.cases)).items():
        results, _ = timed(partial(experts.lacam, w=1, time_limit=0.1), instances)
        reference = np.mean([result.cost for result in results if result.cost is not None])
        for rounds in (100, 300, 500, 1_000):
            begin = time.perf_counter()
            found = experts.label_plans(instances, rounds=rounds, threads=options.threads)
            seconds = time.perf_counter() - begin
            cost = found.costs[found.solved].mean()
            rates = (f"{len(found.source) / seconds:,.0f}", f"{len(found.actions) / seconds:,.0f}")
            solved = f"{found.solved.mean():.3f}"
            printed.add_row(name, str(rounds), solved, *rates, f"{cost:.1f}", f"{cost / reference:.3f}")
    console.print(printed)


def plot(options: argparse.Namespace, console: Console) -> None:
    """Draw success and cost against time for each kind of map and 16 to 1,000 robots."""
    import matplotlib.pyplot as plt

    cases = options.cases or 4
    families: dict[str, tuple[tuple[int, ...], Callable[[int, int], Instance]]] = {
        "random, 64x64, 20 %": ((16, 64, 256, 1000), on_random_maps),
        "maze, 41x41": ((16, 64, 128, 256), on_mazes),
        "rooms, 64x64": ((16, 64, 256, 1000), on_rooms),
        "warehouse, 60x100": ((16, 64, 256, 1000), on_warehouses),
    }
    if options.pogema is not None:
        cities = list(load_pogema_maps(options.pogema / "04-movingai" / "maps.yaml").values())
        families["city, 64x64"] = ((16, 64, 256, 1000), lambda n, seed: cities[seed].instance(n, seed))
    solvers: dict[str, Solver] = {
        "pibt, swap": partial(experts.pibt, swap=True),
        "prioritised": partial(experts.prioritised, time_limit=options.time_limit),
        "lacam": partial(experts.lacam, time_limit=options.time_limit),
        f"lacam, w=1, {options.time_limit:g} s": partial(experts.lacam, w=1, time_limit=options.time_limit),
        "solve, w=1.2": partial(experts.solve, w=1.2, time_limit=options.time_limit),
        "solve, w=2": partial(experts.solve, w=2, time_limit=options.time_limit),
    }
    figure, axes = plt.subplots(len(families), 4, figsize=(13, 2.7 * len(families)), sharex=True, squeeze=False)
    printed = Table("maps", "robots", "solver", "solved", "median ms", "max ms", "cost", "cost / bound")
    for row, (family, (sizes, make)) in enumerate(families.items()):
        for col, num_agents in enumerate(sizes):
            axis = axes[row][col]
            instances = [make(num_agents, seed) for seed in range(cases)]
            unsolved = []
            for marker, (name, solver) in zip("sv^o*P", solvers.items(), strict=True):
                results, milliseconds = timed(solver, instances)
                printed.add_row(family, str(num_agents), name, *summary(results, milliseconds))
                solved = [result for result in results if result.solved]
                share = len(solved) / len(results)
                ratio = sum(result.cost or 0 for result in solved) / max(sum(map(lower_bound, solved)), 1)
                x, y = ([np.median(milliseconds)], [ratio]) if solved else ([], [])
                axis.plot(x, y, marker, label=name, alpha=max(share, 0.2))
                if share < 1:
                    unsolved.append(f"{name}: {share:.0%}")
            axis.set(xscale="log", ylabel="cost / bound" if col == 0 else "")
            axis.set_title(f"{family}, {num_agents} robots", fontsize=8)
            axis.text(0.98, 0.97, "\n".join(unsolved), transform=axis.transAxes, ha="right", va="top", fontsize=6)
    for axis in axes[-1]:
        axis.set_xlabel("median ms")
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="upper center", ncols=len(solvers), fontsize=8)
    figure.savefig(options.out, dpi=110)
    console.print(printed)
    console.print(f"wrote {options.out}")


def lower_bound(result: Result) -> int:
    """The bound that costs are compared with, at least 1."""
    return max(result.lower_bound, 1)


def on_random_maps(num_agents: int, seed: int) -> Instance:
    return random_instance(height=64, width=64, density=0.2, num_agents=num_agents, seed=seed)


def on_mazes(num_agents: int, seed: int) -> Instance:
    return random_instance(height=41, width=41, style=Maze(loops=0.3), num_agents=num_agents, seed=seed)


def on_rooms(num_agents: int, seed: int) -> Instance:
    return random_instance(height=64, width=64, style=Rooms(), num_agents=num_agents, seed=seed)


def on_warehouses(num_agents: int, seed: int) -> Instance:
    return random_instance(height=60, width=100, style=Warehouse(), num_agents=num_agents, seed=seed)


def dense_cases(pogema: Path | None, cases: int | None) -> Cases:
    """The dense cases: the first of POGEMA's, and our own with seeds from 0."""
    found: Cases = {}
    if pogema is not None:
        for name, num_agents in (("02-mazes", 32), ("02-mazes", 64), ("01-random", 64)):
            found[f"{name} {num_agents}"] = pogema_cases(pogema, name, num_agents, cases or 32)
    seeds = range(cases or 16)
    for name, style, num_agents in (
        ("Maze() 32", Maze(), 32),
        ("Maze() 64", Maze(), 64),
        ("Maze(loops=.3) 64", Maze(loops=0.3), 64),
    ):
        found[name] = [
            random_instance(height=21, width=21, style=style, num_agents=num_agents, seed=seed) for seed in seeds
        ]
    found["cells 64"] = [random_instance(density=0.3, num_agents=64, seed=seed) for seed in seeds]
    return found


def pogema_cases(folder: Path, name: str, num_agents: int, cases: int) -> list[Instance]:
    """The first instances of a set; a set of one map has a seed for each instance, the others a map."""
    maps = list(load_pogema_maps(folder / name / "maps.yaml").values())
    if len(maps) == 1:
        return [maps[0].instance(num_agents, seed) for seed in range(cases)]
    return [each.instance(num_agents, 0) for each in islice(maps, cases)]


def chosen(options: argparse.Namespace, cases: Cases) -> Cases:
    """Return the chosen rows."""
    words = options.rows
    return {name: each for name, each in cases.items() if words is None or any(name.startswith(w) for w in words)}


def summary(results: list[Result], milliseconds: list[float]) -> tuple[str, ...]:
    """Share solved, median and greatest time, mean cost and cost over bound of the solved cases."""
    costs = [result.cost for result in results if result.solved and result.cost is not None]
    bounds = [lower_bound(result) for result in results if result.solved]
    times = (f"{np.median(milliseconds):.2f}", f"{max(milliseconds):.1f}")
    share = f"{len(costs) / len(results):.3f}"
    if not costs:
        return (share, *times, "", "")
    return (share, *times, f"{np.mean(costs):.1f}", f"{sum(costs) / math.fsum(bounds):.3f}")


if __name__ == "__main__":
    main()
