"""The time of training by its parts, and its speed with other encoders, precisions, threads and processes.

    python benchmarks/training.py round       the parts of a round, one thread
    python benchmarks/training.py steps       gradient steps with each encoder, convolution and precision, one thread
    python benchmarks/training.py processes   gradient steps with threads, and with processes under torchrun
    python benchmarks/training.py company     rounds next to zero, one and two busy processes, and on one thread

"Overhead" is the part of a round outside network, expert and environment: batches rebuilt from
positions, TorchRL's collector and loss module, our own loops. The network's parts are timed by themselves before and
after the rounds, on batches like theirs. Run nothing else on the machine meanwhile.
"""

from __future__ import annotations

import csv
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode
from rich.console import Console
from torch import nn
from torch.nn.functional import cross_entropy

from gnn_policy.acting import tensors
from gnn_policy.config import TrainConfig
from gnn_policy.convolution import StridedConvolution
from gnn_policy.network import ENCODERS, DecentralizedPolicy
from gnn_policy.precision import Precision, autocast
from gnn_policy.progress import TrainingProgress
from gnn_policy.recipes import RECIPES
from gnn_policy.training import Training
from mapf_env import Bag, BatchedEnv

ROUNDS = 5
UPDATES = 200
CONFIG = replace(
    RECIPES["quick"],
    rounds=ROUNDS + 1,
    train_maps=500,
    validation_maps=1,
    validation_cases_per_map=1,
    validate_every=ROUNDS + 1,
    threads=1,
)
CPU = torch.device("cpu")


def median_seconds(action: Callable[[], object], repeats: int = 5, times: int = 20) -> float:
    """Return the seconds of one call, after a warm-up."""
    action()
    taken = []
    for _ in range(repeats):
        began = time.perf_counter()
        for _ in range(times):
            action()
        taken.append((time.perf_counter() - began) / times)
    return float(np.median(taken))


def environment(config: TrainConfig, teams: int) -> BatchedEnv:
    """Teams at their starts, which perceive what the policy reads."""
    env = BatchedEnv(
        teams,
        num_agents=config.num_agents,
        dtype="uint8",
        autoreset=AutoresetMode.NEXT_STEP,
        **config.policy.senses(),
    )
    env.reset(0, observe=False)
    return env


def perceived(config: TrainConfig, teams: int) -> Bag:
    """Return the observations of some teams at their starts, as tensors."""
    return tensors(environment(config, teams).bag())


def gradient_step(policy: DecentralizedPolicy, config: TrainConfig) -> Callable[[], None]:
    """A step of the network and the optimiser on one batch that is ready."""
    bag = perceived(config, config.batch_size)
    labels = torch.randint(5, (len(bag.fov),), generator=torch.Generator().manual_seed(0))
    optimizer = torch.optim.Adam(policy.parameters(), config.lr, weight_decay=config.weight_decay, fused=True)
    policy.train()

    def step() -> None:
        with autocast(config.precision, CPU):
            logits = policy(bag)
        optimizer.zero_grad()
        cross_entropy(logits.float(), labels).backward()
        optimizer.step()

    return step


def forward_pass(policy: DecentralizedPolicy, config: TrainConfig) -> Callable[[], None]:
    """The network's part of a step of all teams of a rollout."""
    bag = perceived(config, config.rollout_teams)
    policy.eval()

    def play() -> None:
        with torch.inference_mode(), autocast(config.precision, CPU):
            policy(bag)

    return play


def environment_step(config: TrainConfig) -> Callable[[], None]:
    """The environment's part of it."""
    teams = environment(config, config.rollout_teams)
    actions = np.random.default_rng(0).integers(0, 5, (config.rollout_teams, config.num_agents))

    def step() -> None:
        teams.step(actions, observe=False)
        teams.bag()

    return step


def parts_of_a_round() -> None:
    """One line for each part of a round of DAgger: seconds, and its share of the bare gradient steps."""
    config = CONFIG
    torch.set_num_threads(1)
    updates, plays = config.updates_per_round or 0, config.dagger_steps / config.rollout_teams
    policy = DecentralizedPolicy(config.policy)

    def network() -> tuple[float, float, float]:
        return (
            updates * median_seconds(gradient_step(policy, config)),
            plays * median_seconds(forward_pass(policy, config)),
            plays * median_seconds(environment_step(config)),
        )

    before = network()
    with tempfile.TemporaryDirectory() as folder:
        training = Training(config, Path(folder), TrainingProgress(config.rounds, Console(quiet=True)))
        training.run()
        rounds = training.history[1:]  # the first has no rollouts of the policy
    steps, forward, environment = np.mean([before, network()], axis=0)
    fit, collect, expert = (
        float(np.median([getattr(row, name) for row in rounds]))
        for name in ("fit_seconds", "collect_seconds", "expert_seconds")
    )
    rest = (fit - steps) + (collect - expert - forward - environment)
    states = updates * config.batch_size * config.num_agents
    print(f"{states:,} robot states in {updates} gradient steps of {config.num_agents} robots, one thread")
    for name, seconds in (
        ("network, gradient steps", steps),
        ("network, rollouts", forward),
        ("expert", expert),
        ("environment", environment),
        ("batches and loss module", fit - steps),
        ("collector", collect - expert - forward - environment),
        ("overhead (the last two)", rest),
        ("round", fit + collect),
    ):
        print(f"{name:26} {seconds:7.2f} s  {seconds / steps:6.1%} of the gradient steps")
    print(f"{states / (fit + collect):,.0f} robot states per second, all in")


