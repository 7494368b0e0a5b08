"""`python -m gnn_policy.train`: expert data, training, evaluation and pictures in one command."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from gnn_policy import checkpoint
from gnn_policy.command_line import parse_options, run_command
from gnn_policy.config import TrainConfig
from gnn_policy.cores import cpu_threads
from gnn_policy.recipes import RECIPES, Recipe
from gnn_policy.results_json import default_executions, read_tables, settings_of, table_title, tables_of
from gnn_policy.run_folder import RESULTS, check_run, is_finished

if TYPE_CHECKING:
    from gnn_policy.processes import Process

PROG = "python -m gnn_policy.train"


@dataclass(frozen=True)
class Command:
    """Train a decentralized policy by imitating an ECBS expert, then evaluate it on held-out maps.

    A killed run resumes when the same command is given again. Several processes share the work, on one machine or more,
    when torchrun starts them: `torchrun --nproc-per-node 2 -m gnn_policy.train -- --run runs/two`.
    """

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    recipe: Recipe = "quick"
    """Which set of defaults the other options start from: "quick" takes about ten minutes on two CPU cores, "full" made
    the paper's models that come with the package, "paper" is the paper's setup, "general" makes the policy for any map
    and crowds of robots in hours, "refine" improves one that exists by reinforcement learning."""
    file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE.toml")] = None
    """A file of settings, such as the config.toml of another run, instead of a recipe; missing settings have the
    defaults of "paper"."""
    run: Path | None = None
    """The run folder; runs/RECIPE, or runs/ and the name of the file of settings, if not given."""
    debug: bool = False
    """Print the traceback of an error."""


@dataclass(frozen=True)
class _Defaults:
    recipe: Recipe = "quick"
    file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    init: str | None = None


def parse(arguments: Sequence[str], prog: str = PROG) -> Command:
    """Return the command that the arguments ask for.

    The recipe or the file of settings among them decides the other defaults; `--init` decides the network, its senses
    and its execution.
    """
    chosen, _ = tyro.cli(_Defaults, args=arguments, return_unknown_args=True, add_help=False, prog=prog)
    config = RECIPES[chosen.recipe] if chosen.file is None else TrainConfig.load(chosen.file)
    if chosen.init is not None:  # a file of settings with `init` has the policy and execution that belong to it
        execution = checkpoint.executed_as(chosen.init)
        rollouts = execution.actions if config.objective == "delay" else config.rollout_actions
        config = replace(
            config, policy=checkpoint.config_of(chosen.init), execution=execution, rollout_actions=rollouts
        )
    command = parse_options(Command, arguments, default=Command(config, chosen.recipe, chosen.file), prog=prog)
    _refuse_unused(command.config, config)
    return command


def _refuse_unused(config: TrainConfig, defaults: TrainConfig) -> None:
    """Raise ValueError if an option was given that files or families of cases leave without effect."""
    unused: tuple[str, ...] = ("height", "width", "density", "styles")
    if config.files:
        source, cure = "files", "the maps are those of the files"
    elif config.families:
        source, cure = "families", "change the [[families]] of a file of settings and give it with --config"
        unused += ("num_agents", "task")
    else:
        return
    for name in unused:
        if getattr(config, name) != getattr(defaults, name):
            raise ValueError(f"--{name.replace('_', '-')} has no effect on a training with {source}: {cure}")


def main(arguments: Sequence[str] | None = None, *, prog: str = PROG) -> None:
    """Run the command."""
    run_command(partial(parse, prog=prog), _start, arguments)


def _start(command: Command) -> None:
    """Refuse what can be refused without torch, then join the other processes and train."""
    name = command.recipe if command.file is None else command.file.stem
    config, folder = command.config, command.run or Path("runs", name)
    cpu_threads(config.threads)
    if int(os.environ.get("RANK", "0")) == 0:
        if is_finished(folder, config):
            _show_finished(folder, config)
            return
        check_run(folder, config)
    from gnn_policy.processes import join_processes

    with join_processes() as process:
        _train(config, folder, Console(quiet=process.rank > 0), process)


def _show_finished(folder: Path, config: TrainConfig) -> None:
    from gnn_policy.evaluation_tables import lifelong_table, success_table

    console, settings = Console(), settings_of(config, (), default_executions(config.execution), "test")
    shown = tables_of(config, ())
    for name, result in read_tables(folder / RESULTS).items():
        show = lifelong_table if shown[name].tasks == {"lifelong"} else success_table
        console.print(show(table_title(name, settings), result))
    console.print(
        f"{folder} holds a finished run: choose another folder with --run to train again",
        highlight=False,
        soft_wrap=True,
    )


def _train(config: TrainConfig, folder: Path, console: Console, process: Process) -> None:
    from gnn_policy.command_line import on_device
    from gnn_policy.evaluation_tables import evaluate_and_report
    from gnn_policy.progress import TrainingProgress
    from gnn_policy.training import Training

    progress = TrainingProgress(config.rounds, console)
    training = Training(config, folder, progress, process)
    console.print(f"run folder: {folder}", highlight=False)
    if training.history:
        console.print(f"resuming after round {len(training.history)} of {config.rounds}", highlight=False)
    with training.lock:
        try:
            with progress:
                training.run()
        except KeyboardInterrupt:
            console.print(f"stopped; the same command resumes after round {len(training.history)}", highlight=False)
            raise SystemExit(130) from None
        if process.rank > 0:
            return
        # The command line, which the run's settings agree with, has asked for its parts.
        policy = checkpoint.load(folder, plugins=tuple(config.policy.plugins.values()))
        device = "cpu" if config.cluster is not None else config.device
        evaluate_and_report(
            on_device(policy, device), config, folder, console, threads=training.threads, cluster=config.cluster
        )
    console.print(f"learning curve: {folder / 'learning_curve.png'}", highlight=False)
    console.print(f"policy: {folder / 'best.safetensors'}", highlight=False)


if __name__ == "__main__":
    main()
