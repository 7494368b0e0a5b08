"""Plays 10^6 steps and prints the memory of the process meanwhile; exits with 1 if it grows."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import numpy as np

from mapf_env import BatchedEnv, parallel_env

SHARES = 10
ALLOWED = 1.0
"""MiB that the process may grow after the first share of the steps: noise of the allocator."""


def resident() -> float:
    """MiB of memory that the process holds."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("/proc/self/status tells no VmRSS: run this on Linux")


def batched(steps: int) -> Callable[[], None]:
    """64 teams at once; a share of `steps` steps of a team at each call."""
    env, generator = BatchedEnv(64, num_agents=8, max_cycles=50), np.random.default_rng(0)
    out = env.buffers()
    env.reset(seed=0, out=out)

    def play() -> None:
        for _ in range(steps // 64 // SHARES):
            step = env.step(generator.integers(0, 5, (64, 8)))
            ended = step.terminated | step.truncated
            if ended.any():
                env.reset(mask=ended, out=out)

    return play


def pettingzoo(steps: int) -> Callable[[], None]:
    """One team by dictionaries; a share of `steps` steps at each call."""
    env, generator = parallel_env(num_agents=8, max_cycles=50), np.random.default_rng(0)
    joint = [dict(zip(env.possible_agents, each, strict=True)) for each in generator.integers(0, 5, (997, 8)).tolist()]
    endless = cycle(joint)  # lists of 10^5 random actions would make the process grow by themselves
    env.reset(seed=0)

    def play() -> None:
        for _ in range(steps // SHARES):
            if not env.agents:
                env.reset()
            env.step(next(endless))

    return play


def main() -> None:
    """Play both and check the growth of memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000, help="steps of a team, at least 640 (default: 10^6)")
    steps = parser.parse_args().steps
    if steps < 64 * SHARES:
        parser.error(f"--steps must be at least {64 * SHARES}, got {steps}")
    grown = False
    for name, make in (("batched", batched), ("pettingzoo", pettingzoo)):
        play, held = make(steps), []
        for _ in range(SHARES):
            play()
            held.append(resident())
        print(f"{name}, {steps:,} steps, MiB: " + " ".join(f"{each:.1f}" for each in held))
        grown |= held[-1] - held[0] > ALLOWED
    sys.exit("the process has grown" if grown else 0)


if __name__ == "__main__":
    main()
