"""The paper's figures 2 and 3 next to its numbers, and tables of all results."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from gnn_policy.paper_rates import PAPER, TEAMS
from gnn_policy.recipes import RECIPES
from gnn_policy.report import heat_map
from mapf_env.files import replacing, write_whole
from mapf_env.generation import MapStyle
from paper_experiment import LARGEST, LONGER, Experiment, Kind, Model, Scene

MEASURES = {
    "success_rate": "Success: all robots on goal at once",
    "latched": "Latched success: every robot has touched its goal, as in the released code",
    "flowtime_increase": "Flowtime increase over all cases, a failure counts T_max",
    "flowtime_increase_solved": "Flowtime increase over solved cases",
    "makespan": "Makespan of solved cases",
}


def draw(experiment: Experiment) -> Iterator[Path]:
    """Figures 2 and 3 and all tables of what has been tested."""
    experiment.options.folder.mkdir(parents=True, exist_ok=True)
    for style in experiment.options.styles:
        if not any(experiment.options.folder.glob(f"results/*-{style}-*/*.json")):
            continue
        for name, picture in (("figure2", _figure2), ("figure3", _figure3)):
            figure = picture(experiment, style)
            path = experiment.options.folder / f"{name}-{style}.png"
            with replacing(path) as draft:
                figure.savefig(draft, format="png", dpi=150)
            plt.close(figure)
            yield path
    path = experiment.options.folder / "results.md"
    write_whole(path, "\n".join(tables(experiment)) + "\n")
    yield path


def _figure2(experiment: Experiment, style: MapStyle) -> Figure:
    figure, panels = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    measures = (("success_rate", "success rate"), ("flowtime_increase", "flowtime increase"))
    for axes, (measure, label) in zip(panels, measures, strict=True):
        rows = [*experiment.rows, *experiment.own_size_rows]
        for taps in sorted(experiment.options.taps):
            for row, line in zip(rows, cycle(("-", "--", ":", "-.")), strict=False):
                _line(experiment, axes, style, taps, row, measure, line)
        axes.set(xlabel="robots, in training and test", ylabel=label, xticks=list(experiment.options.train_on))
        axes.grid(alpha=0.3)
    known = [N for N in experiment.options.train_on if N in PAPER]
    diagonal = [PAPER[N][TEAMS.index(N)] for N in known]
    panels[0].plot(known, diagonal, "kx", label="paper, K = 3")
    panels[0].legend(fontsize=7, handlelength=4)
    panels[0].set_title("2a")
    panels[1].set_title("2b")
    panels[1].yaxis.set_major_formatter(PercentFormatter(1.0))
    figure.suptitle(f"Figure 2, maps of {style}: what communication adds")
    return figure


def _line(experiment: Experiment, axes: Axes, style: MapStyle, taps: int, row: str, measure: str, line: str) -> None:
    tested = {
        N: found[measure]
        for N in experiment.options.train_on
        if (found := experiment.row(Scene(style, N), Model(N, taps).name, row))
    }
    if not tested:
        return
    mean = np.array([each["mean"] for each in tested.values()])
    low, high = (np.array([each[end] for each in tested.values()]) for end in ("low", "high"))
    axes.errorbar(
        list(tested),
        mean,
        [mean - low, high - mean],
        fmt="o" + line,
        markersize=4,
        color=f"C{taps}",
        capsize=2,
        label=f"K = {taps}, {row}",
    )


def _figure3(experiment: Experiment, style: MapStyle) -> Figure:
    first = experiment.rows[0]
    ours, paper = success_rates(experiment, style, first), np.array(list(PAPER.values()))
    figure, panels = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    pictures = (("paper", paper, False), (f"here, {first}", ours, False), ("difference", ours - paper, True))
    for axes, (title, values, signed) in zip(panels, pictures, strict=True):
        heat_map(axes, title, values, list(PAPER), TEAMS, signed=signed)
        axes.set_ylabel("robots in training")
    figure.suptitle(f"Figure 3, maps of {style}: success rate, K = 3")
    return figure


def success_rates(experiment: Experiment, style: MapStyle, row: str) -> np.ndarray:
    """Return (5, 6) success rates of our models with K = 3, NaN where one is not tested."""
    values = np.full((len(PAPER), len(TEAMS)), np.nan)
    for i, trained_on in enumerate(PAPER):
        for j, N in enumerate(TEAMS):
            if found := experiment.row(Scene(style, N), Model(trained_on, 3).name, row):
                values[i, j] = found["success_rate"]["mean"]
    return values


def tables(experiment: Experiment) -> Iterator[str]:
    """The lines of a Markdown page with every number that is known."""
    for style in experiment.options.styles:
        for size in dict.fromkeys(scene.size for scene in experiment.scenes):
            scenes = [scene for scene in experiment.scenes if (scene.style, scene.size) == (style, size)]
            scenes = [scene for scene in scenes if experiment.result(scene, "baselines").exists()]
            if not scenes:
                continue
            tested = [json.loads(experiment.result(scene, "baselines").read_text()) for scene in scenes]
            players = _players(experiment, [row["name"] for row in tested[0]["rows"]])
            yield f"## {style.capitalize()}, {size} x {size}\n"
            cases = " or ".join(sorted({str(each["cases"]) for each in tested}))
            over = max(each["expert_over_bound"] for each in tested)
            yield f"{cases} cases for each size of the team; the expert's flowtime is at most {over:.4f} x its bound."
            yield f"Models have the encoder {RECIPES['full'].policy.encoder}.\n"
            if size == 20:
                for row in experiment.rows:
                    yield from _figure3_table(experiment, style, row)
                for measure in ("success_rate", "flowtime_increase"):
                    yield from _figure2_table(experiment, style, measure)
            for measure, title in MEASURES.items():
                yield f"### {title}\n"
                yield from _table(experiment, scenes, players, measure)
                yield ""


def _figure3_table(experiment: Experiment, style: MapStyle, row: str) -> Iterator[str]:
    found = {N: [experiment.row(Scene(style, size), Model(N, 3).name, row) for size in TEAMS] for N in PAPER}
    if not all(any(line) for line in found.values()):
        return
    yield f"### Figure 3, {row}: success, its 95 % interval, the differences to the paper and to its longer version\n"
    yield "| trained on | " + " | ".join(map(str, TEAMS)) + " |"
    yield "|---|" + "---|" * len(TEAMS)
    for N, line in found.items():
        cells = [
            f"{_cell('success_rate', each)} {each['success_rate']['mean'] - paper:+.3f} "
            f"{each['success_rate']['mean'] - longer:+.3f}"
            if each
            else ""
            for each, paper, longer in zip(line, PAPER[N], LONGER[N], strict=True)
        ]
        yield f"| {N} | " + " | ".join(cells) + " |"
    here = success_rates(experiment, style, row)
    if np.isfinite(here).all():
        means = (here.mean(), *(np.mean(list(each.values())) for each in (PAPER, LONGER)))
        yield "\nMean of the thirty cells: {:.4f}, the paper {:.4f}, its longer version {:.4f}.".format(*means)
    yield ""


def _figure2_table(experiment: Experiment, style: MapStyle, measure: str) -> Iterator[str]:
    """A line for each kind of model, K and way to execute, a column for each size of the team."""
    sizes = sorted({model.num_agents for model in experiment.models})
    labels: dict[Kind, str] = {"paper": "", "connected": ", radius grown", "informed": ", informed*"}
    yield f"### Figure 2, on teams of the size of training. {MEASURES[measure]}\n"
    yield "| model | " + " | ".join(map(str, sizes)) + " |"
    yield "|---|" + "---|" * len(sizes)
    for kind, label in labels.items():
        for taps in sorted({model.taps for model in experiment.models if model.kind == kind}):
            for execution in experiment.executions(Model(LARGEST, taps, kind), own_size=True):
                line = [experiment.row(Scene(style, N), Model(N, taps, kind).name, execution.name) for N in sizes]
                if any(line):
                    cells = [_cell(measure, each) if each else "" for each in line]
                    yield f"| K = {taps}{label}, {execution.name} | " + " | ".join(cells) + " |"
    yield ""


def _table(
    experiment: Experiment, scenes: Sequence[Scene], players: Sequence[tuple[str, str, str]], measure: str
) -> Iterator[str]:
    yield "| robots | " + " | ".join(str(scene.num_agents) for scene in scenes) + " |"
    yield "|---|" + "---|" * len(scenes)
    for label, player, row in players:
        found = [experiment.row(scene, player, row) for scene in scenes]
        if any(found):
            cells = [_cell(measure, each) if each else "" for each in found]
            yield f"| {label} | " + " | ".join(cells) + " |"
    if measure == "success_rate" and scenes[0].size == 20:
        for name, table in (("paper", PAPER), ("longer version", LONGER)):
            for trained_on, values in table.items():
                line = dict(zip(TEAMS, values, strict=True))
                cells = [f"{line[scene.num_agents]:.3f}" for scene in scenes]
                yield f"| {name}, trained on {trained_on} | " + " | ".join(cells) + " |"


def _players(experiment: Experiment, baselines: Sequence[str]) -> list[tuple[str, str, str]]:
    """List the players and their executions: label, player, execution; a star knows the map."""
    models = [
        (f"{model.name}{'*' if model.config.policy.needs_map else ''} {execution.name}", model.name, execution.name)
        for model in experiment.models
        if model.general
        for execution in experiment.executions(model, own_size=False)
    ]
    return [*models, *((row, "baselines", row) for row in baselines)]


def _cell(measure: str, row: dict[str, Any]) -> str:
    """An estimate with its 95 % interval, as a share or as a signed percentage; what has no interval as a share."""
    found = row[measure]
    if not isinstance(found, dict):
        return f"{found:.3f}"
    if found["mean"] is None:
        return "-"
    mean, low, high = (found[name] for name in ("mean", "low", "high"))
    if measure.startswith("flowtime"):
        return f"{mean:+.1%} [{100 * low:+.1f}, {100 * high:+.1f}]"
    return f"{mean:.3f} [{low:.3f}, {high:.3f}]" if measure == "success_rate" else f"{mean:.1f}"
