"""Robots as processes that talk over zenoh: what they do together, and how they end."""

import json
import os
import secrets
import signal
import socket
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
import torch

import bags
import oracles
from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig, rollout, swarm
from gnn_policy.onnx_export import export
from gnn_policy.robot.exported import ExportedPolicy
from gnn_policy.robot.remote_world import WorldServer
from gnn_policy.robot.world import World
from gnn_policy.robot.zenoh_radio import open_session
from gnn_policy.swarm import Swarm, free_endpoint
from mapf_env import random_instance, save_instances

CASE = random_instance(height=6, width=6, density=0.1, num_agents=3, seed=4)
PATIENT = ["--round-seconds", "60", "--patience", "120"]
"""Deadlines that no machine is too slow for: a round ends when all have been heard."""


@pytest.fixture(scope="module")
def policy():
    torch.manual_seed(2)
    config = PolicyConfig(encoder="lean", features=16, fov_radius=2, taps=2, extra_channels=("cost_to_go",))
    policy = DecentralizedPolicy(config, Execution(actions="sampled", temperature=0.7))
    with torch.no_grad():
        policy(bags.random_bag(np.random.default_rng(0), [8, 8], config))
    bags.spread_preferences(policy.eval(), [CASE])
    return policy


@pytest.fixture(scope="module")
def folder(policy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    export(policy, folder)
    return folder


def play(folder, shielded_by, steps, during=lambda world, team: None, options=PATIENT, step_seconds=120.0):
    """Serve a world to processes; return it, the server and the robots' exit statuses."""
    exported, key, endpoint = ExportedPolicy(folder), secrets.token_bytes(32), free_endpoint()
    world = World(CASE, exported.config, exported.execution, shielded_by=shielded_by, seed=3, max_steps=steps)
    session = open_session(endpoint)
    try:
        server = WorldServer(session, world, key, exported.fingerprint, step_seconds)
        with Swarm(CASE.num_agents, folder, endpoint, key, options) as team:
            server.wait_for_robots(200, team.require_alive)
            server.run(lambda world: during(world, team))
    finally:
        session.close()
    return world, [process.returncode for process in team.processes]


def test_processes_walk_the_paths_of_rollout_and_end_with_the_world(policy, folder):
    world, statuses = play(folder, "world", 8)
    expected = rollout(policy, [CASE], seed=3, max_steps=8).solutions[0].paths
    assert np.array_equal(world.solution.paths, expected)
    assert statuses == [0, 0, 0]


def test_a_process_that_is_killed_is_an_obstacle_and_nothing_listens_beyond_this_machine(folder):
    listening = []

    def during(world, team):
        if world.step_number == 2:
            listening.extend(open_sockets([os.getpid(), *(process.pid for process in team.processes)]))
            team.processes[0].send_signal(signal.SIGKILL)
            team.processes[0].wait()

    options = ["--round-seconds", "0.2", "--patience", "120"]
    world, statuses = play(folder, "robots", 6, during, options, step_seconds=5.0)
    paths = world.solution.paths
    assert statuses == [-signal.SIGKILL, 0, 0]
    assert (paths[2:, 0] == paths[2, 0]).all()
    for before, after in pairwise(paths):
        assert not oracles.faults(CASE.grid, [*map(tuple, before.tolist())], [*map(tuple, after.tolist())])
    assert len(listening) >= 4
    assert set(listening) == {"127.0.0.1"}


def open_sockets(processes):
    """The addresses on which these processes listen, as the kernel lists them."""
    inodes = set()
    for process in processes:
        for name in os.listdir(f"/proc/{process}/fd"):
            try:
                target = os.readlink(f"/proc/{process}/fd/{name}")
            except FileNotFoundError:
                continue
            if target.startswith("socket:["):
                inodes.add(target[8:-1])
    found = []
    for table in ("tcp", "tcp6", "udp", "udp6"):
        with open(f"/proc/net/{table}") as lines:
            rows = [line.split() for line in list(lines)[1:]]
        for row in rows:
            listens = row[3] == "0A" if table.startswith("tcp") else True
            if listens and row[9] in inodes:
                address = row[1].partition(":")[0]
                known = len(address) == 8
                found.append(socket.inet_ntoa(bytes.fromhex(address)[::-1]) if known else address)
    return found


def test_robots_end_when_the_world_is_gone_without_a_word(folder):
    """The world is a process that is killed as soon as its robots are there."""
    program = (
        "import sys\n"
        "from gnn_policy.robot.exported import ExportedPolicy\n"
        "from gnn_policy.robot.remote_world import WorldServer\n"
        "from gnn_policy.robot.world import World\n"
        "from gnn_policy.robot.zenoh_radio import open_session\n"
        "from mapf_env import random_instance\n"
        "policy = ExportedPolicy(sys.argv[1])\n"
        "case = random_instance(height=6, width=6, density=0.1, num_agents=1, seed=4)\n"
        "session = open_session(sys.argv[2])\n"
        "server = WorldServer(session, World(case, policy.config, policy.execution), b'', policy.fingerprint)\n"
        "server.wait_for_robots(200)\n"
        "print('there', flush=True)\n"
        "sys.stdin.read()\n"
    )
    endpoint = free_endpoint()
    robot = [
        sys.executable,
        "-m",
        "gnn_policy.robot",
        "--name",
        "agent_0",
        "--policy",
        str(folder),
        "--world",
        endpoint,
    ]
    with subprocess.Popen(
        [sys.executable, "-c", program, str(folder), endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as world:
        assert world.stdout is not None
        started = subprocess.Popen(robot, stderr=subprocess.PIPE, text=True)
        assert world.stdout.readline() == "there\n"
        world.kill()
        _, complaint = started.communicate(timeout=200)
    assert started.returncode == 2
    assert "the world is gone" in complaint


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--name", "robot"], "agent_0, agent_1"),
        (["--name", "agent_1", "--round-seconds", "0"], "must be positive"),
        (["--name", "agent_1", "--policy", "nowhere"], "there is no nowhere/manifest.json"),
    ],
)
def test_wrong_arguments_take_one_line(arguments, complaint, capsys):
    from gnn_policy.robot import __main__ as command

    with pytest.raises(SystemExit) as end:
        command.main(["--policy", "x", "--world", "tcp/127.0.0.1:1", *arguments])
    assert end.value.code == 2
    assert complaint in capsys.readouterr().err


def test_the_command_plays_a_swarm_and_draws_it(folder, tmp_path, capsys):
    save_instances(tmp_path / "case.json", [CASE])
    page = tmp_path / "page.html"
    arguments = [str(tmp_path / "case.json"), "--policy", str(folder), "--out", str(page), "--max-steps", "3"]
    swarm.main([*arguments, "--start-seconds", "200", "--step-seconds", "60"])
    printed = capsys.readouterr().out
    assert "3 robots in processes of their own" in printed
    assert "step 1: " in printed
    content = page.read_text(encoding="utf-8")
    assert json.dumps(CASE.goals.tolist(), separators=(",", ":")) in content
