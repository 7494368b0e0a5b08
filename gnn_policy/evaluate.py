"""`python -m gnn_policy.evaluate POLICY`: evaluate any policy on held-out maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from gnn_policy import checkpoint
from gnn_policy.cases import Task
from gnn_policy.command_line import parse_options, run_command
from gnn_policy.cores import cpu_threads
from gnn_policy.execution import Execution
from gnn_policy.results_json import default_executions, refuse_other_settings, settings_of
from mapf_env.generation import MapStyle

PROG = "python -m gnn_policy.evaluate"


@dataclass(frozen=True)
class Command:
    """Evaluate a policy next to the expert and baselines without learning, on the same held-out cases.

    Settings that are not given are those of the policy's training. Results of other settings are never overwritten.
    """

    policy: Annotated[
        Path, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY", help_behavior_hint="(default: general)")
    ] = checkpoint.PACKAGED
    """A run folder of training, a .safetensors file, or the name of a policy that comes with the package."""
    num_agents: tuple[int, ...] = ()
    """Team sizes N, one table for each."""
    executions: tuple[str, ...] | None = None
    """Executions of the policy, one row in the table for each. An execution is words joined by commas: "argmax",
    "sampled", "stuck" (stuck robots and their neighbours sample) or "fallback" (stuck robots follow their shortest
    path); a temperature for the latter three; the shield "idle", "pibt" or "pibt_swap"; the communication range
    "fixed" or "connected" (the radius grows until the team is connected); the edge weights "binary" or "distance".
    Anything left out is as in the policy's own execution. If not given: argmax, stuck and sampled, or fallback and
    argmax for a policy whose own execution is "fallback"."""
    split: Literal["validation", "test"] = "test"
    """Which maps: "validation" to choose an execution, "test" to report it."""
    maps: int | None = None
    """Number of maps."""
    cases_per_map: int | None = None
    """Cases on each of them."""
    height: int | None = None
    """Rows of a map."""
    width: int | None = None
    """Columns of a map."""
    density: float | None = None
    """Share of obstacles."""
    styles: tuple[MapStyle, ...] | None = None
    """Obstacles: independent "cells", short "walls", or "maze", "room", "warehouse" and "empty", which ignore the
    density; the maps take turns among the styles."""
    files: tuple[str, ...] = ()
    """Your own maps (.map, .yaml), scenarios (.scen) and sets of instances (.json), or folders of them, instead of
    random maps; all their cases are played."""
    task: Task | None = None
    """"one_shot", or "lifelong": a robot that arrives gets a new goal, and the tables show throughput."""
    steps: int = 256
    """Steps of a lifelong episode."""
    data_seed: int | None = None
    """Random seed for the maps and cases; any seed gives maps that training with it does not use."""
    w: float | None = None
    """Suboptimality bound of the expert, whose makespans set T_max and whose flowtimes are the reference."""
    timeout: float | None = None
    """T_max in makespans of the expert's solution."""
    seed: int | None = None
    """Random seed for sampling and for the shield's tie-breaking."""
    failures: int = 0
    """Number of cases of the first execution to replay next to the expert's solutions, in failures.html: the worst of
    each kind of failure, then the next worst."""
    out: Path | None = None
    """Folder for results.json and pictures; if not given, evaluation/ in the run folder or next to the file, and
    evaluation/NAME in the working folder for a policy that comes with the package."""
    threads: int = 0
    """CPU threads; 0 takes as many as affinity, cgroup quota and OMP_NUM_THREADS allow."""
    device: str = "auto"
    """Device of the network: "cpu", "cuda", "mps", or "auto" for the fastest one available."""
    cluster: str | None = None
    """Address of a Ray cluster that solves and plays the cases on its CPUs: "auto" for the cluster of this machine, or
    "local" for as many processes here as there are threads. Needs the extra `cluster`."""
    plugins: tuple[str, ...] = ()
    """Encoders and graph layers of your own, as "module:Class", that the policy's file may import."""
    debug: bool = False
    """Print the traceback of an error."""


def parse(arguments: Sequence[str], prog: str = PROG) -> Command:
    """Return the command that the arguments ask for."""
    return parse_options(Command, arguments, prog=prog)


def main(arguments: Sequence[str] | None = None, *, prog: str = PROG) -> None:
    """Run the command."""
    run_command(partial(parse, prog=prog), _evaluate, arguments)


def _evaluate(command: Command) -> None:
    """Check everything that needs no torch, then evaluate."""
    trained = checkpoint.trained_with(command.policy)
    names = ("height", "width", "density", "styles", "data_seed", "w", "timeout", "seed")
    given = {name: value for name in names if (value := getattr(command, name)) is not None}
    if given.keys() & {"height", "width", "density", "styles"}:
        given |= {"families": (), "files": ()}
    prefix = "validation_" if command.split == "validation" else ""
    if command.maps is not None:
        given[f"{command.split}_maps"] = command.maps
    if command.cases_per_map is not None:
        given[f"{prefix}cases_per_map"] = command.cases_per_map
    if command.files:
        given |= {"families": (), "files": command.files}
    if command.files and len(command.num_agents) > 1:
        raise ValueError("files have their own teams: give one --num-agents at most, for maps without instances")
    if command.task is not None:
        families = given.get("families", trained.families)
        given |= {"task": command.task, "families": tuple(replace(each, task=command.task) for each in families)}
    config = replace(trained, **given)
    execution = checkpoint.executed_as(command.policy)
    executions = default_executions(execution)
    if command.executions is not None:
        executions = [Execution.parse(row, execution) for row in command.executions]
    threads = cpu_threads(command.threads)
    folder = command.out or _home(command.policy)
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder} is not a folder: give another one with --out")
    settings = settings_of(config, command.num_agents, executions, command.split)
    refuse_other_settings(folder / "results.json", settings, "--out")

    import torch

    from gnn_policy.command_line import on_device
    from gnn_policy.evaluation_tables import evaluate_and_report

    torch.set_num_threads(threads)
    device = "cpu" if command.cluster is not None and command.device == "auto" else command.device
    policy = on_device(checkpoint.load(command.policy, plugins=command.plugins), device)
    folder.mkdir(parents=True, exist_ok=True)
    evaluate_and_report(
        policy,
        config,
        folder,
        Console(),
        num_agents=command.num_agents,
        executions=executions,
        split=command.split,
        whole=bool(command.files),
        steps=command.steps,
        threads=threads,
        failures=command.failures,
        cluster=command.cluster,
    )


def _home(policy: Path) -> Path:
    file = checkpoint.file_of(policy)
    return Path("evaluation", file.stem) if file.parent == checkpoint.WEIGHTS else file.parent / "evaluation"


if __name__ == "__main__":
    main()
