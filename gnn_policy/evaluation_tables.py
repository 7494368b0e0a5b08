"""Evaluation on held-out cases, after training and by command: tables, their numbers as a file, and an animation."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from experts.cluster import connect
from gnn_policy import checkpoint, metrics
from gnn_policy.cases import Split
from gnn_policy.config import TrainConfig
from gnn_policy.execution import Execution
from gnn_policy.failures import count_failures, worst
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.results_json import (
    default_executions,
    read_tables,
    refuse_other_settings,
    settings_of,
    table_title,
    tables_of,
    write_tables,
)
from gnn_policy.rollout import Rollouts
from mapf_env import EnvConfig, Scene, animate, replay_scenes


def evaluate_and_report(
    policy: DecentralizedPolicy,
    config: TrainConfig,
    folder: Path,
    console: Console,
    *,
    num_agents: Sequence[int] = (),
    executions: Sequence[Execution] | None = None,
    split: Split = "test",
    steps: int = metrics.LIFELONG_STEPS,
    whole: bool = False,
    threads: int,
    failures: int = 0,
    cluster: str | None = None,
) -> None:
    """Print one table for each team size; write animation.svg and results.json into `folder`.

    Cases of lifelong tasks have a table of throughput, without the expert.

    Each team size is written when it is finished, results.json last. If results.json already holds some of the sizes,
    as after a kill, only the others are played; a complete one is computed again.

    Args:
        policy: The policy.
        config: The held-out cases, the expert's w, T_max in its makespans, and the seed of draws and ties.
        folder: Where the files go.
        console: Where the tables go.
        num_agents: Team sizes N; those of `config` if none is given.
        executions: How to execute the policy, one row for each; `default_executions(policy.execution)` if not given.
        split: Which maps.
        steps: Steps of a lifelong episode.
        whole: Play all cases of the files, including those that training on them would use.
        threads: CPU threads of the expert.
        failures: Number of cases of the first execution to show next to the expert's solutions, for each table, in
            failures.html; the worst of each kind of failure come first. With them every table is computed.
        cluster: The address of a Ray cluster that solves and plays the cases, as in `experts.solve_many`.

    Raises:
        ValueError: If there is no execution, or `failures` is negative or asked for in a lifelong task.
        FileExistsError: If the folder has results of other settings.
    """
    if executions is None:
        executions = default_executions(policy.execution)
    if not executions:
        raise ValueError("executions is empty: give at least one execution")
    if failures < 0:
        raise ValueError(f"failures must not be negative, got {failures}")
    if failures and "lifelong" in config.tasks:
        raise ValueError("a lifelong team cannot fail: leave failures out")
    settings = {
        "policy": checkpoint.fingerprint(policy),
        **settings_of(config, num_agents, executions, split),
        **({"steps": steps} if "lifelong" in config.tasks else {}),
    }
    cases, numbers = tables_of(config, num_agents), folder / "results.json"
    refuse_other_settings(numbers, settings, "--out")
    tables = read_tables(numbers)
    finished = set() if failures or tables.keys() >= cases.keys() else tables.keys() & cases.keys()
    instances = {name: each.cases(split, whole=whole).instances for name, each in cases.items() if name not in finished}
    lifelong = {name: each.tasks == {"lifelong"} for name, each in cases.items()}
    baselines = {name: metrics.LIFELONG_BASELINES if lifelong[name] else metrics.BASELINES for name in instances}
    scenes: list[Scene] = []
    connection = nullcontext() if cluster is None else connect(cluster, workers=threads)
    with connection, Progress(console=console, transient=True) as progress:
        bar = progress.add_task("", total=sum(len(executions) + len(each) for each in baselines.values()))
        for name in cases:
            title = table_title(name, settings)
            make_table = lifelong_table if lifelong[name] else success_table
            if name in finished:
                console.print(make_table(title, tables[name]))
                continue

            def advance(phase: str, title: str = title) -> None:
                progress.update(bar, description=f"{title}: {phase}", advance=1)

            if lifelong[name]:
                tables[name], rollouts = metrics.compare_lifelong(
                    instances[name],
                    policy,
                    executions,
                    steps=steps,
                    seed=config.seed,
                    cluster=cluster,
                    progress=advance,
                )
            else:
                progress.update(bar, description=f"{title}: expert")
                reference = metrics.ReferenceSet.prepare(
                    instances[name],
                    w=config.w,
                    timeout=config.timeout,
                    threads=threads,
                    nodes=config.reference_nodes,
                    cluster=cluster,
                )
                rows, rollouts = metrics.compare(
                    reference, policy, executions, seed=config.seed, cluster=cluster, progress=advance
                )
                progress.advance(bar)
                kinds = {each.name: count_failures(played) for each, played in zip(executions, rollouts, strict=True)}
                tables[name] = {**metrics.as_json(rows, reference), "failures": kinds}
                if failures:
                    scenes += worst(rollouts[0], reference.solutions, failures)
                    heading = f"The worst cases of {executions[0].name} next to the expert's solutions"
                    perceived = EnvConfig(**executions[0].env_settings(policy.config))
                    replay_scenes(scenes, folder / "failures.html", title=heading, config=perceived)
            console.print(make_table(title, tables[name]))
            _animate(rollouts, folder / "animation.svg")
            write_tables(numbers, settings, tables)
    console.print(f"animation: {folder / 'animation.svg'}", highlight=False)
    if scenes:
        console.print(f"worst cases: {folder / 'failures.html'}", highlight=False)
    console.print(f"numbers: {numbers}", highlight=False)


def success_table(title: str, result: dict[str, Any]) -> Table:
    """Return what `metrics.as_json` returns as a table for the terminal, at most 80 columns wide."""
    shown = Table(title=title, caption=_caption(result), box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    shown.add_column("", overflow="fold")
    for heading in ("success rate", "flowtime\nincrease", "of solved\ncases", "make-\nspan", "lat-\nched"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for row in result["rows"]:
        rate, makespan = row["success_rate"], row["makespan"]["mean"]
        shown.add_row(
            row["name"],
            f"{rate['mean']:.3f} \\[{rate['low']:.3f}, {rate['high']:.3f}]",
            _percent(row["flowtime_increase"]),
            _percent(row["flowtime_increase_solved"]),
            "-" if makespan is None else f"{makespan:.1f}",
            f"{row['latched']:.3f}",
        )
    return shown


def lifelong_table(title: str, result: dict[str, Any]) -> Table:
    """Return what `metrics.compare_lifelong` returns as a table for the terminal."""
    caption = f"{result['cases']} cases of {result['steps']} steps, 95 % intervals; * knows the whole map"
    shown = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    shown.add_column("", overflow="fold")
    shown.add_column("arrivals\nper step", justify="right", no_wrap=True)
    for row in result["rows"]:
        mean, high = row["throughput"]["mean"], row["throughput"]["high"]
        shown.add_row(row["name"], f"{mean:.3f}" + ("" if high is None else f" ±{high - mean:.3f}"))
    return shown


def _caption(result: dict[str, Any]) -> str:
    lines = [
        f"{result['cases']} cases, 95 % intervals; T_max follows from the expert's makespan",
        f"the expert's flowtime is {result['expert_over_bound']:.4f} x its lower bound",
        "stuck: stuck robots sample their moves; * knows the whole map",
    ]
    if result["unsolved_by_expert"]:
        lines.append(f"{result['unsolved_by_expert']} more cases are left out: the expert did not solve them")
    return "\n".join(lines)


def _percent(estimate: dict[str, float | None]) -> str:
    mean, high = estimate["mean"], estimate["high"]
    if mean is None:
        return "-"
    return f"{mean:+.1%}" + ("" if high is None else f" ±{100 * (high - mean):.1f}")


def _animate(rollouts: Sequence[Rollouts], path: Path) -> None:
    """Write an animation of a case of the best execution."""
    best = max(rollouts, key=lambda played: (played.success.mean(), played.throughput.mean()))
    number = _worth_watching(best)
    lifelong = len(best.goals[number]) > 1
    outcome = "all on goal" if best.success[number] else "timed out"
    if lifelong:
        outcome = f"{best.throughput[number]:.2f} arrivals per step"
    title = f"Trained policy, {best.instances[number].num_agents} robots: {outcome}"
    goals = best.goals[number] if lifelong else None
    animate(best.instances[number], best.solutions[number], path, title=title, goals=goals)


def _worth_watching(played: Rollouts) -> int:
    """Return the case of median length among the solved ones, or the first if none is solved."""
    solved = np.flatnonzero(played.success)
    return int(solved[np.argsort(played.makespan[solved], kind="stable")[len(solved) // 2]]) if len(solved) else 0
