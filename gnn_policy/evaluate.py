"""`python -m gnn_policy.evaluate RUN`: examine any policy on held-out maps."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console

from gnn_policy import checkpoint
from gnn_policy.command_line import cpu_threads, mistakes_in_one_line
from gnn_policy.config import TrainConfig
from gnn_policy.results import examine
from gnn_policy.training import split_cases
from mapf_env.generation import MapStyle


@dataclass(frozen=True)
class Command:
    """Examine a policy beside the expert and baselines that learn nothing, on the same held-out cases.

    What is not given is as the policy was trained.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = checkpoint.PACKAGED
    """A run folder of training, or a .safetensors file; the policy that comes with the package if not given."""
    num_agents: tuple[int, ...] = ()
    """Team sizes N, one table for each."""
    maps: int | None = None
    """How many test maps."""
    cases_per_map: int | None = None
    """Cases on each of them."""
    height: int | None = None
    """Rows of a map."""
    width: int | None = None
    """Columns of a map."""
    density: float | None = None
    """Share of obstacles."""
    styles: tuple[MapStyle, ...] | None = None
    """Obstacles as independent "cells" or short "walls"."""
    data_seed: int | None = None
    """Of the maps and cases; any seed gives maps that training with it does not use."""
    w: float | None = None
    """Bound of the expert whose makespans set T_max and whose flowtimes are compared with."""
    timeout: float | None = None
    """T_max in makespans of the expert's solution."""
    temperature: float = 1.0
    """Of the sampled policy."""
    seed: int | None = None
    """Of sampling and of the shield's tie-breaking."""
    out: Path | None = None
    """Folder for results.json and animation.svg; if not given, evaluation/ in the run folder or beside the file, and
    in the working folder for the policy that comes with the package."""
    threads: int = 0
    """CPU threads; 0 takes all that the process may use."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    with mistakes_in_one_line():
        command = tyro.cli(
            Command, args=sys.argv[1:] if arguments is None else arguments, prog="python -m gnn_policy.evaluate"
        )
        policy = checkpoint.load(command.run)
        given = {
            name: value
            for name in ("cases_per_map", "height", "width", "density", "styles", "data_seed", "w", "timeout", "seed")
            if (value := getattr(command, name)) is not None
        }
        if command.maps is not None:
            given["test_maps"] = command.maps
        config = replace(_trained_with(command.run), **given)
        instances = {
            f"{N} robots, {config.test_maps} held-out maps": split_cases(config, "test", N)
            for N in command.num_agents or (config.num_agents,)
        }
        folder = command.out or _home(command.run) / "evaluation"
        folder.mkdir(parents=True, exist_ok=True)
        threads = cpu_threads(command.threads)
        torch.set_num_threads(threads)
        examine(
            policy,
            instances,
            folder,
            Console(),
            w=config.w,
            timeout=config.timeout,
            seed=config.seed,
            threads=threads,
            temperature=command.temperature,
        )


def _home(run: Path) -> Path:
    if run == checkpoint.PACKAGED:
        return Path()
    return run if run.is_dir() else run.parent


def _trained_with(run: Path) -> TrainConfig:
    """The settings that a checkpoint says it was trained with."""
    settings = checkpoint.about(run).get("training")
    return TrainConfig() if settings is None else TrainConfig.from_json(settings)


if __name__ == "__main__":
    main()
