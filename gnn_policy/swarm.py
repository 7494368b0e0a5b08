"""`python -m gnn_policy.swarm --agents 12 FILE.map`: a world and a process for each robot, drawn as a replay."""

from __future__ import annotations

import argparse
import os
import secrets
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from gnn_policy.cli_errors import DEBUG, cli_errors
from gnn_policy.robot.__main__ import KEY_VARIABLE
from gnn_policy.robot.message import Precision
from gnn_policy.robot.world import ShieldedBy, World
from mapf_env import EnvConfig, Instance, distances, replay
from mapf_env.files import require_outputs, unused
from mapf_env.problem_file import load_problem

PATIENCE = 4
"""T_max in lengths of the longest way that a robot has to go."""
_LEAVE_SECONDS = 10.0


class Swarm:
    """Processes of robots, ended with the block.

    Args:
        count: How many robots.
        policy: A folder of an exported policy.
        world: The world's endpoint.
        key: The team's key.
        options: Further options of `python -m gnn_policy.robot`.
    """

    def __init__(self, count: int, policy: Path, world: str, key: bytes, options: Sequence[str] = ()) -> None:
        self._policy, self._world, self._options = policy, world, list(options)
        self._environment = {**os.environ, KEY_VARIABLE: key.hex()}
        self.processes = [self.start(number) for number in range(count)]

    def start(self, number: int) -> subprocess.Popen[bytes]:
        """Start the process of a robot."""
        options = ["--name", f"agent_{number}", "--policy", str(self._policy), "--world", self._world, *self._options]
        return subprocess.Popen([sys.executable, "-m", "gnn_policy.robot", *options], env=self._environment)

    def require_alive(self) -> None:
        """Raise RuntimeError if a robot has ended by itself."""
        for number, process in enumerate(self.processes):
            if process.poll() is not None:
                raise RuntimeError(f"agent_{number} has ended with status {process.returncode} before the world began")

    def __enter__(self) -> Swarm:
        return self

    def __exit__(self, *_: object) -> None:
        until = time.monotonic() + _LEAVE_SECONDS
        for process in self.processes:
            try:
                process.wait(max(until - time.monotonic(), 0))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    given = sys.argv[1:] if arguments is None else arguments
    with cli_errors(debug=DEBUG in given):
        _play(_parser().parse_args(given))


def free_endpoint() -> str:
    """Return an endpoint of this machine that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _play(options: argparse.Namespace) -> None:
    instance = load_problem(
        options.file, agents=options.agents, map=options.map, index=options.index, seed=options.seed
    )
    ways = distances(instance.grid, instance.goals)[
        range(instance.num_agents), instance.starts[:, 0], instance.starts[:, 1]
    ]
    max_steps = options.max_steps or max(PATIENCE * int(ways.max()), 1)
    out = options.out or unused(Path(f"{options.file.stem}.html"))
    require_outputs([out], [options.file, options.map])
    with tempfile.TemporaryDirectory() as folder:
        policy = _exported(options.policy, Path(folder))
        _run(options, instance, policy, max_steps, out)


def _exported(policy: Path, folder: Path) -> Path:
    """Return the folder of an exported policy; one by name is exported first, which needs torch."""
    if (policy / "manifest.json").is_file():
        return policy
    print(f"exporting {policy} ...", flush=True)
    command = [sys.executable, "-m", "gnn_policy.export", str(policy), "--out", str(folder / "policy")]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise ValueError(f"the policy {policy} cannot be exported: {last.removeprefix('error: ')}")
    return folder / "policy"


def _run(options: argparse.Namespace, instance: Instance, folder: Path, max_steps: int, out: Path) -> None:
    from gnn_policy.robot.exported import ExportedPolicy
    from gnn_policy.robot.remote_world import WorldServer
    from gnn_policy.robot.zenoh_radio import open_session

    policy, key, endpoint = ExportedPolicy(folder), secrets.token_bytes(32), free_endpoint()
    world = World(
        instance,
        policy.config,
        policy.execution,
        shielded_by=options.shielded_by,
        seed=options.seed,
        max_steps=max_steps,
    )
    robot_options = ["--precision", options.precision, "--round-seconds", str(options.round_seconds)]
    session = open_session(endpoint)
    try:
        server = WorldServer(session, world, key, policy.fingerprint, options.step_seconds)
        with Swarm(instance.num_agents, folder, endpoint, key, robot_options) as swarm:
            server.wait_for_robots(options.start_seconds, swarm.require_alive)
            server.run(_show)
    finally:
        session.close()
    home = int((world.paths[-1] == instance.goals).all(axis=1).sum())
    rate = f"{1000 * np.median(server.seconds):.0f} ms per step" if server.seconds else "no step to go"
    title = f"{instance.num_agents} robots in processes of their own: {home} on goal after {world.step_number} steps"
    replay(instance, world.solution, out, title=title, config=EnvConfig(**policy.execution.env_settings(policy.config)))
    print(f"{title}, {rate}\nreplay: {out}")


def _show(world: World) -> None:
    home = int((world.paths[-1] == world.instance.goals).all(axis=1).sum())
    end = "\r" if sys.stdout.isatty() else "\n"
    print(f"step {world.step_number}: {home} of {world.instance.num_agents} robots on goal", end=end, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m gnn_policy.swarm",
        description="Play a policy on a map with a process for each robot, which talk over zenoh on this machine, and "
        "write a page that replays it.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="a map (.map), a scenario (.scen), a set of instances")
    parser.add_argument("--agents", type=int, help="how many robots: at random on a map, else the first of the file")
    parser.add_argument("--map", type=Path, help="the map of a scenario, if it is not in the same folder")
    parser.add_argument("--index", type=int, help="which instance of a file, from 0")
    parser.add_argument(
        *("--policy",),
        type=Path,
        default=Path("general"),
        help="a policy, or a folder of an exported one (default: general)",
    )
    parser.add_argument(
        "--shielded-by",
        choices=get_args(ShieldedBy),
        default="robots",
        help="robots: they agree by messages and never collide; world: the policy's shield sees all (default: robots)",
    )
    parser.add_argument(
        "--precision", choices=get_args(Precision), default="float32", help="numbers of messages (default: float32)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of places and draws (default: 0)")
    parser.add_argument("--max-steps", type=int, help="T_max (default: four times the longest way)")
    parser.add_argument("--round-seconds", type=float, default=0.05, help="deadline of a round (default: 0.05)")
    parser.add_argument("--step-seconds", type=float, default=5.0, help="deadline of a step (default: 5)")
    parser.add_argument("--start-seconds", type=float, default=120.0, help="how long to wait for robots (default: 120)")
    parser.add_argument("--out", type=Path, help="the page (default: the name of FILE with .html)")
    parser.add_argument("--debug", action="store_true", help="print the traceback of an error")
    return parser


if __name__ == "__main__":
    main()
