"""The parts of the paper's experiment and their files: models, test cases, results."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from gnn_policy import checkpoint
from gnn_policy.checkpoint import WEIGHTS
from gnn_policy.config import TrainConfig
from gnn_policy.cores import cpu_threads
from gnn_policy.execution import Execution
from gnn_policy.paper_rates import PAPER, TEAMS
from gnn_policy.precision import Precision
from gnn_policy.recipes import RECIPES
from mapf_env.generation import MapStyle

Step = Literal["all", "plan", "train", "test", "draw"]
Kind = Literal["paper", "connected", "informed"]

LONGER = {
    4: (0.9824, 0.9569, 0.9211, 0.8669, 0.8058, 0.7180),
    6: (0.9907, 0.9796, 0.9698, 0.9504, 0.9331, 0.9018),
    8: (0.9898, 0.9816, 0.9740, 0.9607, 0.9476, 0.9271),
    10: (0.9913, 0.9833, 0.9793, 0.9744, 0.9680, 0.9580),
    12: (0.9929, 0.9840, 0.9724, 0.9729, 0.9724, 0.9584),
}
"""The same of the paper's longer version (IROS 2020), with its online expert; quoted second-hand."""
W = 1.05
"""Suboptimality bound of the expert, whose makespans set T_max and whose flowtimes are the reference."""


LARGE = tuple((50, N) for N in (20, 40, 60))
"""Side of the map and size of the team of the longer paper's large maps."""
LARGEST = max(PAPER)


@dataclass(frozen=True)
class Options:
    """The part of the experiment to do, and its size."""

    step: tyro.conf.Positional[Step] = "all"
    """"plan" prints the remaining work and its duration; "train", "test", "draw" are the parts of "all"."""
    folder: Path = Path("runs/paper")
    """Folder for models, results and figures."""
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
    """Executions of the policies, as in gnn_policy.evaluate; the informed policy runs under the PIBT shield, as in its
    training."""
    own_size_rows: tuple[str, ...] = ("sampled",)
    """Further executions for figure 2 alone, on teams of the size that a model was trained on."""
    packaged: bool = False
    """Test the policies that come with the package, instead of those that were trained in the folder."""
    cases_per_map: int = 50
    """Test cases on each of 90 maps."""
    large: bool = True
    """Test the model of the largest training team on maps of 50x50 as well, where teams have 20, 40 and 60."""
    large_cases_per_map: int = 10
    """Test cases on each of them."""
    precision: Precision = "auto"
    """Number format of the policies in the tests, as in gnn_policy.train."""
    threads: int = 1
    """CPU threads of training, testing and the expert; 0 takes all that the process may use."""
    debug: bool = False
    """Print the traceback of an error."""


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
                extra_channels=("cost_to_go",) if informed else (),
            ),
            num_agents=N,
            density=0.2 if informed else full.density,  # more corridors, where one robot is in another's way
            execution=replace(full.execution, shield="pibt" if informed else "idle"),
            **{name: getattr(full, name) * LARGEST // N for name in counts},
        )

    @property
    def exists(self) -> bool:
        """True if the experiment has this model."""
        least = {"paper": 1, "connected": 2, "informed": 3}[self.kind]
        return self.taps >= least and (self.kind == "paper" or self.num_agents == LARGEST)

    @property
    def general(self) -> bool:
        """True if the model is tested on teams of every size."""
        without_communication = self == Model(LARGEST, 1)
        return without_communication or (self.taps == 3 and self.kind != "connected")

    def trained_for(self, scene: Scene) -> bool:
        """True if the teams have the size of the model's training."""
        return scene.size == 20 and scene.num_agents == self.num_agents


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


class Experiment:
    """The experiment as its options define it, and what is done of it."""

    def __init__(self, options: Options) -> None:
        if min(options.taps, default=0) < 1 or not options.train_on:
            raise ValueError("give at least one of --taps, 1 or more, and one of --train-on")
        if min(*options.train_on, options.cases_per_map, options.large_cases_per_map) < 1:
            raise ValueError("--train-on, --cases-per-map and --large-cases-per-map must be positive")
        self.threads = cpu_threads(options.threads)
        self.options = options
        self.rows = [Execution.parse(name).name for name in options.rows]
        self.own_size_rows = [Execution.parse(name).name for name in options.own_size_rows]
        self.models = [Model(N, K, kind) for kind in options.kinds for K in options.taps for N in options.train_on]
        self.models = [model for model in self.models if model.exists]
        self.scenes = [Scene(style, N) for style in options.styles for N in TEAMS]
        if options.large:
            self.scenes += [Scene(style, N, size) for style in options.styles for size, N in LARGE]

    def pairs(self) -> Iterator[tuple[Scene, Model]]:
        """Return the pairs of models and scenes to test."""
        for scene in self.scenes:
            for model in self.models:
                large = model == Model(LARGEST, 3) and scene.size == 50
                if large or (scene.size == 20 and model.general) or model.trained_for(scene):
                    yield scene, model

    def executions(self, model: Model, own_size: bool) -> list[Execution]:
        """Return the executions of a model, on teams of its training size or of other sizes."""
        names = (*self.options.rows, *(self.options.own_size_rows if own_size else ()))
        return [Execution.parse(name, Execution(shield=model.config.execution.shield)) for name in names]

    def run_of(self, model: Model) -> Path:
        """The run folder of a model."""
        return self.options.folder / model.name

    def policy_of(self, model: Model) -> Path | None:
        """Return the path of a model for `gnn_policy.load`."""
        if not self.options.packaged:
            return self.run_of(model) if self.is_trained(model) else None
        file = WEIGHTS / f"{model.name.replace('-k3', '')}.safetensors"
        if not file.exists():
            return None
        model.config.require_same_settings(checkpoint.trained_with(file), f"{file} holds a model of", "--folder")
        return file

    def untrained(self) -> list[Model]:
        """The models that are to be trained."""
        return [] if self.options.packaged else [each for each in self.models if not self.is_trained(each)]

    def is_trained(self, model: Model) -> bool:
        """Return True if the model's training is finished.

        Raises:
            FileExistsError: If the run folder holds a model of other settings.
        """
        metrics, config = (self.run_of(model) / name for name in ("metrics.csv", "config.toml"))
        if config.exists():
            model.config.require_same_settings(
                TrainConfig.load(config), f"{self.run_of(model)} holds a model of", "--folder"
            )
        return metrics.exists() and len(metrics.read_text().splitlines()) == 1 + model.config.rounds

    def cases_per_map(self, scene: Scene) -> int:
        """Test cases on each map of a scene."""
        return self.options.cases_per_map if scene.size == 20 else self.options.large_cases_per_map

    def result(self, scene: Scene, player: str) -> Path:
        """The file of what a model, or the "baselines", did on the cases of a scene."""
        return self.options.folder / "results" / scene.name / f"{player}.json"

    def row(self, scene: Scene, player: str, row: str) -> dict[str, Any] | None:
        """Return the result of a player under one execution in a scene, if it exists."""
        path = self.result(scene, player)
        if not path.exists():
            return None
        rows = {each["name"]: each for each in json.loads(path.read_text())["rows"]}
        return rows.get(row)
