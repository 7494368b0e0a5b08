"""One page about training runs: `python -m gnn_policy.report RUNS...`.

Learning curves, success and flowtime against the number of robots next to the paper's, failures with replays of
examples, and tables of speed. The page is one file that works offline. Files that a run folder lacks are left out:
`metrics.csv` comes from training, `results.json` from `python -m gnn_policy.evaluate RUN --num-agents ... --failures
K`, which leaves `failures.html` next to it.
"""

from __future__ import annotations

import csv
import importlib.metadata
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, cast

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gnn_policy.command_line import run_command
from gnn_policy.config import TrainConfig
from gnn_policy.failures import MEANINGS
from gnn_policy.paper_rates import PAPER, TEAMS
from mapf_env.files import write_whole

PROG = "python -m gnn_policy.report"
STYLE = """
body{margin:0;font:15px/1.5 system-ui,sans-serif;background:#f6f7f9;color:#1f2530}
main{max-width:1000px;margin:auto;padding:16px}
h1{font-size:24px}h2{font-size:19px;margin-top:36px}
section{display:flex;flex-wrap:wrap;gap:12px}
section svg{flex:1 1 330px;min-width:0;max-width:500px;height:auto}
iframe{width:100%;height:720px;border:1px solid #cbd2da;border-radius:6px;background:#fff}
@media (max-width:660px){iframe{height:800px}}
pre{background:#fff;border:1px solid #cbd2da;padding:10px;overflow-x:auto;font-size:12px}
"""


@dataclass(frozen=True)
class Options:
    """Write one page about training runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders of `gnn_policy.train`, those of benchmarks/paper.py with what it tested on cells among them."""
    speed: tuple[Path, ...] = ()
    """Output of benchmarks/speed.py, solvers.py or training.py, as text files."""
    out: Path = Path("report.html")
    """The page to write."""
    debug: bool = False
    """Print the traceback of an error."""


@dataclass(frozen=True)
class Run:
    """The contents of a run folder."""

    name: str
    trained_on: int
    """Robots in a training team."""
    metrics: list[dict[str, str]]
    """A row for each round."""
    results: dict[str, Any]
    """Tables by the number of robots; empty if the run was not evaluated."""
    tested_on: str
    """The maps and cases of the tables."""
    failures: str | None
    """The page of the worst cases."""

    @staticmethod
    def load(folder: Path) -> Run:
        """Read a run folder.

        Raises:
            FileNotFoundError: If it is not a run folder.
        """
        if not (folder / "config.toml").is_file():
            raise FileNotFoundError(f"{folder} is not a run folder of gnn_policy.train: it has no config.toml")
        metrics = folder / "metrics.csv"
        home = next((each for each in (folder / "evaluation", folder) if (each / "results.json").is_file()), None)
        page = (home or folder) / "failures.html"
        found = json.loads((home / "results.json").read_text(encoding="utf-8")) if home else {}
        tests = {N: folder.parent / f"results/20x20-cells-n{N}/{folder.name}.json" for N in TEAMS}
        tested = {str(N): json.loads(file.read_text(encoding="utf-8")) for N, file in tests.items() if file.is_file()}
        return Run(
            folder.name,
            TrainConfig.load(folder / "config.toml").num_agents,
            list(csv.DictReader(io.StringIO(metrics.read_text(encoding="utf-8")))) if metrics.is_file() else [],
            tested or found.get("tables", {}),
            "benchmarks/paper.py: test maps of independent cells, w = 1.05"
            if tested
            else _tested_on(found.get("settings")),
            page.read_text(encoding="utf-8") if page.is_file() else None,
        )

    def rows(self) -> list[str]:
        """The names of the executions of the policy."""
        return list(next(iter(self.results.values()))["failures"]) if self.results else []

    def estimates(self, row: str, measure: str) -> Iterator[tuple[int, float]]:
        """Number of robots and mean of a measure, where there is one."""
        for size, table in self.results.items():
            for found in table["rows"]:
                if found["name"].removesuffix("*") == row and found[measure]["mean"] is not None:
                    yield int(size), found[measure]["mean"]


def _tested_on(settings: dict[str, Any] | None) -> str:
    if not settings:
        return "not evaluated"
    styles, size = " and ".join(settings["styles"]), f"{settings['height']} x {settings['width']}"
    maps = f"{settings['maps']} {settings['split']} maps of {styles}, {size}, {settings['cases_per_map']} cases each"
    return f"{maps}, w = {settings['w']}, T_max {settings['timeout']} makespans"


