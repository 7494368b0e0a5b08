"""The end of training and of every evaluation: a table, its numbers as a file, and an animation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from rich.console import Console

from gnn_policy import evaluation
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.rollout import Rollouts
from mapf_env import Instance, animate
from mapf_env.files import write_whole


def examine(
    policy: DecentralizedPolicy,
    instances: dict[str, list[Instance]],
    folder: Path,
    console: Console,
    *,
    w: float,
    timeout: float,
    seed: int,
    threads: int,
    temperature: float = 1.0,
) -> None:
    """Print one table for each set of instances; write animation.svg and, at the very end, results.json into `folder`.

    Args:
        policy: Whom to examine.
        instances: Sets of held-out cases by their titles.
        folder: Where the files go.
        console: Where the tables go.
        w: Bound of the expert whose makespans set T_max and whose flowtimes are compared with.
        timeout: T_max in makespans of the expert's solution.
        seed: Of sampling and of the shield's tie-breaking.
        threads: CPU threads of the expert.
        temperature: Of the sampled policy.
    """
    tables: dict[str, object] = {}
    shown: Rollouts | None = None
    with console.status("") as status:
        for title, cases in instances.items():
            status.update(f"{title}: expert")
            exam = evaluation.Exam.prepare(cases, w=w, timeout=timeout, threads=threads)
            rows, played = evaluation.compare(
                exam,
                policy,
                temperature=temperature,
                seed=seed,
                progress=lambda phase, title=title: status.update(f"{title}: {phase}"),
            )
            console.print(evaluation.table(title, rows, exam))
            tables[title] = evaluation.as_json(rows, exam)
            shown = played["sampled"]
    if shown is not None:
        case = _worth_watching(shown)
        outcome = "all on goal" if shown.success[case] else "timed out"
        title = f"Trained policy, {shown.instances[case].num_agents} robots, unseen map: {outcome}"
        animate(shown.instances[case], shown.solutions[case], folder / "animation.svg", title=title)
        console.print(f"animation: {folder / 'animation.svg'}", highlight=False)
    write_whole(folder / "results.json", json.dumps(tables, indent=2) + "\n")
    console.print(f"numbers: {folder / 'results.json'}", highlight=False)


def _worth_watching(played: Rollouts) -> int:
    """The case of median length among the solved ones, or the first if none is solved."""
    solved = np.flatnonzero(played.success)
    return int(solved[np.argsort(played.makespan[solved], kind="stable")[len(solved) // 2]]) if len(solved) else 0
