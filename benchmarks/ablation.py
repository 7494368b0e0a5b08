"""Ablations of the expert's labels and of aggregation: `python benchmarks/ablation.py labels` or `dagger`.

Each variant differs from the default in the settings that its name says, and is trained on the same maps for the same
small number of gradient steps on one thread. Finished runs are not repeated and interrupted ones are resumed, so give
the command again after an interruption. It writes a table, `labels.md` or `dagger.md`, and `dagger.png` into the folder
of the runs. Seconds are CPU seconds, which do not depend on other processes.
"""

from __future__ import annotations

import functools
import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import tyro
from matplotlib.figure import Figure
from rich.console import Console

import experts
from gnn_policy.command_line import run_command
from gnn_policy.config import TrainConfig
from gnn_policy.execution import Execution
from gnn_policy.labelling import Labeller
from gnn_policy.metrics import Estimate, ReferenceSet
from gnn_policy.progress import TrainingProgress
from gnn_policy.recipes import RECIPES
from gnn_policy.rollout import rollout
from gnn_policy.training import Training
from mapf_env import Action, BatchedEnv, Solution
from mapf_env.files import replacing, write_whole

Variants = dict[str, dict[str, Any]]

BASE = replace(
    RECIPES["quick"],
    rounds=12,
    updates_per_round=320,
    dagger_steps=8_192,
    fresh_window=32_768,
    validation_cases_per_map=10,
    validate_every=4,
    threads=1,
)
"""1.2 million robot states."""
DEFAULT = "default"
LABELS: Variants = {
    DEFAULT: {},
    "w = 1": {"w": 1.0},
    "w = 1.2": {"w": 1.2},
    "w = 1.5": {"w": 1.5},
    "random order": {"robot_order": "random"},
    "farthest first": {"robot_order": "farthest"},
    "nearest first": {"robot_order": "nearest"},
    "prioritised": {"expert": "prioritised"},
    "LaCAM": {"expert": "lacam"},
    "LaCAM improved": {"expert": "ablation:improved_lacam"},
    "PIBT": {"expert": "pibt"},
}
JUDGED_AT_THE_END: dict[str, Any] = {"validate_every": BASE.rounds, "validation_cases_per_map": 1}
"""Validation in training uses the w of the expert; the table has the same cases and time limits for all."""
DAGGER: Variants = {
    DEFAULT: {},
    "none": {"dagger_every": 0},
    "failed, every 4th round": {"aggregation": "failed", "dagger_every": 4, "dagger_steps": 32_768, "fresh_share": 0.0},
    "failed, every round": {"aggregation": "failed", "dagger_steps": 32_768, "fresh_share": 0.0},
    "fresh 0.25": {"fresh_share": 0.25},
    "fresh 0.5": {"fresh_share": 0.5},
    "mining 2": {"hard_case_mining": 2},
    "mining 4": {"hard_case_mining": 4},
    "nodes 20": {"expert_nodes": 20},
    "beta 0.8": {"beta_decay": 0.8},
}
CPU_MINUTES = 2.5
"""Duration of a run on one core of an Intel Xeon at 2.3 GHz, shown until a run is finished."""

improved_lacam = functools.partial(experts.lacam, w=1.05, time_limit=2e-3)


@dataclass(frozen=True)
class Options:
    """Train the variants of one ablation, then write its table."""

    ablation: Annotated[Literal["labels", "dagger"], tyro.conf.Positional]
    """The ablation: experts and their tie-breaking, or kinds and weights of aggregation."""
    runs: Path = Path("runs/ablation")
    """The folder of all runs; both ablations share the default's."""
    seeds: int = 1
    """Runs of each variant."""
    only: tuple[str, ...] = ()
    """Names of variants to train now; the table has all that are finished."""
    updates: int = BASE.updates_per_round or 0
    """Gradient steps in each of the 12 rounds."""
    debug: bool = False
    """Print the traceback of an error."""