def page(runs: Sequence[Run], speed: dict[str, str]) -> str:
    """The report as HTML."""
    version = importlib.metadata.version("mapf-env")
    names = ", ".join(run.name for run in runs)
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(names)}</title><style>{STYLE}</style></head><body><main><h1>{escape(names)}</h1>"
        f"<p>{date.today()}, mapf-env {version}</p>"
    ]
    if any(run.metrics for run in runs):
        parts += ["<h2>Learning curves</h2>", curves([run for run in runs if run.metrics])]
    evaluated = [run for run in runs if run.results]
    parts += [
        f"<p>{escape(run.name)} is not evaluated yet; <code>python -m gnn_policy.evaluate RUN --num-agents 4 6 8 10 12 "
        "14 --failures 5</code> does it.</p>"
        for run in runs
        if not run.results
    ]
    if evaluated:
        tested_on = {
            run.tested_on: ", ".join(each.name for each in evaluated if each.tested_on == run.tested_on)
            for run in evaluated
        }
        parts += [
            "<h2>What was evaluated</h2>",
            *(f"<p>{escape(who)}: {escape(tested_on)}</p>" for tested_on, who in tested_on.items()),
        ]
        parts += ["<h2>Success and flowtime against the number of robots</h2>", against_robots(evaluated)]
        parts += ["<h2>Success next to the paper's</h2>", heat_maps(evaluated)]
        kinds = "".join(f"<li><b>{kind}</b>: {meaning}</li>" for kind, meaning in MEANINGS.items())
        parts += ["<h2>Why teams failed</h2>", f"<ul>{kinds}</ul>", failures(evaluated)]
    for run in evaluated:
        if run.failures is not None:
            parts.append(
                f"<h3>{escape(run.name)}: the worst of each kind, by python -m gnn_policy.evaluate</h3>"
                f'<iframe title="replays" srcdoc="{escape(run.failures)}"></iframe>'
            )
    if speed:
        parts.append("<h2>Speed</h2>")
        parts += [f"<h3>{escape(name)}</h3><pre>{escape(text)}</pre>" for name, text in speed.items()]
    return "\n".join([*parts, "</main></body></html>", ""])


def curves(runs: Sequence[Run]) -> str:
    """Validation success and loss against the robot states trained on."""
    success, loss = axes(), axes()
    for run in runs:
        known = [each for each in run.metrics if each["validation_success"]]
        xs = [int(each["samples"]) / 1e6 for each in known]
        success.plot(xs, [float(each["validation_success"]) for each in known], marker=".", label=run.name)
        loss.plot([int(each["samples"]) / 1e6 for each in run.metrics], [float(each["loss"]) for each in run.metrics])
    for diagram in (success, loss):
        diagram.locator_params(axis="x", nbins=5)
    success.set(xlabel="million robot states", ylabel="validation success, argmax")
    loss.set(xlabel="million robot states", ylabel="cross-entropy")
    legend(success)
    return side_by_side(success, loss)


def against_robots(runs: Sequence[Run]) -> str:
    """Draw every execution, with the paper's row of the same training teams."""
    success, flowtime = axes(), axes()
    for run in runs:
        for row in run.rows():
            label = f"{run.name}, {row}"
            success.plot(*np.transpose(list(run.estimates(row, "success_rate"))), marker="o", label=label)
            flowtime.plot(*np.transpose(list(run.estimates(row, "flowtime_increase"))), marker="o")
    for size in sorted({run.trained_on for run in runs} & set(PAPER)):
        success.plot(TEAMS, PAPER[size], linestyle="--", color="black", label=f"paper, trained on {size}")
    sizes = sorted({size for run in runs for row in run.rows() for size, _ in run.estimates(row, "success_rate")})
    success.set(xlabel="robots", ylabel="success rate", ylim=(None, 1.005), xticks=sizes)
    flowtime.set(xlabel="robots", ylabel="flowtime increase", xticks=sizes)
    legend(success)
    return side_by_side(success, flowtime)


