"""The general policy on validation maps: its execution is chosen here, never on POGEMA's benchmark.

    python benchmarks/generalist.py runs/general
    python benchmarks/generalist.py runs/general --executions stuck,0.5,pibt sampled,0.5,pibt --sizes 32 64

The maps are random, with the statistics of POGEMA's sets "random" and "mazes": 17 to 21 cells per side, 128 steps. A
policy never trains on them, for they belong to the validation split. SoC is the sum of the last arrivals; a robot that
is off its goal at the end counts all steps. Greedy robots under the PIBT shields are the baselines.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gnn_policy import checkpoint
from gnn_policy.baselines import GreedyActor
from gnn_policy.cases import Family, make_cases
from gnn_policy.command_line import run_command
from gnn_policy.execution import Execution
from gnn_policy.metrics import Estimate
from gnn_policy.rollout import Actor, PolicyActor, rollout
from mapf_env import Instance

STEPS = 128
SEED = 1
"""The seed of maps, cases and draws; the validation maps of training have a different one."""
SETS = {
    "random": [Family(height=(17, 21), width=(17, 21), density=(0.2, 0.2))],
    "mazes": [
        Family(
            style="walls",
            height=(side, side),
            width=(side, side),
            density=(0.22, 0.37),
            segments=(4, 4),
            straight=(0.5, 0.5),
            ring=True,
        )
        for side in (17, 19, 21)
    ],
}


@dataclass(frozen=True)
class Options:
    """Play a policy on validation maps and print a table."""

    policy: Annotated[str, tyro.conf.Positional]
    """A run folder, a .safetensors file, or the name of a policy of the package."""
    executions: tuple[str, ...] = ()
    """Executions of the policy, as in gnn_policy.evaluate; the policy's own if not given."""
    sets: tuple[str, ...] = tuple(SETS)
    """Kinds of maps."""
    sizes: tuple[int, ...] = (16, 32, 48, 64)
    """Team sizes."""
    cases: int = 64
    """Cases for each kind of maps and team size, each on a map of its own."""


def instances_of(name: str, num_agents: int, cases: int) -> list[Instance]:
    """The cases of a set: the same maps for every team size."""
    families = [replace(each, num_agents=(num_agents, num_agents)) for each in SETS[name]]
    return make_cases("validation", seed=SEED, maps=cases, cases_per_map=1, families=families).instances


def main(options: Options) -> None:
    """Print success, ISR, SoC and the time of a step of one team in the batch."""
    torch.set_num_threads(1)
    policy = checkpoint.load(options.policy).eval()
    executions = [Execution.parse(row, policy.execution) for row in options.executions] or [policy.execution]
    actors: dict[str, Actor] = {each.name: PolicyActor(policy, each) for each in executions}
    actors |= {"PIBT": GreedyActor(shield="pibt"), "PIBT with swap": GreedyActor(shield="pibt_swap")}
    table = Table("maps", "robots", "execution", "success", "ISR", "SoC", "ms per step", title=options.policy)
    for column in table.columns[1:]:
        column.justify = "right"
    jobs = [(name, size, row) for name in options.sets for size in options.sizes for row in actors]
    for name, size, row in track(jobs, console=Console(stderr=True)):
        instances = instances_of(name, size, options.cases)
        began = time.perf_counter()
        played = rollout(actors[row], instances, seed=SEED, max_steps=STEPS)
        seconds = time.perf_counter() - began
        success = Estimate.proportion(played.success)
        steps = sum(len(each.paths) - 1 for each in played.solutions)
        table.add_row(
            name,
            str(size),
            row,
            f"{success.mean:.3f} [{success.low:.3f}, {success.high:.3f}]",
            f"{played.on_goal.mean():.3f}",
            f"{np.mean(played.flowtime):.0f}",
            f"{1000 * seconds / steps:.2f}",
        )
    Console().print(table)


if __name__ == "__main__":
    run_command(lambda arguments: tyro.cli(Options, args=arguments, description=__doc__), main)