def main(options: Options) -> None:
    console = Console(width=120)
    variants = LABELS if options.ablation == "labels" else DAGGER
    unknown = set(options.only) - set(variants)
    if unknown:
        raise ValueError(f"no variants {sorted(unknown)}: choose among {list(variants)}")
    if options.seeds < 1:
        raise ValueError(f"--seeds must be at least 1, got {options.seeds}")
    chosen = [name for name in variants if not options.only or name in options.only]
    queue = [(name, seed) for seed in range(options.seeds) for name in chosen]
    for place, (name, seed) in enumerate(queue):
        left = [each for each in queue[place:] if outcome(options, *each) is None]
        if (name, seed) in left:
            minutes = expected_minutes(options, variants) * len(left)
            console.print(f"{len(left)} runs to go, about {minutes:.0f} CPU minutes; now: {name}, seed {seed}")
            train(options, name, config_of(options, name, seed), console)
    found = {
        (name, seed): result
        for seed in range(options.seeds)
        for name in variants
        if (result := outcome(options, name, seed)) is not None
    }
    quality = label_quality(options.runs, console) if options.ablation == "labels" else {}
    table = markdown(found, quality)
    write_whole(options.runs / f"{options.ablation}.md", table)
    console.print(table, highlight=False, markup=False, soft_wrap=True)
    if options.ablation == "dagger":
        with replacing(options.runs / "dagger.png") as draft:
            draw(found, draft)


def train(options: Options, name: str, config: TrainConfig, console: Console) -> None:
    """One run; its outcome is written at its end."""
    folder = run_folder(options.runs, name, config.seed)
    progress = TrainingProgress(config.rounds, console)
    training = Training(config, folder, progress, clock=time.process_time)
    with progress:
        training.run()
    reference = reference_set()
    played = rollout(training.policy, reference.instances, execution=Execution(), max_steps=reference.max_steps)
    spent = np.cumsum([row.collect_seconds + row.fit_seconds for row in training.history])
    rows = training.history
    result = {
        "success": played.success.astype(int).tolist(),
        "flowtime_increase": float(reference.increase(played.flowtime).mean()),
        "accuracy": rows[-1].accuracy,
        "states": rows[-1].demonstrations,
        "unlabelled": sum(row.unlabelled for row in rows),
        "samples": rows[-1].samples,
        "seconds": float(spent[-1]),
        "expert_seconds": sum(row.expert_seconds for row in rows),
        "all_seconds": rows[-1].seconds,
        "curve": [
            (float(seconds), row.validation_success)
            for seconds, row in zip(spent, rows, strict=True)
            if row.validation_success is not None
        ],
    }
    write_whole(folder / "outcome.json", json.dumps(result) + "\n")


def run_folder(runs: Path, name: str, seed: int) -> Path:
    return runs / re.sub(r"[^\w.]+", "-", f"{name} seed {seed}")


def config_of(options: Options, name: str, seed: int) -> TrainConfig:
    """The settings of a run."""
    settings = {"updates_per_round": options.updates, "seed": seed, **{**LABELS, **DAGGER}[name]}
    if name not in DAGGER:
        settings |= JUDGED_AT_THE_END
    return replace(BASE, **settings)


def outcome(options: Options, name: str, seed: int) -> dict[str, Any] | None:
    """Return the outcome of a run, if it is finished.

    Raises:
        FileExistsError: If it is a run of other settings.
    """
    folder = run_folder(options.runs, name, seed)
    if not (folder / "outcome.json").exists():
        return None
    found = TrainConfig.load(folder / "config.toml")
    config_of(options, name, seed).require_same_settings(found, f"{folder} holds a run of", "--runs")
    return json.loads((folder / "outcome.json").read_text())


def expected_minutes(options: Options, variants: Variants) -> float:
    """Estimate the duration of one run from the finished ones."""
    taken = [
        result["all_seconds"] / 60
        for name in variants
        for seed in range(options.seeds)
        if (result := outcome(options, name, seed)) is not None
    ]
    return float(np.mean(taken)) if taken else CPU_MINUTES * options.updates / (BASE.updates_per_round or 1)


@functools.cache
def reference_set() -> ReferenceSet:
    """The same validation cases and time limits for all, whatever taught."""
    return ReferenceSet.prepare(BASE.cases("validation").instances, w=BASE.w, timeout=BASE.timeout, threads=1)


class ExpertActor:
    """Asks the expert again in every state and takes its moves.

    Args:
        labeller: Asks the expert.
        grids: Its maps, all of one size.
    """

    def __init__(self, labeller: Labeller, grids: Sequence[npt.NDArray[np.bool_]]) -> None:
        self.labeller, self.states = labeller, 0
        self._number = {grid.tobytes(): number for number, grid in enumerate(grids)}

    def env_settings(self) -> dict[str, Any]:
        """Return the settings of an environment in which nothing is perceived that costs time."""
        return {"fov_radius": 1, "comm_radius": 0.0}

    def act(self, env: BatchedEnv) -> npt.NDArray[np.int64]:
        """Return the labels (B, N)."""
        running = np.flatnonzero(env.running)
        maps = np.array([self._number[grid.tobytes()] for grid in env.grids[running]], np.int32)
        moves, _ = self.labeller.moves(replace(env.states(env.running), maps=maps))
        actions = np.full((env.num_envs, env.num_agents), Action.IDLE)
        actions[running] = moves.reshape(len(running), -1)
        self.states += len(running)
        return actions