def heat_maps(runs: Sequence[Run]) -> str:
    """Draw the success of the first execution, training teams by test teams, and the paper's."""
    ours = {run.name: dict(run.estimates(run.rows()[0], "success_rate")) for run in sorted(runs, key=by_size)}
    paper = {str(size): dict(zip(TEAMS, row, strict=True)) for size, row in PAPER.items()}
    columns = sorted({size for row in (*ours.values(), *paper.values()) for size in row})
    pictures = []
    for title, table in (("here, first way of execution", ours), ("paper, trained on", paper)):
        pictures.append(axes())
        values = np.array([[row.get(size, np.nan) for size in columns] for row in table.values()])
        heat_map(pictures[-1], title, values, list(table), columns)
    return side_by_side(*pictures)


def heat_map(
    axes: Axes,
    title: str,
    values: np.ndarray,
    rows: Sequence[object],
    columns: Sequence[int],
    *,
    signed: bool = False,
) -> None:
    """Draw a cell for each pair of training and test teams, white where a number is missing; differences are signed."""
    colours, low, high = ("PuOr_r", -0.5, 0.5) if signed else ("viridis", 0.3, 1.0)
    axes.imshow(values, cmap=colours, vmin=low, vmax=high, aspect="auto")
    for i, j in np.argwhere(np.isfinite(values)):
        text = f"{values[i, j]:{'+' if signed else ''}.3f}".replace("0.", ".", 1)
        dark = abs(values[i, j]) > 0.3 if signed else values[i, j] < 0.8
        axes.text(j, i, text, ha="center", va="center", fontsize=9, color="white" if dark else "black")
    axes.set(title=title, xlabel="robots in test")
    axes.set_xticks(range(len(columns)), list(map(str, columns)))
    axes.set_yticks(range(len(rows)), list(map(str, rows)))


def by_size(run: Run) -> tuple[int, str]:
    """Runs in the order of their training teams."""
    return run.trained_on, run.name


def failures(runs: Sequence[Run]) -> str:
    """Draw the failures by kind, a diagram for each execution of each run."""
    return side_by_side(*(failure_bars(run, row) for run in runs for row in run.rows()))


def failure_bars(run: Run, row: str) -> Axes:
    """Failed cases by the number of robots, the kinds upon one another."""
    bars = axes()
    sizes, upon = list(run.results), np.zeros(len(run.results))
    for kind in MEANINGS:
        found = np.array([table["failures"][row].get(kind, 0) for table in run.results.values()])
        bars.bar(sizes, found, bottom=upon, label=kind)
        upon += found
    for size, total in zip(sizes, upon, strict=True):
        bars.annotate(f"{total:.0f}", (size, total), ha="center", va="bottom")
    cases = sorted({table["cases"] for table in run.results.values()})
    bars.set(title=f"{run.name}, {row}", xlabel="robots", ylabel=f"failed of {'/'.join(map(str, cases))} cases")
    bars.set_ylim(0, max(1.0, 1.15 * upon.max()))
    bars.set_xticks(sizes)
    legend(bars)
    return bars


def legend(diagram: Axes) -> None:
    """Under the diagram, where it covers nothing."""
    names = diagram.get_legend_handles_labels()
    cast(Figure, diagram.figure).legend(*names, fontsize="small", loc="outside lower center", ncols=3)


def axes() -> Axes:
    """An empty diagram."""
    return Figure(figsize=(4.6, 3.5), layout="constrained").subplots()


def side_by_side(*diagrams: Axes) -> str:
    """Diagrams as SVG that stands in HTML, below one another on a phone."""
    pictures = []
    for diagram in diagrams:
        file = io.StringIO()
        cast(Figure, diagram.figure).savefig(file, format="svg", metadata={"Date": None})
        pictures.append(file.getvalue()[file.getvalue().index("<svg") :])
    return f"<section>{''.join(pictures)}</section>"


def parse(arguments: Sequence[str], prog: str = PROG) -> Options:
    """Return the command that the arguments ask for."""
    return tyro.cli(Options, args=arguments, prog=prog, description=__doc__)


def main(arguments: Sequence[str] | None = None, *, prog: str = PROG) -> None:
    """Run the command."""
    run_command(partial(parse, prog=prog), write_report, arguments)


def write_report(options: Options) -> None:
    """Write the page."""
    if not options.runs:
        raise ValueError("give at least one run folder of gnn_policy.train")
    runs = [Run.load(folder) for folder in options.runs]
    speed = {file.name: file.read_text(encoding="utf-8") for file in options.speed}
    write_whole(options.out, page(runs, speed))
    print(f"report: {options.out}")


if __name__ == "__main__":
    main()
