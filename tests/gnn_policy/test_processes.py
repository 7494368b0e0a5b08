"""Two processes that train one policy, as torchrun starts them on one machine, or on two that are agents here."""

import os
import socket
import subprocess
import sys

import pytest
import torch

from gnn_policy.demonstrations import Demonstrations
from gnn_policy.processes import Process
from small_training import CONFIG

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="gloo and POSIX signals")

WORKER = """
import os, signal, sys
from pathlib import Path
import torch
from rich.console import Console
from gnn_policy import training
from gnn_policy.config import TrainConfig
from gnn_policy.progress import TrainingProgress
from gnn_policy.processes import join_processes

folder, victim, when = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
config = TrainConfig.load(Path(sys.argv[4]))

class Progress(TrainingProgress):
    def finished(self, row):
        super().finished(row)
        report = {name: t.clone() for name, t in run.policy.state_dict().items()}
        report["demonstrations"] = torch.tensor([len(s) for s in run._shards])
        report["loss"] = torch.tensor([row.loss, row.accuracy])
        torch.save(report, folder.parent / f"{folder.name}-{process.rank}-{row.round}.pt")
    def due(self):
        return True  # every update, however fast the machine
    def fitted(self, number, update, *rest):
        if process.rank == victim and number == when and update == 2:
            if process.local_count == 1:
                os.kill(os.getppid(), signal.SIGKILL)  # the agent: the whole machine is gone
            os.kill(os.getpid(), signal.SIGKILL)

with join_processes() as process:
    run = training.Training(config, folder, Progress(config.rounds, Console(quiet=True)), process)
    run.run()
tasks = Path("/proc/self/task")
threads = sorted(each.joinpath("comm").read_text() for each in tasks.iterdir()) if tasks.exists() else []
(folder.parent / f"{folder.name}-{process.rank}-threads").write_text("".join(threads))
"""


def launch(tmp_path, name, *, machines=1, victim=-1, when=-1, config=CONFIG):
    """Run two processes, on one machine or one on each of two; return the exit status and errors of each agent."""
    script = tmp_path / "worker.py"
    script.write_text(WORKER)
    config.save(tmp_path / "settings.toml")
    if machines == 1:
        placed = [["--standalone", "--nproc-per-node", "2"]]
    else:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        master = ["--nnodes", "2", "--nproc-per-node", "1", "--master-addr", "127.0.0.1", "--master-port", str(port)]
        placed = [[*master, "--node-rank", str(rank), "--local-addr", "127.0.0.1"] for rank in range(2)]
    arguments = [str(tmp_path / name), str(victim), str(when), str(tmp_path / "settings.toml")]
    loopback = "lo0" if sys.platform == "darwin" else "lo"
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": loopback}
    agents = [
        subprocess.Popen(
            [sys.executable, "-m", "torch.distributed.run", *where, str(script), *arguments],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for where in placed
    ]
    try:
        errors = [agent.communicate(timeout=300)[1] for agent in agents]
    finally:
        for agent in agents:
            agent.kill()
    return [agent.returncode for agent in agents], "".join(errors)


def report(tmp_path, name, rank, number):
    return torch.load(tmp_path / f"{name}-{rank}-{number}.pt", weights_only=True)


def assert_equal(one, two):
    assert one.keys() == two.keys()
    for name, tensor in one.items():
        assert torch.equal(tensor, two[name]), name


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    home = tmp_path_factory.mktemp("process")
    ended, errors = launch(home, "whole")
    assert ended == [0], errors
    return home


def test_both_processes_hold_the_same_policy_and_data_after_every_round(whole):
    for number in range(CONFIG.rounds):
        assert_equal(report(whole, "whole", 0, number), report(whole, "whole", 1, number))
    assert not torch.equal(report(whole, "whole", 0, 0)["head.weight"], report(whole, "whole", 0, 2)["head.weight"])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_the_threads_of_the_group_end_with_it(whole):
    """One that is left may ask for Python while the process ends, which aborts the process."""
    for rank in range(2):
        assert "gloo" not in (whole / f"whole-{rank}-threads").read_text()


def test_a_round_has_as_many_states_as_that_of_one_process_and_its_halves_differ(whole):
    for number, steps in enumerate((64, 32, 32)):
        states = Demonstrations.load(whole / "whole" / "demonstrations" / f"round_{number:04d}.safetensors")
        assert len(states) == steps
        half = steps // 2
        robots = half * CONFIG.num_agents
        assert states.states.positions[:robots].tobytes() != states.states.positions[robots:].tobytes()


def test_the_state_and_the_best_policy_are_those_of_the_team(whole):
    state = torch.load(whole / "whole" / "state.pt", weights_only=True)
    assert state["processes"] == 2
    last = report(whole, "whole", 1, CONFIG.rounds - 1)
    assert all(torch.equal(tensor, last[name]) for name, tensor in state["policy"].items())
    assert state["history"][-1]["samples"] == 3 * 3 * CONFIG.batch_size * CONFIG.num_agents


@pytest.mark.parametrize(("machines", "victim", "when"), [(1, 0, 1), (2, 1, 2)])
def test_a_run_with_a_killed_process_or_machine_resumes_and_ends_the_same(whole, tmp_path, machines, victim, when):
    ended, _ = launch(tmp_path, "torn", machines=machines, victim=victim, when=when)
    assert len(ended) == machines
    assert 0 not in ended
    assert (tmp_path / "torn" / "state.pt").exists()
    assert not (tmp_path / f"torn-0-{when}.pt").exists()
    ended, errors = launch(tmp_path, "torn", machines=machines)
    assert ended == [0] * machines, errors
    for rank in range(2):
        assert_equal(report(tmp_path, "torn", rank, 2), report(whole, "whole", rank, 2))
    states = [torch.load(home / "state.pt", weights_only=True) for home in (tmp_path / "torn", whole / "whole")]
    assert states[0]["scheduler"] == states[1]["scheduler"]
    for one, two in zip(*(state["optimizer"]["state"].values() for state in states), strict=True):
        assert_equal(one, two)


def test_uneven_shares_are_refused():
    assert Process(1, 2).share("batch_size", 8) == 4
    with pytest.raises(ValueError, match="batch_size must be a multiple of the 3 processes, got 8"):
        Process(0, 3).share("batch_size", 8)