def speed_of_steps() -> None:
    """Robot states per second of bare gradient steps."""
    torch.set_num_threads(1)
    precisions: tuple[Precision, ...] = ("float32", "bfloat16")
    for encoder in ENCODERS:
        for library in (False, True) if encoder == "lean" else (True,):
            for precision in precisions:
                config = replace(CONFIG, policy=replace(CONFIG.policy, encoder=encoder), precision=precision)
                policy = DecentralizedPolicy(config.policy)
                if library and encoder == "lean":
                    with_library_convolutions(policy)
                rate = config.batch_size * config.num_agents / median_seconds(gradient_step(policy, config))
                kind = "the library's convolutions" if library else "products of matrices"
                print(f"{encoder:9} {kind:27} {precision:9} {rate:9,.0f} robot states per second", flush=True)


def with_library_convolutions(policy: DecentralizedPolicy) -> None:
    """Replace our convolutions by PyTorch's."""
    for name, module in list(policy.encoder.named_children()):
        if isinstance(module, StridedConvolution):
            channels, width = module.weight.shape[1], module.weight.shape[0]
            setattr(policy.encoder, name, nn.Conv2d(channels, width, 3, 2, 1).to(memory_format=torch.channels_last))


def fitted(run: Path, processes: int, threads: int) -> float:
    """Robot states per second in the gradient steps of the quick recipe's batch."""
    settings = f"""
        --rounds 1 --updates-per-round {UPDATES} --train-maps 100 --validation-maps 1 --validation-cases-per-map 1
        --test-maps 1 --cases-per-map 1 --demonstration-steps 8192 --dagger-every 0
    """
    start = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes), "-m"]
    command = [*(start if processes > 1 else ["-m"]), "gnn_policy.train", *(["--"] if processes > 1 else [])]
    done = subprocess.run(
        [sys.executable, *command, "--run", str(run), "--threads", str(threads), *settings.split()],
        env={**os.environ, "OMP_NUM_THREADS": str(threads)},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    with (run / "metrics.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    return int(row["samples"]) / float(row["fit_seconds"])


def threads_and_processes() -> None:
    """A line for each way to use two cores."""
    with tempfile.TemporaryDirectory() as folder:
        for processes, threads in ((1, 1), (1, 2), (2, 1)):
            rate = fitted(Path(folder, f"{processes}-{threads}"), processes, threads)
            print(f"{processes} processes, {threads} threads each: {rate:,.0f} robot states per second", flush=True)


def seconds_of_a_round(run: Path, *options: str) -> float:
    """Median time of the rounds after the first in a short training with the quick recipe's batches."""
    settings = """
        --rounds 5 --updates-per-round 200 --train-maps 200 --validation-maps 1 --validation-cases-per-map 1
        --test-maps 1 --cases-per-map 1 --demonstration-steps 8192 --dagger-steps 8192 --validate-every 5
    """
    command = [sys.executable, "-m", "gnn_policy.train", "--run", str(run), *settings.split(), *options]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    with (run / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))[1:]
    return float(np.median([float(row["collect_seconds"]) + float(row["fit_seconds"]) for row in rows]))


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Run `count` processes that compute all the time, one thread each."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def company() -> None:
    """A line for each number of busy processes next to training, and one for training on one thread."""
    with tempfile.TemporaryDirectory() as folder:
        rest = math.nan
        for busy, options in ((0, ()), (1, ()), (2, ()), (0, ("--threads", "1"))):
            with busy_processes(busy):
                seconds = seconds_of_a_round(Path(folder, f"{busy}{''.join(options)}"), *options)
            rest = seconds if math.isnan(rest) else rest
            how = f"{busy} busy processes, {'one thread' if options else 'default threads'}"
            print(f"{how:34} {seconds:6.2f} s a round  {seconds / rest:5.2f} x", flush=True)


TABLES = {
    "round": parts_of_a_round,
    "steps": speed_of_steps,
    "processes": threads_and_processes,
    "company": company,
}


def main(table: tyro.conf.Positional[Literal["round", "steps", "processes", "company"]], /) -> None:
    """Print one of the tables."""
    TABLES[table]()


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