def label_quality(runs: Path, console: Console) -> dict[str, dict[str, float]]:
    """Measure the labels of each variant when they are followed from step to step."""
    file = runs / "quality.json"
    known: dict[str, dict[str, float]] = json.loads(file.read_text()) if file.exists() else {}
    reference = reference_set()
    bounds = np.array([each.lower_bound for each in experts.solve_many(reference.instances, w=1.0)])
    for name, settings in LABELS.items():
        if name in known:
            continue
        console.print(f"quality of labels: {name}")
        config = replace(BASE, **settings)
        grids = list({each.grid.tobytes(): each.grid for each in reference.instances}.values())
        labeller = Labeller(
            grids,
            solver=config.expert,
            w=config.w,
            robot_order=config.robot_order,
            node_limit=config.expert_nodes,
            threads=1,
            clock=time.process_time,
        )
        actor = ExpertActor(labeller, grids)
        played = rollout(actor, reference.instances, max_steps=reference.max_steps)
        solved = played.success
        known[name] = {
            "solved": float(solved.mean()),
            "over_bound": float(played.flowtime[solved].sum() / bounds[solved].sum()),
            "makespan": float(played.makespan[solved].mean()),
            "waits": waiting([played.solutions[case] for case in np.flatnonzero(solved)]),
            "microseconds": labeller.seconds / actor.states * 1e6,
        }
        write_whole(file, json.dumps(known, indent=2) + "\n")
    return known


def waiting(solutions: Sequence[Solution]) -> float:
    """The share of waits among all moves before a robot's last arrival."""
    waits = moves = 0
    for solution in solutions:
        under_way = np.arange(len(solution.paths) - 1)[:, None] < solution.arrival_times
        waits += int(((np.diff(solution.paths, axis=0) == 0).all(-1) & under_way).sum())
        moves += int(under_way.sum())
    return waits / max(moves, 1)


def markdown(found: dict[tuple[str, int], dict[str, Any]], quality: dict[str, dict[str, float]]) -> str:
    """One row for each run; differences are to the default of the same seed, case by case."""
    headings = ["variant", "seed", "success, argmax", "- default", "flowtime increase", "label accuracy"]
    if quality:
        headings += ["labels followed: solved", "flowtime / bound", "makespan", "waits", "us a label"]
    headings += ["labelled states", "trained on", "training, s", "of it expert, s"]
    lines = ["| " + " | ".join(headings) + " |", "|" + "---|" * len(headings)]
    for (name, seed), result in found.items():
        outcomes = np.array(result["success"], np.float64)
        success, default = Estimate.proportion(outcomes > 0), found.get((DEFAULT, seed))
        difference = ""
        if default is not None and name != DEFAULT:
            apart = Estimate.average(outcomes - np.array(default["success"]))
            difference = f"{apart.mean:+.3f} ±{apart.high - apart.mean:.3f}"
        cells = [
            name,
            str(seed),
            f"{success.mean:.3f} [{success.low:.3f}, {success.high:.3f}]",
            difference,
            f"{result['flowtime_increase']:+.1%}",
            f"{result['accuracy']:.3f}",
        ]
        if quality:
            labels = quality[name]
            cells += [
                f"{labels['solved']:.3f}",
                f"{labels['over_bound']:.4f}",
                f"{labels['makespan']:.2f}",
                f"{labels['waits']:.3f}",
                f"{labels['microseconds']:.0f}",
            ]
        cells += [f"{result['states']:,}", f"{result['samples'] / 1e6:.1f}M"]
        cells += [f"{result['seconds']:.0f}", f"{result['expert_seconds']:.1f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw(found: dict[tuple[str, int], dict[str, Any]], path: Path) -> None:
    """Draw validation success against CPU seconds of training, a line for each variant, the mean of its seeds."""
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.subplots()
    for name in dict.fromkeys(name for name, _ in found):
        curves = np.array([result["curve"] for (each, _), result in found.items() if each == name])
        seconds, success = curves.mean(axis=0).T
        axes.plot(seconds / 60, success, "o-", markersize=4, label=name, linewidth=2.4 if name == DEFAULT else 1.4)
    axes.set(xlabel="CPU minutes of training, one thread", ylabel="validation success (argmax)", ylim=(0, None))
    axes.set_xlim(0, None)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120, format="png")


if __name__ == "__main__":
    run_command(lambda arguments: tyro.cli(Options, args=arguments, description=__doc__), main)
