"""Tables and figures of what was played on POGEMA's sets, next to published results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich import box
from rich.table import Table

from gnn_policy.metrics import Estimate
from mapf_env.files import replacing
from pogema_cases import Published

LABELS = {
    "CSR": "success (CSR)",
    "ISR": "robots on their goals at the end (ISR)",
    "SoC": "sum of costs (SoC)",
    "makespan": "makespan",
    "throughput": "throughput, goals per step",
}
SPEED = "ms per step"
DRAWN = ("CSR", "SoC", "throughput")
"""The measures that have a figure."""


@dataclass(frozen=True)
class Score:
    """The results of one method on one set and team size."""

    set_name: str
    num_agents: int
    method: str
    cases: int
    measures: dict[str, Estimate]
    """The labels of `LABELS` for the task."""
    step_seconds: float
    """Wall-clock time of the method over the joint steps of all teams; teams are played in batches."""


def tables(set_name: str, scores: Sequence[Score], published: Sequence[Published]) -> list[Table]:
    """One table for each measure, and one for the time of a step; a column for each team size.

    Published rows carry the number of their source in the caption; they are means over all cases of the set.
    """
    sizes = sorted({score.num_agents for score in scores})
    methods = list(dict.fromkeys(score.method for score in scores))
    found = {(score.method, score.num_agents): score for score in scores}
    cases = "/".join(map(str, sorted({score.cases for score in scores})))
    drawn = []
    for measure in [name for name in LABELS if any(name in score.measures for score in scores)]:
        table = _table(f"{set_name}, {cases} cases: {LABELS[measure]}", sizes)
        for method in methods:
            cells = [found.get((method, size)) for size in sizes]
            table.add_row(method, *(_estimate(cell.measures[measure], measure) if cell else "" for cell in cells))
        rows = _by_method(published, set_name, measure)
        shown = {key: results for key, results in rows.items() if results.keys() & set(sizes)}
        sources = list(dict.fromkeys(source for _, source in shown))
        for (method, source), results in shown.items():
            values = [_number(results[size], measure) if size in results else "" for size in sizes]
            table.add_row(f"{method} [{1 + sources.index(source)}]", *values)
        table.caption = "; ".join(f"[{place}] {source}" for place, source in enumerate(sources, start=1)) or None
        drawn.append(table)
    speed = _table(f"{set_name}: {SPEED} of a team, wall clock", sizes)
    for method in methods:
        cells = [found.get((method, size)) for size in sizes]
        speed.add_row(method, *(f"{1e3 * cell.step_seconds:.3f}" if cell else "" for cell in cells))
    return [*drawn, speed]


def markdown(table: Table) -> str:
    """The table for a page."""
    lines = [f"**{table.title}**", ""]
    columns = [[str(cell).replace("\n", " ") for cell in column.cells] for column in table.columns]
    rows = [[str(column.header) for column in table.columns], ["---"] * len(columns), *zip(*columns, strict=True)]
    caption = [str(table.caption), ""] if table.caption else []
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows), "", *caption])


def draw(path: Path, set_name: str, scores: Sequence[Score], published: Sequence[Published]) -> None:
    """Write a figure: a panel for each measure of `DRAWN`, own methods with intervals, published means dashed.

    A method that several sources report has a line for each of them, in one colour.
    """
    measures = [name for name in DRAWN if any(name in score.measures for score in scores)]
    figure = Figure(figsize=(4.6 * len(measures) + 2.2, 4.4), layout="constrained")
    panels = figure.subplots(1, len(measures), squeeze=False)[0]
    for axes, measure in zip(panels, measures, strict=True):
        _panel(axes, measure, set_name, scores, published)
    lines = dict(zip(*reversed(panels[0].get_legend_handles_labels()), strict=True))  # one for each label
    figure.legend(lines.values(), lines.keys(), loc="outside right upper", fontsize="small")
    with replacing(path) as draft:
        figure.savefig(draft, format="png", dpi=120)


def _panel(axes: Axes, measure: str, set_name: str, scores: Sequence[Score], published: Sequence[Published]) -> None:
    for method in dict.fromkeys(score.method for score in scores):
        own = sorted((score for score in scores if score.method == method), key=lambda score: score.num_agents)
        sizes = [score.num_agents for score in own]
        means = np.array([score.measures[measure].mean for score in own])
        bounds = np.array([(score.measures[measure].low, score.measures[measure].high) for score in own]).T
        (line,) = axes.plot(sizes, means, "o-", markersize=5, linewidth=2, label=method)
        axes.fill_between(sizes, *bounds, alpha=0.2, color=line.get_color())
    by_method = _by_method(published, set_name, measure)
    names = sorted({method for method, _ in by_method})
    palette = colormaps["turbo"](np.linspace(0.05, 0.95, max(1, len(names))))
    for (method, _), results in by_method.items():
        colour = palette[names.index(method)]
        axes.plot(list(results), list(results.values()), "--", linewidth=1, color=colour, label=method)
    axes.set(title=f"{set_name}: {LABELS[measure]}", xlabel="robots", ylim=(0, None))
    axes.grid(alpha=0.3)


def _by_method(published: Sequence[Published], set_name: str, measure: str) -> dict[tuple[str, str], dict[int, float]]:
    """Published values of a measure by team size, for each method and source."""
    found: dict[tuple[str, str], dict[int, float]] = {}
    for row in published:
        if row.set_name == set_name and measure in row.results:
            found.setdefault((row.method, row.source), {})[row.num_agents] = row.results[measure]
    return {key: dict(sorted(results.items())) for key, results in found.items()}


def _table(title: str, sizes: Sequence[int]) -> Table:
    table = Table(
        title=title,
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    table.add_column("robots", overflow="fold")
    for size in sizes:
        table.add_column(str(size), justify="right", no_wrap=True)
    return table


def _estimate(estimate: Estimate, measure: str) -> str:
    low, high = _number(estimate.low, measure), _number(estimate.high, measure)
    return f"{_number(estimate.mean, measure)}\n[{low}, {high}]"


def _number(value: float, measure: str) -> str:
    if not math.isfinite(value):
        return "?"
    return f"{value:.{ {'CSR': 3, 'ISR': 3, 'SoC': 0, 'makespan': 1, 'throughput': 2}[measure] }f}"
