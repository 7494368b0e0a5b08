"""The end of training and of every evaluation: a table, its numbers as a file, and an animation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from gnn_policy import checkpoint, evaluation
from gnn_policy.cases import Split
from gnn_policy.config import TrainConfig
from gnn_policy.execution import Execution
from gnn_policy.failures import count_failures, worst
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.rollout import Rollouts
from gnn_policy.training import split_cases
from mapf_env import Scene, animate, replay_scenes
from mapf_env.files import write_whole


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
    """Print one table for each team size; write animation.svg and, at the very end, results.json into `folder`.

    Args:
        policy: Whom to examine.
        config: The held-out cases, the expert's w, T_max in its makespans, and the seed of draws and ties.
        folder: Where the files go.
        console: Where the tables go.
        num_agents: Team sizes N; that of `config` if none is given.
        variants: How to execute the policy, one row for each; if not given argmax, stuck robots draw, and all do, under
            the shield of training.
        split: Which maps.
        threads: CPU threads of the expert.
        failures: How many cases of the first variant to show beside the expert's solutions, for each team size, in
            failures.html; the worst of each kind of failure come first.

    Raises:
        ValueError: If there is no variant, or `failures` is negative.
        FileExistsError: If the folder has results of other settings.
    """
    if variants is None:
        variants = [Execution(sample=sample, shield=config.shield) for sample in (False, "stuck", True)]
    if not variants:
        raise ValueError("there is no way to execute the policy: give at least one row")
    if failures < 0:
        raise ValueError(f"failures must not be negative, got {failures}")
    sizes = tuple(num_agents) or (config.num_agents,)
    settings = _settings(policy, config, sizes, variants, split)
    refuse_other_settings(folder / "results.json", settings, "--out")
    cases = {N: split_cases(config, split, N) for N in sizes}
    tables: dict[str, object] = {}
    shown: list[Rollouts] = []
    scenes: list[Scene] = []
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("", total=len(sizes) * (len(variants) + len(evaluation.BASELINES)))
        for N, instances in cases.items():
            title = f"{N} robots, {settings['maps']} {split} maps"
            progress.update(task, description=f"{title}: expert")
            exam = evaluation.Exam.prepare(instances, w=config.w, timeout=config.timeout, threads=threads)
            rows, shown = evaluation.compare(
                exam,
                policy,
                variants,
                seed=config.seed,
                progress=lambda phase, title=title: progress.update(task, description=f"{title}: {phase}", advance=1),
            )
            progress.advance(task)
            console.print(evaluation.table(title, rows, exam))
            kinds = {each.name: count_failures(played) for each, played in zip(variants, shown, strict=True)}
            tables[str(N)] = {**evaluation.as_json(rows, exam), "failures": kinds}
            if failures:
                scenes += worst(shown[0], exam.solutions, failures)
    best = max(shown, key=lambda played: played.success.mean())
    case = _worth_watching(best)
    outcome = "all on goal" if best.success[case] else "timed out"
    title = f"Trained policy, {best.instances[case].num_agents} robots, unseen map: {outcome}"
    animate(best.instances[case], best.solutions[case], folder / "animation.svg", title=title)
    console.print(f"animation: {folder / 'animation.svg'}", highlight=False)
    if scenes:
        title = f"The worst cases of {variants[0].name} beside the expert's solutions"
        perceived = variants[0].perceived(policy.config)
        replay_scenes(scenes, folder / "failures.html", title=title, config=perceived)
        console.print(f"worst cases: {folder / 'failures.html'}", highlight=False)
    write_whole(folder / "results.json", json.dumps({"settings": settings, "num_agents": tables}, indent=2) + "\n")
    console.print(f"numbers: {folder / 'results.json'}", highlight=False)


def _settings(
    policy: DecentralizedPolicy,
    config: TrainConfig,
    num_agents: Sequence[int],
    variants: Sequence[Execution],
    split: Split,
) -> dict[str, Any]:
    """All that the numbers depend on."""
    maps, cases_per_map = config.size_of(split)
    names = ("height", "width", "density", "data_seed", "w", "timeout", "seed")
    return {
        "policy": checkpoint.fingerprint(policy),
        "variants": [variant.name for variant in variants],
        "num_agents": list(num_agents),
        "split": split,
        "maps": maps,
        "cases_per_map": cases_per_map,
        "styles": list(config.styles),
        **{name: getattr(config, name) for name in names},
    }


def refuse_other_settings(path: Path, settings: dict[str, Any], option: str) -> None:
    """Accept a file of results only if it is not there, or has these settings.

    Args:
        path: The file.
        settings: All that its numbers depend on.
        option: That of the command which names the folder.

    Raises:
        FileExistsError: If it has results of other settings.
    """
    if not path.exists():
        return
    try:
        known = json.loads(path.read_text())["settings"]
        differ = [name for name in settings if known.get(name) != settings[name]]
    except (json.JSONDecodeError, KeyError, AttributeError, TypeError):
        differ = ["unknown"]
    if differ:
        raise FileExistsError(
            f"{path} has results of other settings ({', '.join(differ)}): choose another folder with {option}, "
            "or delete the file"
        )


def _worth_watching(played: Rollouts) -> int:
    """The case of median length among the solved ones, or the first if none is solved."""
    solved = np.flatnonzero(played.success)
    return int(solved[np.argsort(played.makespan[solved], kind="stable")[len(solved) // 2]]) if len(solved) else 0
