"""Time and quality of the solvers: `python benchmarks/solvers.py COMMAND`.

Every case is a fresh instance, the calls take the instances in turn, and Python's share is included. One thread,
except for `threads`.
"""

from __future__ import annotations

import argparse
import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import experts
import solver_peers
from experts import Result, Solver
from mapf_env import Instance, load_scen, random_instance

TEAMS = (4, 10, 14, 20, 30, 40)
FACTORS = (1.0, 1.05, 1.2)
SCENARIOS = {
    "random-32-32-20-even-10": 100,
    "room-64-64-8-even-1": 50,
    "maze-32-32-4-even-10": 30,
    "den312d-even-10": 100,
    "warehouse-10-20-10-2-1-even-10": 100,
}


def main() -> None:
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--cases", type=int, help="instances for each row (default: 200; movingai 25, many 5)")
    shared.add_argument("--time-limit", type=float, default=10.0, help="seconds for each instance (default: 10)")
    shared.add_argument("--style", choices=("cells", "walls"), default="cells", help="style of the random maps")
    shared.add_argument("--seed", type=int, default=1_000_000, help="seed of the first random instance")
    shared.add_argument("--agents", type=int, nargs="+", default=TEAMS, help="numbers of robots on random maps")
    shared.add_argument("--w", type=float, nargs="+", default=FACTORS, help="suboptimality factors")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, run in (
        ("seeds", seeds),
        ("movingai", movingai),
        ("relabel", relabelling),
        ("threads", scaling),
        ("many", many_robots),
        ("peers", peers),
    ):
        summary = (run.__doc__ or "").splitlines()[0]
        command = commands.add_parser(name, help=summary.replace("%", "%%"), description=summary, parents=[shared])
        command.set_defaults(run=run)
        if name == "movingai":
            command.add_argument("--data", type=Path, help="the folder of the .scen and .map files")
    options = parser.parse_args()
    console = Console(width=120)
    console.print(f"commit {commit()}")
    options.run(options, console)


def seeds(options: argparse.Namespace, console: Console) -> None:
    """Random 20x20 maps with 10% obstacles."""
    table = quality_table("random maps, ms")
    for num_agents in options.agents:
        instances = teams(options, num_agents, 200)
        for w in options.w:
            solver = partial(experts.solve, w=w, time_limit=options.time_limit)
            table.add_row(str(num_agents), f"w={w:g}", *quality(*timed(solver, instances)))
        for name, solver in (("pibt", experts.pibt), ("prioritised", experts.prioritised), ("lacam", experts.lacam)):
            table.add_row(str(num_agents), name, *quality(*timed(solver, instances)))
    console.print(table)


def movingai(options: argparse.Namespace, console: Console) -> None:
    """Scenarios of MovingAI: the first robots of each, then random choices of its entries."""
    if options.data is None:
        console.print("movingai is skipped: give --data DIR, a folder with the benchmark's .scen and .map files")
        return
    for w in options.w:
        table = quality_table(f"MovingAI, w = {w:g}, ms")
        for name, num_agents in SCENARIOS.items():
            file = options.data / f"{name}.scen"
            if not file.is_file():
                console.print(f"{name} is skipped: there is no {file}")
                continue
            instances = scenario_cases(load_scen(file), num_agents, options.cases or 25)
            solver = partial(experts.solve, w=w, time_limit=options.time_limit)
            table.add_row(str(num_agents), name, *quality(*timed(solver, instances)))
        console.print(table)


