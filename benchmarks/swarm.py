"""A swarm over a bad radio, without a member, in fewer bits and as processes: `python benchmarks/swarm.py PART`.

The parts are `radio` (loss, delay and a crash), `bits` (numbers of the messages), `processes` (time of a step) and
`robot` (one robot alone: start, memory, time of its step). Each prints a table in Markdown. A collision would end the
run with an error.
"""

from __future__ import annotations

import argparse
import json
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from gnn_policy.robot.exported import ExportedPolicy
from gnn_policy.robot.message import Precision
from gnn_policy.robot.radio import Faults
from gnn_policy.robot.rehearsal import Rehearsal, rehearse
from gnn_policy.robot.remote_world import WorldServer
from gnn_policy.robot.world import World
from gnn_policy.robot.zenoh_radio import open_session
from gnn_policy.swarm import Swarm, free_endpoint
from mapf_env import Instance, random_instance

ROBOTS, SIDE, DENSITY, MAX_STEPS = 12, 20, 0.2, 128
CRASH_STEP = 5
ROBOT_ALONE = """
import json, resource, statistics, sys, time
name, runtime, started = sys.argv[1], sys.argv[2], float(sys.argv[3])
if runtime == "torch":
    import torch, gnn_policy
    torch.set_num_threads(1)
    policy = gnn_policy.load(name)
else:
    from gnn_policy.robot.exported import ExportedPolicy
    policy = ExportedPolicy(name)
from gnn_policy.robot.robot import Robot
from gnn_policy.robot.world import World
from mapf_env import random_instance
robot, parts = Robot(policy), policy.parts()
start = time.time() - started
team = random_instance(height=4, width=4, density=0, num_agents=9, seed=0)
sensed = World(team, parts.config, parts.execution).sense()[0]
times = []
for _ in range(330):
    before = time.perf_counter()
    robot.begin(sensed.view, sensed.links, sensed.cell, scalars=sensed.scalars, edge_attr=sensed.edge_attr)
    for _ in range(robot.rounds):
        robot.hear(dict.fromkeys(sensed.links, robot.message))
    robot.act()
    times.append(time.perf_counter() - before)
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps([start, memory, len(sensed.links), 1000 * statistics.median(times[30:])]))
"""
"""Run in a process of its own with a policy, "torch" or "onnx", and the time at which it was started."""


def cases(count: int, robots: int = ROBOTS) -> list[Instance]:
    """Random instances; their seeds are not those of any training data."""
    settings = {"height": SIDE, "width": SIDE, "density": DENSITY, "num_agents": robots}
    return [random_instance(**settings, seed=10**6 + number) for number in range(count)]


def outcome(played: Rehearsal, instance: Instance, without: int | None = None) -> tuple[bool, int]:
    """Return success and flowtime, if wanted without one robot; a robot that is not on its goal counts T_max."""
    robots = [robot for robot in range(instance.num_agents) if robot != without]
    at_end = (played.solution.paths[-1] == instance.goals).all(axis=1)[robots]
    times = np.where(at_end, played.solution.arrival_times[robots], MAX_STEPS)
    return bool(at_end.all()), int(times.sum())


def rehearsed(
    policy: ExportedPolicy, count: int, play: Callable[[Instance, int], Rehearsal], without: int | None = None
):
    """Success, flowtime per robot, and the rehearsals of all cases."""
    played = [(play(case, number), case) for number, case in enumerate(cases(count))]
    results = [outcome(each, case, without) for each, case in played]
    robots = ROBOTS - (without is not None)
    success, flowtime = (float(np.mean(column)) for column in zip(*results, strict=True))
    return success, flowtime / robots, [each for each, _ in played]


