"""The end of training and of every evaluation: a table, its numbers as a file, and an animation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from gnn_policy import checkpoint, evaluation
from gnn_policy.cases import Split
from gnn_policy.config import TrainConfig
from gnn_policy.execution import Execution
from gnn_policy.failures import count_failures, worst
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.results_file import (
    read_tables,
    refuse_other_settings,
    settings_of,
    table_title,
    variants_of_training,
    write_tables,
)
from gnn_policy.rollout import Rollouts
from gnn_policy.training import split_cases
from mapf_env import Scene, animate, replay_scenes


def examine(
    policy: DecentralizedPolicy,
    config: TrainConfig,
    folder: Path,
    console: Console,
    *,
    num_agents: Sequence[int] = (),
    variants: Sequence[Execution] | None = None,
    split: Split = "test",
    threads: int,
    failures: int = 0,
) -> None:
    """Print one table for each team size; write animation.svg and results.json into `folder`.

    Each team size is written when it is finished, results.json last. If results.json already holds some of the sizes,
    as after a kill, only the others are played; a complete one is computed again.

    Args:
        policy: The policy.
        config: The held-out cases, the expert's w, T_max in its makespans, and the seed of draws and ties.
        folder: Where the files go.
        console: Where the tables go.
        num_agents: Team sizes N; the one of `config` if none is given.
        variants: How to execute the policy, one row for each; `variants_of_training` if not given.
        split: Which maps.
        threads: CPU threads of the expert.
        failures: How many cases of the first variant to show next to the expert's solutions, for each team size, in
            failures.html; the worst of each kind of failure come first. With them every size is played.

    Raises:
        ValueError: If there is no variant, or `failures` is negative.
        FileExistsError: If the folder has results of other settings.
    """
    if variants is None:
        variants = variants_of_training(config)
    if not variants:
        raise ValueError("there is no way to execute the policy: give at least one row")
    if failures < 0:
        raise ValueError(f"failures must not be negative, got {failures}")
    settings = {"policy": checkpoint.fingerprint(policy), **settings_of(config, num_agents, variants, split)}
    sizes, numbers = settings["num_agents"], folder / "results.json"
    refuse_other_settings(numbers, settings, "--out")
    tables = read_tables(numbers)
    finished = set() if failures or tables.keys() >= set(sizes) else tables.keys() & set(sizes)
    cases = {N: split_cases(config, split, N) for N in sizes if N not in finished}
    scenes: list[Scene] = []
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("", total=len(cases) * (len(variants) + len(evaluation.BASELINES)))
        for N in sizes:
            title = table_title(N, settings)
            if N in finished:
                console.print(evaluation.table(title, tables[N]))
                continue
            progress.update(task, description=f"{title}: expert")
            exam = evaluation.Exam.prepare(cases[N], w=config.w, timeout=config.timeout, threads=threads)
            rows, shown = evaluation.compare(
                exam,
                policy,
                variants,
                seed=config.seed,
                progress=lambda phase, title=title: progress.update(task, description=f"{title}: {phase}", advance=1),
            )
            progress.advance(task)
            kinds = {each.name: count_failures(played) for each, played in zip(variants, shown, strict=True)}
            table = {**evaluation.as_json(rows, exam), "failures": kinds}
            console.print(evaluation.table(title, table))
            _animate(shown, folder / "animation.svg")
            if failures:
                scenes += worst(shown[0], exam.solutions, failures)
                heading = f"The worst cases of {variants[0].name} next to the expert's solutions"
                perceived = variants[0].perceived(policy.config)
                replay_scenes(scenes, folder / "failures.html", title=heading, config=perceived)
            tables[N] = table
            write_tables(numbers, settings, tables)
    console.print(f"animation: {folder / 'animation.svg'}", highlight=False)
    if scenes:
        console.print(f"worst cases: {folder / 'failures.html'}", highlight=False)
    console.print(f"numbers: {numbers}", highlight=False)


def _animate(shown: Sequence[Rollouts], path: Path) -> None:
    """Write an animation of a case of the best variant."""
    best = max(shown, key=lambda played: played.success.mean())
    case = _worth_watching(best)
    outcome = "all on goal" if best.success[case] else "timed out"
    title = f"Trained policy, {best.instances[case].num_agents} robots, unseen map: {outcome}"
    animate(best.instances[case], best.solutions[case], path, title=title)


def _worth_watching(played: Rollouts) -> int:
    """The case of median length among the solved ones, or the first if none is solved."""
    solved = np.flatnonzero(played.success)
    return int(solved[np.argsort(played.makespan[solved], kind="stable")[len(solved) // 2]]) if len(solved) else 0
