"""Ctrl-C stops every running solver at once."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

import experts
from mapf_env import Instance, random_instance

LONG = 600.0  # seconds; a call that Ctrl-C does not stop fails its test by far
HARD = random_instance(num_agents=80, density=0.2, seed=0)
CORRIDOR = Instance(np.zeros((1, 5), bool), [(0, 0), (0, 4)], [(0, 4), (0, 0)])
QUEUE = Instance(  # the first two would have to change places in a corridor: LaCAM looks at all joint states
    np.zeros((1, 40), bool), [(0, cell) for cell in range(12)], [(0, cell) for cell in (1, 0, *range(2, 12))]
)
ecbs = partial(experts.solve_many, [HARD] * 3, w=1, time_limit=LONG, node_limit=10**9)


@pytest.mark.skipif(sys.platform == "win32", reason="os.kill ends the process there")
@pytest.mark.parametrize(
    "call",
    [
        pytest.param(partial(ecbs, threads=1), id="ecbs"),
        pytest.param(partial(ecbs, threads=2), id="ecbs, two threads"),
        pytest.param(partial(experts.lacam, QUEUE, time_limit=LONG, node_limit=10**9), id="lacam, searching"),
        pytest.param(partial(experts.lacam, HARD, w=1, time_limit=LONG), id="lacam, improving"),
        pytest.param(partial(experts.prioritised, CORRIDOR, max_orders=2**31 - 1, time_limit=LONG), id="prioritised"),
        pytest.param(partial(experts.pibt, CORRIDOR, max_steps=2**31 - 2), id="pibt"),
        pytest.param(partial(experts.relabel, HARD, HARD.starts[None], w=1, node_limit=10**9), id="relabel"),
    ],
)
def test_ctrl_c_stops_a_running_solver(call: Callable[[], object]) -> None:
    sent: list[float] = []

    def press() -> None:
        sent.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGINT)

    timer = threading.Timer(0.2, press)
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore Ctrl-C
    try:
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            call()
        assert sent, "the solver stopped before it was told to"
        assert time.perf_counter() - sent[0] < 2  # the load of the machine included
    finally:
        timer.cancel()  # where the call ended by itself
        timer.join()
        signal.signal(signal.SIGINT, inherited)
