"""`python -m gnn_policy.train`: expert data, training, evaluation and pictures in one command."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from gnn_policy import checkpoint
from gnn_policy.command_line import mistakes_in_one_line, on_device
from gnn_policy.config import RECIPES, Recipe, TrainConfig
from gnn_policy.examination import examine
from gnn_policy.progress import TrainingProgress
from gnn_policy.ranks import Ranks, join_ranks
from gnn_policy.training import Training


@dataclass(frozen=True)
class Command:
    """Train a decentralized policy by imitating an ECBS expert, then examine it on held-out maps.

    A killed run goes on where it stopped when the same command is given again. Several processes share the work, on one
    machine or more, when torchrun starts them: `torchrun --nproc-per-node 2 -m gnn_policy.train -- --run runs/two`.
    """

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    recipe: Recipe = "quick"
    """Which set of defaults the other options start from: "quick" takes about ten minutes on two CPU cores, "full" is
    that of the policies that come with the package, "paper" the paper's setup."""
    run: Path | None = None
    """The run folder; runs/RECIPE if not given."""


@dataclass(frozen=True)
class _RecipeOnly:
    recipe: Recipe = "quick"


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments ask for; the recipe among them decides the defaults of the rest."""
    chosen, _ = tyro.cli(_RecipeOnly, args=arguments, return_unknown_args=True, add_help=False)
    defaults = Command(RECIPES[chosen.recipe], chosen.recipe)
    return tyro.cli(Command, args=arguments, default=defaults, prog="python -m gnn_policy.train")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    with mistakes_in_one_line():
        command = parse(sys.argv[1:] if arguments is None else arguments)
        with join_ranks() as ranks:
            _train(command.config, command.run or Path("runs", command.recipe), Console(quiet=ranks.rank > 0), ranks)


def _train(config: TrainConfig, folder: Path, console: Console, ranks: Ranks) -> None:
    progress = TrainingProgress(config.epochs, console)
    training = Training(config, folder, progress, ranks)
    console.print(f"run folder: {folder}", highlight=False)
    if training.history:
        console.print(f"goes on after round {len(training.history)} of {config.epochs}", highlight=False)
    try:
        with progress:
            training.run()
    except KeyboardInterrupt:
        console.print(f"stopped; the same command goes on after round {len(training.history)}", highlight=False)
        raise SystemExit(130) from None
    if ranks.rank > 0:
        return
    policy = on_device(checkpoint.load(folder), config.device)
    examine(policy, config, folder, console, threads=training.threads)
    console.print(f"learning curve: {folder / 'learning_curve.png'}", highlight=False)
    console.print(f"policy: {folder / 'best.safetensors'}", highlight=False)


if __name__ == "__main__":
    main()
