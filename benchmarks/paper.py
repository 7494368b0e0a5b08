"""The paper's experiment: train its models, test them on maps they never saw, draw its figures beside its numbers.

    python benchmarks/paper.py          everything, going on from where it was stopped
    python benchmarks/paper.py plan     what is still to do, and how long that takes here
    python benchmarks/paper.py train    the models alone, one run folder of gnn_policy.train each
    python benchmarks/paper.py test     the finished models on the test maps
    python benchmarks/paper.py draw     figures and tables of what has been tested

Figure 2 is success and flowtime increase of models tested on teams of the size they were trained on, for K = 1, 2 and
3; figure 3 tests every model with K = 3 on every size. All models see equally many robot states. Beyond the paper there
are models for teams whose radius grows until they are connected, and one that knows the map and is trained under the
PIBT shield. Each finished model and each tested pair is a file; whatever is there is not done again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import matplotlib.pyplot as plt
import numpy as np
import torch
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress

from gnn_policy import checkpoint, evaluation
from gnn_policy.config import RECIPES, TrainConfig
from gnn_policy.execution import Execution
from gnn_policy.failures import Failure, count_failures
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.precision import Precision, autocast
from gnn_policy.progress import TrainingProgress
from gnn_policy.rollout import rollout
from gnn_policy.training import Training, split_cases
from mapf_env.files import replacing, write_whole
from mapf_env.generation import MapStyle

Step = Literal["all", "plan", "train", "test", "draw"]
Kind = Literal["paper", "connected", "informed"]

TEAMS: tuple[int, ...] = (4, 6, 8, 10, 12, 14)
PAPER = {
    4: (0.9431, 0.8518, 0.7531, 0.5980, 0.4909, 0.3642),
    6: (0.9638, 0.9313, 0.8747, 0.7916, 0.7058, 0.6227),
    8: (0.9676, 0.9442, 0.9140, 0.8547, 0.7842, 0.7042),
    10: (0.9647, 0.9520, 0.9249, 0.8984, 0.8544, 0.8136),
    12: (0.9696, 0.9542, 0.9347, 0.9082, 0.8791, 0.8302),
}
"""Figure 3 of the paper: success rate, a row for each size of the training teams, a column for each of TEAMS."""
W = 1.05
"""Of the expert whose makespans set T_max and whose flowtimes are compared with."""


@dataclass(frozen=True)
class Options:
    """Which part of the experiment to do, and how much of it."""

    step: tyro.conf.Positional[Step] = "all"
    """"plan" says what is to do and how long it takes; "train", "test", "draw" are the parts of "all"."""
    folder: Path = Path("runs/paper")
    """Where models, results and figures go."""
    train_on: tuple[int, ...] = tuple(PAPER)
    """Sizes of the training teams."""
    taps: tuple[int, ...] = (3, 2, 1)
    """Filter taps K of the models; K = 1 does not communicate."""
    kinds: tuple[Kind, ...] = ("paper", "connected", "informed")
    """Models after the "paper"; and of the largest training team those with a radius that grows until the team is
    "connected", K > 1, and one "informed" by a channel of the cost to go and trained under the PIBT shield, K = 3."""
    styles: tuple[MapStyle, ...] = ("cells", "walls")
    """Styles of the test maps, a table each."""
    rows: tuple[str, ...] = ("argmax", "stuck")
    """How the policies are executed, as in gnn_policy.evaluate; the informed one under the PIBT shield, which it is
    trained under."""
    own_size_rows: tuple[str, ...] = ("sampled",)
    """Further ways, for figure 2 alone: on teams of the size that a model was trained on."""
    cases_per_map: int = 50
    """Test cases on each of 90 maps."""
    large: bool = True
    """Test the model of the largest training team on maps of 50x50 as well, where teams have 20, 40 and 60."""
    precision: Precision = "auto"
    """In which numbers the policies compute in the tests, as in gnn_policy.train."""
    threads: int = 1
    """CPU threads of training, testing and the expert."""


@dataclass(frozen=True)
class Model:
    """One of the paper's models."""

    num_agents: int
    taps: int
    kind: Kind = "paper"

    @property
    def name(self) -> str:
        """The name of its run folder."""
        return f"n{self.num_agents}-k{self.taps}" + (f"-{self.kind}" if self.kind != "paper" else "")

    @property
    def config(self) -> TrainConfig:
        """Its settings: the recipe "full", in which a round has as many robot states for each size of the team."""
        full, N = RECIPES["full"], self.num_agents
        informed = self.kind == "informed"
        counts = ("batch_size", "demonstration_steps", "dagger_steps", "fresh_window")
        return replace(
            full,
            policy=replace(
                full.policy,
                taps=self.taps,
                comm_range="connected" if self.kind == "connected" else "fixed",
                cost_to_go=informed,
            ),
            num_agents=N,
            shield="pibt" if informed else "idle",
            **{name: getattr(full, name) * LARGEST // N for name in counts},
        )


@dataclass(frozen=True)
class Scene:
    """The test cases of one table."""

    style: MapStyle
    num_agents: int
    size: int = 20

    @property
    def name(self) -> str:
        """The name of its results' folder."""
        return f"{self.size}x{self.size}-{self.style}-n{self.num_agents}"


MEASURES = {
    "success_rate": "Success: all robots on goal at once",
    "latched": "Latched success: every robot has touched its goal, as in the released code",
    "flowtime_increase": "Flowtime increase over all cases, a failure counts T_max",
    "flowtime_increase_solved": "Flowtime increase over solved cases",
    "makespan": "Makespan of solved cases",
}
LARGE = tuple((50, N) for N in (20, 40, 60))
"""Side of the map and size of the team of the longer paper's large maps."""
LARGEST = max(PAPER)
STEPS = {20: 36, 50: 90}
"""How long a team is under way on a map of this side, about; to say how long the tests take."""


class Experiment:
    """The experiment as its options define it, and what is done of it."""

    def __init__(self, options: Options, console: Console) -> None:
        self.options, self.console = options, console
        self.rows = [Execution.parse(name).name for name in options.rows]
        self.own_size_rows = [Execution.parse(name).name for name in options.own_size_rows]
        self.models = [Model(N, K, kind) for kind in options.kinds for K in options.taps for N in options.train_on]
        self.models = [model for model in self.models if self._wanted(model)]
        self.scenes = [Scene(style, N) for style in options.styles for N in TEAMS]
        if options.large:
            self.scenes += [Scene(style, N, size) for style in options.styles for size, N in LARGE]

    def plan(self) -> None:
        """Say what is to do and how long it takes on this machine."""
        torch.set_num_threads(self.options.threads)
        untrained = [model for model in self.models if not self.is_trained(model)]
        hours = sum(self._training_seconds(model) for model in untrained) / 3600
        self.console.print(f"{len(self.models) - len(untrained)} of {len(self.models)} models are trained", end="; ")
        self.console.print(f"the others take about {hours:.1f} hours with {self.options.threads} thread(s)")
        pairs = list(self._pairs())
        untested = [pair for pair in pairs if not self._result(pair[0], pair[1].name).exists()]
        hours = sum(self._test_seconds(*pair) for pair in untested) / 3600
        self.console.print(f"{len(pairs) - len(untested)} of {len(pairs)} tests are done", end="; ")
        self.console.print(f"the others take about {hours:.1f} hours")

    def train(self) -> None:
        """Train what is not trained; each model resumes by itself."""
        for model in self.models:
            if self.is_trained(model):
                continue
            self.console.rule(f"training {model.name}")
            config = replace(model.config, threads=self.options.threads)
            with TrainingProgress(config.epochs, self.console) as progress:
                Training(config, self.run_of(model), progress).run()

    def test(self) -> None:
        """Play every trained model on the test cases; results that exist are kept."""
        torch.set_num_threads(self.options.threads)
        todo: dict[Scene, list[Model | None]] = {}
        for scene in self.scenes:
            if not self._result(scene, "baselines").exists():
                todo.setdefault(scene, []).append(None)
        for scene, model in self._pairs():
            if self.is_trained(model) and not self._result(scene, model.name).exists():
                todo.setdefault(scene, []).append(model)
        with Progress(console=self.console) as progress:
            task = progress.add_task("", total=sum(map(len, todo.values())))
            for scene, players in todo.items():
                progress.update(task, description=f"{scene.name}: expert")
                exam = self._exam(scene)
                for player in players:
                    progress.update(task, description=f"{scene.name}: {player.name if player else 'baselines'}")
                    rows, failures = (
                        (evaluation.baselines(exam), {}) if player is None else self._play(scene, player, exam)
                    )
                    result = {
                        "cases_per_map": self.options.cases_per_map,
                        **evaluation.as_json(rows, exam),
                        "failures": failures,
                    }
                    path = self._result(scene, player.name if player else "baselines")
                    path.parent.mkdir(parents=True, exist_ok=True)
                    write_whole(path, json.dumps(result, indent=2) + "\n")
                    progress.advance(task)

    def draw(self) -> None:
        """Figures 2 and 3 and all tables of what has been tested."""
        for style in self.options.styles:
            for name, picture in (("figure2", self._figure2), ("figure3", self._figure3)):
                figure = picture(style)
                path = self.options.folder / f"{name}-{style}.png"
                with replacing(path) as draft:
                    figure.savefig(draft, format="png", dpi=150)
                plt.close(figure)
                self.console.print(path, highlight=False)
        path = self.options.folder / "results.md"
        write_whole(path, "\n".join(self._tables()) + "\n")
        self.console.print(path, highlight=False)

    def run_of(self, model: Model) -> Path:
        """The run folder of a model."""
        return self.options.folder / model.name

    def is_trained(self, model: Model) -> bool:
        """Whether its training has come to its end."""
        metrics = self.run_of(model) / "metrics.csv"
        return metrics.exists() and len(metrics.read_text().splitlines()) == 1 + model.config.epochs

    @staticmethod
    def _wanted(model: Model) -> bool:
        least = {"paper": 1, "connected": 2, "informed": 3}[model.kind]
        return model.taps >= least and (model.kind == "paper" or model.num_agents == LARGEST)

    def _pairs(self) -> Iterator[tuple[Scene, Model]]:
        """Which model is tested where."""
        for scene in self.scenes:
            for model in self.models:
                large = model == Model(LARGEST, 3) and scene.size == 50
                if large or (scene.size == 20 and _general(model)) or _own_size(scene, model):
                    yield scene, model

    def _executions(self, model: Model, own_size: bool) -> list[Execution]:
        """How a model is executed, on teams of the size it was trained on or of others."""
        shield = ",pibt" if model.kind == "informed" else ""
        names = (*self.options.rows, *(self.options.own_size_rows if own_size else ()))
        return [Execution.parse(name + shield) for name in names]

    def _result(self, scene: Scene, player: str) -> Path:
        return self.options.folder / "results" / scene.name / f"{player}.json"

    def _exam(self, scene: Scene) -> evaluation.Exam:
        config = replace(
            RECIPES["full"],
            styles=(scene.style,),
            height=scene.size,
            width=scene.size,
            cases_per_map=self.options.cases_per_map,
        )
        cases = split_cases(config, "test", scene.num_agents)
        return evaluation.Exam.prepare(cases, w=W, timeout=config.timeout, threads=self.options.threads)

    def _play(
        self, scene: Scene, model: Model, exam: evaluation.Exam
    ) -> tuple[list[evaluation.Score], dict[str, dict[Failure, int]]]:
        """A row for each way to execute the model, and how its teams failed."""
        policy, rows, failures = checkpoint.load(self.run_of(model)), [], {}
        for execution in self._executions(model, _own_size(scene, model)):
            with autocast(self.options.precision, torch.device("cpu")):
                played = rollout(policy, exam.instances, max_steps=exam.max_steps, **asdict(execution))
            rows.append(evaluation.score(execution.name, exam, played))
            failures[execution.name] = count_failures(played)
        return rows, failures

    def _training_seconds(self, model: Model) -> float:
        """What the gradient steps of a training take here, and two fifths more for all else."""
        config = model.config
        policy = DecentralizedPolicy(config.policy)
        optimizer = torch.optim.Adam(policy.parameters(), fused=True)
        fov = torch.zeros(config.batch_size, model.num_agents, config.policy.channels, 11, 11)
        graph = torch.zeros(config.batch_size, model.num_agents, model.num_agents)

        def step() -> None:
            optimizer.zero_grad()
            with autocast(config.precision, fov.device):
                logits = policy(fov, graph)
            logits.float().square().mean().backward()
            optimizer.step()

        return 1.4 * config.epochs * (config.updates_per_epoch or 0) * _seconds(step)

    def _test_seconds(self, scene: Scene, model: Model) -> float:
        """What the network's forward passes take here, and a quarter more for all else."""
        policy = DecentralizedPolicy(model.config.policy).eval()
        fov = torch.zeros(64, scene.num_agents, model.config.policy.channels, 11, 11)
        graph = torch.zeros(64, scene.num_agents, scene.num_agents)
        with torch.inference_mode(), autocast(self.options.precision, fov.device):
            each = _seconds(lambda: policy(fov, graph), times=2) / 64
        cases = model.config.test_maps * self.options.cases_per_map
        return 1.25 * each * cases * STEPS[scene.size] * len(self._executions(model, _own_size(scene, model)))

    def _row(self, scene: Scene, player: str, row: str) -> dict[str, Any] | None:
        path = self._result(scene, player)
        if not path.exists():
            return None
        rows = {each["name"]: each for each in json.loads(path.read_text())["rows"]}
        return rows.get(row)

    def _figure2(self, style: MapStyle) -> Figure:
        figure, panels = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
        measures = (("success_rate", "success rate"), ("flowtime_increase", "flowtime increase"))
        for axes, (measure, label) in zip(panels, measures, strict=True):
            for taps in sorted(self.options.taps):
                for row, line in zip([*self.rows, *self.own_size_rows], ("-", "--", ":"), strict=False):
                    self._line(axes, style, taps, row, measure, line)
            axes.set(xlabel="robots, in training and test", ylabel=label, xticks=list(self.options.train_on))
            axes.grid(alpha=0.3)
        known = [N for N in self.options.train_on if N in PAPER]
        diagonal = [PAPER[N][TEAMS.index(N)] for N in known]
        panels[0].plot(known, diagonal, "kx", label="paper, K = 3")
        panels[0].legend(fontsize=7)
        figure.suptitle(f"Figure 2, {style} maps: what communication adds")
        return figure

    def _line(self, axes: Axes, style: MapStyle, taps: int, row: str, measure: str, line: str) -> None:
        tested = {
            N: found[measure]
            for N in self.options.train_on
            if (found := self._row(Scene(style, N), Model(N, taps).name, row))
        }
        if not tested:
            return
        mean = np.array([each["mean"] for each in tested.values()])
        low, high = (np.array([each[end] for each in tested.values()]) for end in ("low", "high"))
        axes.errorbar(
            list(tested),
            mean,
            [mean - low, high - mean],
            fmt=line,
            color=f"C{taps}",
            capsize=2,
            label=f"K = {taps}, {row}",
        )

    def _figure3(self, style: MapStyle) -> Figure:
        first = self.rows[0]
        ours = self._heat(style, first)
        paper = np.array([PAPER[N] for N in PAPER])
        figure, panels = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
        pictures = (
            ("paper", paper, "viridis", 0.3, 1.0),
            (f"here, {first}", ours, "viridis", 0.3, 1.0),
            ("difference", ours - paper, "RdYlGn", -0.3, 0.3),
        )
        for axes, (title, values, colours, low, high) in zip(panels, pictures, strict=True):
            axes.imshow(values, cmap=colours, vmin=low, vmax=high)
            for i, j in np.argwhere(np.isfinite(values)):
                text = f"{values[i, j]:+.3f}" if title == "difference" else f"{values[i, j]:.3f}"
                axes.text(j, i, text, ha="center", va="center", fontsize=8)
            axes.set(title=title, xlabel="robots in test", ylabel="robots in training")
            axes.set_xticks(range(len(TEAMS)), TEAMS)
            axes.set_yticks(range(len(PAPER)), list(PAPER))
        figure.suptitle(f"Figure 3, {style} maps: success rate, K = 3")
        return figure

    def _heat(self, style: MapStyle, row: str) -> np.ndarray:
        """(5, 6) success rates of our models with K = 3, not a number where one is not tested."""
        values = np.full((len(PAPER), len(TEAMS)), np.nan)
        for i, trained_on in enumerate(PAPER):
            for j, N in enumerate(TEAMS):
                if found := self._row(Scene(style, N), Model(trained_on, 3).name, row):
                    values[i, j] = found["success_rate"]["mean"]
        return values

    def _tables(self) -> Iterator[str]:
        for style in self.options.styles:
            for size in dict.fromkeys(scene.size for scene in self.scenes):
                scenes = [scene for scene in self.scenes if (scene.style, scene.size) == (style, size)]
                scenes = [scene for scene in scenes if self._result(scene, "baselines").exists()]
                if not scenes:
                    continue
                tested = [json.loads(self._result(scene, "baselines").read_text()) for scene in scenes]
                players = self._players([row["name"] for row in tested[0]["rows"]])
                yield f"## {style.capitalize()}, {size} x {size}\n"
                cases = " or ".join(sorted({str(each["cases"]) for each in tested}))
                expert = (
                    f"the expert's flowtime is {max(each['expert_over_bound'] for each in tested):.4f} of its bound"
                )
                yield f"{cases} cases for each size of the team; {expert} at most.\n"
                if size == 20:
                    for row in self.rows:
                        yield from self._figure3_table(style, row)
                    for measure in ("success_rate", "flowtime_increase"):
                        yield from self._figure2_table(style, measure)
                for measure, title in MEASURES.items():
                    yield f"### {title}\n"
                    yield from self._table(scenes, players, measure)
                    yield ""

    def _figure3_table(self, style: MapStyle, row: str) -> Iterator[str]:
        found = {N: [self._row(Scene(style, size), Model(N, 3).name, row) for size in TEAMS] for N in PAPER}
        if not all(any(line) for line in found.values()):
            return
        yield f"### Figure 3, {row}: success, its 95 % interval, the difference to the paper\n"
        yield "| trained on | " + " | ".join(map(str, TEAMS)) + " |"
        yield "|---|" + "---|" * len(TEAMS)
        for N, line in found.items():
            cells = [
                f"{_cell('success_rate', each)} {each['success_rate']['mean'] - paper:+.3f}" if each else ""
                for each, paper in zip(line, PAPER[N], strict=True)
            ]
            yield f"| {N} | " + " | ".join(cells) + " |"
        yield ""

    def _figure2_table(self, style: MapStyle, measure: str) -> Iterator[str]:
        """A line for each kind of model, K and way to execute, a column for each size of the team."""
        sizes = sorted({model.num_agents for model in self.models})
        labels = {"paper": "", "connected": ", radius grown", "informed": ", informed"}
        yield f"### Figure 2, teams of the size of training: {MEASURES[measure]}\n"
        yield "| model | " + " | ".join(map(str, sizes)) + " |"
        yield "|---|" + "---|" * len(sizes)
        for kind, label in labels.items():
            for taps in sorted({model.taps for model in self.models if model.kind == kind}):
                for execution in self._executions(Model(LARGEST, taps, kind), own_size=True):
                    line = [self._row(Scene(style, N), Model(N, taps, kind).name, execution.name) for N in sizes]
                    if any(line):
                        cells = [_cell(measure, each) if each else "" for each in line]
                        yield f"| K = {taps}{label}, {execution.name} | " + " | ".join(cells) + " |"
        yield ""

    def _table(self, scenes: Sequence[Scene], players: Sequence[tuple[str, str]], measure: str) -> Iterator[str]:
        yield "| robots | " + " | ".join(str(scene.num_agents) for scene in scenes) + " |"
        yield "|---|" + "---|" * len(scenes)
        for player, row in players:
            found = [self._row(scene, player, row) for scene in scenes]
            if any(found):
                cells = [_cell(measure, each) if each else "" for each in found]
                yield f"| {row if player == 'baselines' else f'{player} {row}'} | " + " | ".join(cells) + " |"
        if measure == "success_rate" and scenes[0].size == 20:
            for trained_on, values in PAPER.items():
                line = dict(zip(TEAMS, values, strict=True))
                cells = [f"{line[scene.num_agents]:.3f}" for scene in scenes]
                yield f"| paper, trained on {trained_on} | " + " | ".join(cells) + " |"

    def _players(self, baselines: Sequence[str]) -> list[tuple[str, str]]:
        """Who may have been tested on teams of any size, and how each was executed."""
        models = [
            (model.name, execution.name)
            for model in self.models
            if _general(model)
            for execution in self._executions(model, own_size=False)
        ]
        return [*models, *(("baselines", row) for row in baselines)]


def _general(model: Model) -> bool:
    """Whether it is tested on every size of the team."""
    without_communication = model == Model(LARGEST, 1)
    return without_communication or (model.taps == 3 and model.kind != "connected")


def _own_size(scene: Scene, model: Model) -> bool:
    return scene.size == 20 and scene.num_agents == model.num_agents


def _seconds(action: Callable[[], object], times: int = 20) -> float:
    """Of one call, after a warm-up."""
    action()
    began = time.perf_counter()
    for _ in range(times):
        action()
    return (time.perf_counter() - began) / times


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


def main(options: Options) -> None:
    """Do the chosen part."""
    experiment = Experiment(options, Console())
    if options.step in ("all", "plan"):
        experiment.plan()
    if options.step in ("all", "train"):
        experiment.train()
    if options.step in ("all", "test"):
        experiment.test()
    if options.step in ("all", "draw"):
        experiment.draw()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