def relabelling(options: argparse.Namespace, console: Console, num_states: int = 128) -> None:
    """States of teams that follow the expert and slip, at most 50 instances of up to 20 robots."""
    table = Table("N", "states of", "median", "mean", "p95", "solved", title="relabel, us a state")
    rng = np.random.default_rng(0)
    for num_agents in (each for each in options.agents if each <= 20):
        instances = teams(options, num_agents, 50)[:50]
        states = [visited_states(instance, num_states, rng) for instance in instances]
        one_each = (instances, np.stack([each[rng.integers(num_states)] for each in states]))
        shared, solved = [], []
        for instance, positions in zip(instances, states, strict=True):
            begin = time.perf_counter()
            _, done = experts.relabel(instance, positions)
            shared.append((time.perf_counter() - begin) * 1e6 / num_states)
            solved.append(done.mean())
        table.add_row(str(num_agents), "one instance", *spread(shared), f"{np.mean(solved):.4f}")
        begin = time.perf_counter()
        _, done = experts.relabel(*one_each)
        mean = (time.perf_counter() - begin) * 1e6 / len(instances)
        table.add_row(str(num_agents), "an instance each", "", f"{mean:.3f}", "", f"{done.mean():.4f}")
    console.print(table)


def scaling(options: argparse.Namespace, console: Console) -> None:
    """Throughput on one thread and on two: instances solved and states labelled in a second."""
    table = Table("work", "1 thread", "2 threads", "ratio", title="per second")
    instances = teams(options, 30, 1_000)
    few = instances[:20]
    states = [visited_states(instance, 256, np.random.default_rng(0)) for instance in teams(options, 10, 20)[:20]]
    batch = np.concatenate(states)
    owners = [instance for instance in teams(options, 10, 20)[:20] for _ in range(256)]
    jobs: list[tuple[str, int, Callable[[int], object]]] = [
        ("solve_many, N=30, w=1.05", len(instances), lambda n: experts.solve_many(instances, threads=n)),
        ("solve_stream, N=30, w=1.05", len(instances), lambda n: list(experts.solve_stream(instances, threads=n))),
        ("lacam in a pool, N=30", len(instances), lambda n: experts.solve_many(instances, solver="lacam", threads=n)),
        ("relabel, N=10", len(batch), lambda n: experts.relabel(owners, batch, threads=n)),
    ]
    experts.solve_many(few)
    for name, size, job in jobs:
        rates = []
        for threads in (1, 2):
            begin = time.perf_counter()
            job(threads)
            rates.append(size / (time.perf_counter() - begin))
        table.add_row(name, f"{rates[0]:,.0f}", f"{rates[1]:,.0f}", f"{rates[1] / rates[0]:.2f}")
    console.print(table)


def many_robots(options: argparse.Namespace, console: Console) -> None:
    """Hundreds to thousands of robots: LaCAM, PIBT and prioritised planning."""
    solvers: dict[str, Solver] = {
        "lacam": experts.lacam,
        "lacam, w=1.1, 2 s": partial(experts.lacam, w=1.1, time_limit=2.0),
        "pibt": experts.pibt,
        "prioritised": partial(experts.prioritised, time_limit=options.time_limit),
    }
    table = quality_table("many robots, ms")
    for side, num_agents in ((32, 100), (64, 400), (64, 1000), (256, 1000)):
        instances = [
            random_instance(height=side, width=side, num_agents=num_agents, seed=options.seed + case)
            for case in range(options.cases or 5)
        ]
        for name, solver in solvers.items():
            table.add_row(f"{num_agents}, {side}x{side}", name, *quality(*timed(solver, instances)))
    console.print(table)


def peers(options: argparse.Namespace, console: Console) -> None:
    """The packages w9-pathfinding and pymapf from PyPI and ours, on the same instances."""
    table = Table("N", "solver", "median", "mean", "p95", "solved", "cost / ours, w=1", title="peers, ms")
    try:
        python = solver_peers.python()
    except (subprocess.CalledProcessError, OSError) as error:
        console.print(f"no peers: they could not be installed ({getattr(error, 'stderr', None) or error})")
        python = None
    for num_agents in (each for each in options.agents if each <= 20):
        instances = teams(options, num_agents, 30)[:30]
        optimal, times = timed(partial(experts.solve, w=1.0, time_limit=options.time_limit), instances)
        rows = [("ours, w=1", times, [result.cost for result in optimal])]
        for name, solver in (("ours, w=1.2", partial(experts.solve, w=1.2)), ("ours, lacam", experts.lacam)):
            results, times = timed(solver, instances)
            rows.append((name, times, [result.cost for result in results]))
        if python is not None:
            rows += solver_peers.measure(python, instances, time_limit=1.0)
        for name, times, costs in rows:
            both = [(cost, best.cost) for cost, best in zip(costs, optimal, strict=True) if cost and best.cost]
            ratio = sum(cost for cost, _ in both) / sum(best for _, best in both) if both else float("nan")
            solved = sum(cost is not None for cost in costs) / len(costs)
            table.add_row(str(num_agents), name, *spread(times), f"{solved:.3f}", f"{ratio:.4f}")
    console.print(table)


