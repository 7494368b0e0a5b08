"""Memory does not grow while environments play: what Python and malloc have handed out is counted, whatever the load.

`benchmarks/memory.py` plays 10^6 steps and looks at the memory of the whole process.
"""

import ctypes
import gc
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from mapf_env import BatchedEnv, joint_env, parallel_env

SETTINGS: dict[str, Any] = {"num_agents": 4, "height": 6, "width": 6, "fov_radius": 2, "max_cycles": 7}
OPTIONS: dict[str, Any] = {
    "extra_channels": ("cost_to_go", "other_goals", "previous_positions"),
    "comm_range": "connected",
    "message_loss": 0.1,
    "reward": "shaped",
}


class Heap(ctypes.Structure):
    """The structure that glibc's mallinfo2 returns."""

    _names = ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "used", "free", "keepcost")
    _fields_ = [(name, ctypes.c_size_t) for name in _names]


def handed_out() -> tuple[int, int]:
    """Python's blocks and malloc's bytes that are in use; 0 bytes where the C library does not tell."""
    gc.collect()
    tell = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if tell is None:
        return sys.getallocatedblocks(), 0
    tell.restype = Heap
    heap = tell()
    return sys.getallocatedblocks(), heap.used + heap.hblkhd


def assert_flat(play: Callable[[int], None], steps: int = 1500) -> None:
    """`play(steps)` leaves nothing behind: a byte a step would show, and a block at each reset, of which 200 happen."""
    play(500)
    blocks, used = handed_out()
    play(steps)
    more_blocks, more_used = handed_out()
    assert more_blocks - blocks < 150
    assert more_used - used < max(steps, 4096)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("options", [{}, OPTIONS, {"task": "lifelong", "shield": "pibt", **OPTIONS}])
def test_batches_with_resets(options: dict[str, Any], threads: int) -> None:
    env, generator = BatchedEnv(3, threads=threads, **SETTINGS, **options), np.random.default_rng(0)
    env.reset(seed=0)

    def play(steps: int) -> None:
        for _ in range(steps):
            step = env.step(generator.integers(0, 5, (3, 4)))
            ended = step.terminated | step.truncated
            if ended.any():
                env.reset(mask=ended)

    assert_flat(play)


def test_batches_that_reset_themselves() -> None:
    env, generator = BatchedEnv(3, autoreset=AutoresetMode.SAME_STEP, **SETTINGS), np.random.default_rng(0)
    env.reset(seed=0)

    def play(steps: int) -> None:
        for _ in range(steps):
            env.step(generator.integers(0, 5, (3, 4)))

    assert_flat(play)


@pytest.mark.parametrize("options", [{}, {"reuse_buffers": True}, {"shield": "pibt", "preferences": True}])
def test_pettingzoo_with_resets(options: dict[str, Any]) -> None:
    env = parallel_env(**SETTINGS, **options)
    env.reset(seed=0)
    for agent in env.possible_agents:
        env.action_space(agent).seed(0)

    def play(steps: int) -> None:
        for _ in range(steps):
            if not env.agents:
                env.reset()
            env.step({agent: env.action_space(agent).sample() for agent in env.agents})

    assert_flat(play)


def test_a_large_team_that_is_read_tile_by_tile() -> None:
    env, generator = BatchedEnv(1, num_agents=5000, height=230, width=230, max_cycles=10**6), np.random.default_rng(0)
    env.reset(0, observe=False)
    actions = generator.integers(0, 5, (4, 1, 5000))

    def play(steps: int) -> None:
        for step in range(steps):
            env.bag()
            env.step(actions[step % 4], observe=False)

    play(10)
    _, used = handed_out()
    play(40)
    assert handed_out()[1] - used < 5000


def test_the_joint_view() -> None:
    env = joint_env(**SETTINGS)
    env.reset(seed=0)

    def play(steps: int) -> None:
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()

    assert_flat(play)