def radio(policy: ExportedPolicy, count: int) -> None:
    """The table of loss, delay and a crash."""
    rows: dict[str, tuple[Faults, Mapping[int, range], int | None]] = {
        "nothing lost": (Faults(), {}, None),
        **{f"{loss:.0%} lost": (Faults(loss=loss), {}, None) for loss in (0.1, 0.2, 0.3, 0.5)},
        **{f"0 to {delay} rounds late": (Faults(delay=delay), {}, None) for delay in (1, 2)},
        "20% lost, 0 to 1 rounds late": (Faults(loss=0.2, delay=1), {}, None),
        "all lost": (Faults(loss=1.0), {}, None),
        f"one robot dies at step {CRASH_STEP}": (Faults(), {0: range(CRASH_STEP, MAX_STEPS)}, 0),
        f"one robot is away for steps {CRASH_STEP} to {CRASH_STEP + 19}": (
            Faults(),
            {0: range(CRASH_STEP, CRASH_STEP + 20)},
            None,
        ),
    }
    print("| radio | success | flowtime per robot |\n|---|---|---|")
    seen_by_all = rehearsed(
        policy,
        count,
        lambda case, number: rehearse(policy, case, shielded_by="world", seed=number, max_steps=MAX_STEPS),
    )
    shield = policy.execution.shield
    print(f"| nothing lost, the world shields ({shield}): the batch | {seen_by_all[0]:.2f} | {seen_by_all[1]:.1f} |")
    for name, (faults, absent, without) in rows.items():

        def play(
            case: Instance, number: int, faults: Faults = faults, absent: Mapping[int, range] = absent
        ) -> Rehearsal:
            return rehearse(policy, case, faults=faults, absent=absent, seed=number, max_steps=MAX_STEPS)

        success, flowtime, _ = rehearsed(policy, count, play, without)
        print(f"| {name} | {success:.2f} | {flowtime:.1f} |", flush=True)


def bits(policy: ExportedPolicy, count: int) -> None:
    """The table of the numbers of messages."""
    print(
        "| numbers | bytes of a message | success | flowtime per robot | bytes per robot and step |\n"
        "|---|---|---|---|---|"
    )
    precisions: tuple[Precision, ...] = ("float32", "float16", "int8")
    for precision in precisions:

        def play(case: Instance, number: int, precision: Precision = precision) -> Rehearsal:
            return rehearse(policy, case, precision=precision, seed=number, max_steps=MAX_STEPS)

        success, flowtime, played = rehearsed(policy, count, play)
        steps = sum(len(each.solution.paths) - 1 for each in played)
        sent = sum(each.sent for each in played) / steps / ROBOTS
        size = policy.manifest["message_bytes"][precision]
        print(f"| {precision} | {size} | {success:.2f} | {flowtime:.1f} | {sent:.0f} |", flush=True)


def processes(policy: ExportedPolicy, steps: int, sizes: tuple[int, ...] = (4, 12, 30)) -> None:
    """The table of the time of a step where each robot is a process."""
    print("| processes of robots | median ms per step | 90th percentile |\n|---|---|---|")
    for size in sizes:
        instance, key, endpoint = cases(1, size)[0], secrets.token_bytes(32), free_endpoint()
        world = World(instance, policy.config, policy.execution, max_steps=steps)
        session = open_session(endpoint)
        try:
            server = WorldServer(session, world, key, policy.fingerprint, step_seconds=30)
            with Swarm(size, policy.folder, endpoint, key, ["--round-seconds", "5", "--patience", "120"]) as swarm:
                server.wait_for_robots(300, swarm.require_alive)
                server.run()
        finally:
            session.close()
        times = 1000 * np.array(server.seconds)
        print(f"| {size} | {np.median(times):.0f} | {np.quantile(times, 0.9):.0f} |", flush=True)


def robot_alone(exported: Path, name: str, starts: int = 5) -> None:
    """The table of one robot, once without torch and once with it."""
    print("| runtime | start, s | memory, MB | neighbours | ms per step |\n|---|---|---|---|---|")
    for runtime, policy in (("onnx", str(exported)), ("torch", name)):
        measured = []
        for _ in range(starts):
            command = [sys.executable, "-c", ROBOT_ALONE, policy, runtime, str(time.time())]
            measured.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
        start, memory, neighbours, step = np.median(measured, axis=0)
        print(f"| {runtime} | {start:.1f} | {memory:.0f} | {neighbours:.0f} | {step:.2f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("radio", "bits", "processes", "robot"))
    parser.add_argument("--policy", default="general", help="a policy, exported first, or a folder of an exported one")
    parser.add_argument("--cases", type=int, default=50, help="instances for each row (default: 50)")
    parser.add_argument("--steps", type=int, default=20, help="steps that processes go (default: 20)")
    options = parser.parse_args()
    if options.part == "robot" and Path(options.policy).is_dir():
        parser.error("the part `robot` also runs the policy with torch: give --policy a name or a .safetensors file")
    with tempfile.TemporaryDirectory() as folder:
        exported = Path(options.policy)
        if not exported.is_dir():
            exported = Path(folder) / "policy"
            command = [sys.executable, "-m", "gnn_policy.export", options.policy, "--out", str(exported)]
            subprocess.run(command, check=True)
        policy = ExportedPolicy(exported)
        if options.part == "processes":
            processes(policy, options.steps)
        elif options.part == "robot":
            robot_alone(exported, options.policy)
        else:
            {"radio": radio, "bits": bits}[options.part](policy, options.cases)


if __name__ == "__main__":
    main()