def teams(options: argparse.Namespace, num_agents: int, cases: int) -> list[Instance]:
    return [
        random_instance(num_agents=num_agents, style=options.style, seed=options.seed + case)
        for case in range(options.cases or cases)
    ]


def scenario_cases(scenario: Instance, num_agents: int, cases: int) -> list[Instance]:
    """The first robots of the scenario, then random choices of its entries."""
    chosen = [np.arange(num_agents)]
    for case in range(1, cases):
        chosen.append(np.random.default_rng(case).choice(scenario.num_agents, num_agents, replace=False))
    return [Instance(scenario.grid, scenario.starts[each], scenario.goals[each]) for each in chosen]


def timed(solver: Solver, instances: list[Instance]) -> tuple[list[Result], list[float]]:
    results, milliseconds = [], []
    for instance in instances:
        begin = time.perf_counter()
        results.append(solver(instance))
        milliseconds.append((time.perf_counter() - begin) * 1e3)
    return results, milliseconds


def quality_table(title: str) -> Table:
    columns = ("N", "case", "median", "mean", "p95", "solved", "cost / bound", "makespan", "expansions")
    return Table(*columns, title=title)


def quality(results: list[Result], milliseconds: list[float]) -> tuple[str, ...]:
    solved = [result for result in results if result.solved]
    share = f"{len(solved) / len(results):.3f}"
    if not solved:
        return (*spread(milliseconds), share, "", "", "")
    ratio = sum(result.cost or 0 for result in solved) / sum(result.lower_bound for result in solved)
    makespan = np.mean([result.solution.makespan for result in solved if result.solution is not None])
    expansions = np.mean([result.expansions for result in results])
    return (*spread(milliseconds), share, f"{ratio:.4f}", f"{makespan:.2f}", f"{expansions:.2f}")


def commit() -> str:
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    return subprocess.run(git, capture_output=True, text=True).stdout.strip() or "unknown"


def visited_states(instance: Instance, num_states: int, rng: np.random.Generator) -> np.ndarray:
    """Joint states (B, N, 2) of a team that follows the expert but idles at random."""
    states = [instance.starts]
    while len(states) < num_states:
        result = experts.solve(instance.at(states[-1]), w=1.2)
        if result.solution is None or not result.solved or len(result.solution.paths) == 1:
            states.append(instance.starts)
            continue
        for joint in result.solution.paths[1 : 1 + rng.integers(1, 4)]:
            states.append(stumble(states[-1], joint, rng))
    return np.stack(states[:num_states])


def stumble(before: np.ndarray, after: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each robot's step, or its last cell if it slips or would run into another."""
    cells = np.where(rng.random(len(before))[:, None] < 0.1, before, after)
    while True:
        crowded = np.array([(cells == cell).all(axis=1).sum() > 1 for cell in cells])
        swapping = (cells[:, None] == before[None]).all(axis=2) & (cells[None] == before[:, None]).all(axis=2)
        np.fill_diagonal(swapping, False)
        if not crowded.any() and not swapping.any():
            return cells
        cells = np.where((crowded | swapping.any(axis=1))[:, None], before, cells)


def spread(values: list[float]) -> tuple[str, str, str]:
    return f"{np.median(values):.3f}", f"{np.mean(values):.3f}", f"{np.quantile(values, 0.95):.3f}"


if __name__ == "__main__":
    main()
