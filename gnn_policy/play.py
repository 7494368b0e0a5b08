"""`python -m gnn_policy.play FILE`: run a policy on your own map and write a page that replays it."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from gnn_policy import checkpoint
from gnn_policy.cases import Task
from gnn_policy.command_line import parse_options, run_command
from gnn_policy.cores import cpu_threads
from gnn_policy.execution import Execution
from mapf_env import EnvConfig, Instance, Scene, distances, replay_scenes
from mapf_env.arguments import integer
from mapf_env.files import require_outputs, unused
from mapf_env.problem_file import PROBLEM_SUFFIXES, load_problem

if TYPE_CHECKING:
    from gnn_policy.rollout import Rollouts

PROG = "python -m gnn_policy.play"
PATIENCE = 4
"""T_max in lengths of the longest distance from a start to its goal."""


@dataclass(frozen=True)
class Command:
    """Play a policy on your own map and write a page that replays it in any browser.

    The exit status is 0 if all robots of every team reach their goals, 1 if a team fails, and 2 after an error.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """A map (.map) in the MovingAI format, a drawing (.txt) with # for obstacles and . for free cells, a scenario
    (.scen) next to its map, a set of instances (.json), maps of POGEMA (.yaml), or a folder of these without
    drawings."""
    agents: int | None = None
    """Number of robots: placed at random on a map, or the first ones of a file with robots (all of them if not
    given)."""
    policy: Annotated[Path, tyro.conf.arg(help_behavior_hint="(default: general)")] = checkpoint.PACKAGED
    """A run folder of training, a .safetensors file, or the name of a policy that comes with the package."""
    map: Path | None = None
    """The map of a scenario, if it is not next to it."""
    index: int | None = None
    """Which instance or map of a file, from 0; the first if not given."""
    execution: str | None = None
    """Execution of the policy, written as for `--executions` of `python -m gnn_policy.evaluate`; if not given, the
    execution saved with the policy."""
    task: Task = "one_shot"
    """"lifelong": a robot that arrives gets a new goal."""
    max_steps: int | None = None
    """T_max; if not given, four times the longest distance from a start to its goal."""
    seed: int = 0
    """Random seed for placing robots, sampling moves and the shield's tie-breaking."""
    out: Path | None = None
    """The page to write; an existing file is replaced. If not given, the name of FILE with .html in the working folder,
    with a number if that file exists."""
    threads: int = 0
    """CPU threads; 0 takes as many as affinity, cgroup quota and OMP_NUM_THREADS allow."""
    device: str = "auto"
    """Device of the network: "cpu", "cuda", "mps", or "auto" for the fastest one available."""
    plugins: tuple[str, ...] = ()
    """Encoders and graph layers of your own, as "module:Class", that the policy's file may import."""
    debug: bool = False
    """Print the traceback of an error."""


def parse(arguments: Sequence[str], prog: str = PROG) -> Command:
    """Return the command that the arguments ask for."""
    return parse_options(Command, arguments, prog=prog)


def main(arguments: Sequence[str] | None = None, *, prog: str = PROG) -> int:
    """Run the command; returns 0 if every team has reached its goals (always in lifelong tasks), else 1."""
    return run_command(partial(parse, prog=prog), _play, arguments)


def _play(command: Command) -> int:
    """Check everything that needs no torch, then play."""
    threads = cpu_threads(command.threads)
    execution = checkpoint.executed_as(command.policy)
    if command.execution is not None:
        execution = Execution.parse(command.execution, execution)
    problems = _problems(command)
    if command.max_steps is None:
        steps = [_patience(instance) for instance in problems.values()]
    else:
        steps = [integer(command.max_steps, "max_steps", 1)] * len(problems)
    out = command.out or unused(Path(f"{command.file.stem}.html"))
    require_outputs([out], [command.file, command.map])

    import torch

    from gnn_policy.command_line import on_device
    from gnn_policy.rollout import rollout

    torch.set_num_threads(threads)
    policy = on_device(checkpoint.load(command.policy, plugins=command.plugins), command.device)
    console = Console()
    before = time.perf_counter()
    with console.status(f"{len(problems)} teams, {max(steps)} steps at most"):
        played = rollout(
            policy,
            list(problems.values()),
            task=command.task,
            execution=execution,
            seed=command.seed,
            max_steps=steps,
        )
    seconds = time.perf_counter() - before
    outcomes = [_outcome(command.task, played, number) for number in range(len(problems))]
    scenes = [
        Scene(
            f"{name}: {outcome}" if len(problems) > 1 else "",
            instance,
            {"": solution},
            {"": goals} if command.task == "lifelong" else {},
        )
        for name, outcome, instance, solution, goals in zip(
            problems, outcomes, played.instances, played.solutions, played.goals, strict=True
        )
    ]
    title = outcomes[0] if len(problems) == 1 else f"{len(problems)} teams of {command.file}"
    replay_scenes(scenes, out, title=title, config=EnvConfig(**execution.env_settings(policy.config)))
    for scene in scenes if len(problems) > 1 else []:
        console.print(scene.title, highlight=False)
    console.print(f"{title} ({seconds:.1f} s)", highlight=False)
    console.print(f"replay: {out}", highlight=False, soft_wrap=True)
    return 0 if command.task == "lifelong" or played.success.all() else 1


def _problems(command: Command) -> dict[str, Instance]:
    """Return the instance of the file, or of each file of a folder, by the file's name.

    Raises:
        ValueError: If a file is damaged, an option is missing or not for it, or a folder has nothing to play.
        OSError: If a file cannot be read.
    """
    if not command.file.is_dir():
        files = [command.file]
    elif command.map is not None or command.index is not None:
        raise ValueError(f"--map and --index go with one file, and {command.file} is a folder")
    else:  # without --agents there are no robots to place on maps
        kinds = PROBLEM_SUFFIXES if command.agents is not None else {".scen", ".json"}
        files = sorted(each for each in command.file.iterdir() if each.suffix.lower() in kinds)
        if not files:
            raise ValueError(
                f"the folder {command.file} has no scenarios (.scen) and no sets of instances (.json): "
                "for maps give --agents"
            )
    return {
        file.name: load_problem(file, agents=command.agents, map=command.map, index=command.index, seed=command.seed)
        for file in files
    }


def _outcome(task: Task, played: Rollouts, number: int) -> str:
    from gnn_policy.failures import failure

    instance, solution = played.instances[number], played.solutions[number]
    size = f"{instance.num_agents} robots on {instance.grid.shape[0]} x {instance.grid.shape[1]} cells"
    steps = len(solution.paths) - 1
    if task == "lifelong":
        return f"{size}: {played.throughput[number]:.2f} arrivals per step over {steps} steps"
    on_goal = int((solution.paths[-1] == instance.goals).all(axis=1).sum())
    kind = failure(instance, solution)
    end = f"flowtime {solution.sum_of_costs}" if kind is None else f"failed: {kind}"
    return f"{size}: {on_goal} on goal after {steps} steps, {end}"


def _patience(instance: Instance) -> int:
    ways = distances(instance.grid, instance.goals)[
        range(instance.num_agents), instance.starts[:, 0], instance.starts[:, 1]
    ]
    return max(PATIENCE * int(ways.max()), 1)


if __name__ == "__main__":
    sys.exit(main())
