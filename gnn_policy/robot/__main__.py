"""`python -m gnn_policy.robot --name agent_3 --policy FOLDER --world ENDPOINT`: one robot in a process of its own."""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Sequence
from typing import get_args

from gnn_policy.cli_errors import DEBUG, cli_errors
from gnn_policy.robot.driver import Driver, EndOfWorld
from gnn_policy.robot.message import Precision
from gnn_policy.robot.pilot import RESERVATION_ROUNDS, Pilot
from gnn_policy.robot.radio import Radio

KEY_VARIABLE = "MAPF_TEAM_KEY"
"""The environment variable with the team's key in hexadecimal: arguments are seen by other users, this is not."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    given = sys.argv[1:] if arguments is None else arguments
    with cli_errors(debug=DEBUG in given):
        _work(_parser().parse_args(given))


def team_key() -> bytes:
    """Return the team's key, empty if none is set.

    Raises:
        ValueError: If the variable holds something else.
    """
    text = os.environ.get(KEY_VARIABLE, "")
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise ValueError(f"{KEY_VARIABLE} must hold the team's key in hexadecimal") from None


def number_of(name: str) -> int:
    """Return the number of a robot by its name.

    Raises:
        ValueError: If the name is not "agent_" and a number.
    """
    if not re.fullmatch(r"agent_\d{1,5}", name):
        raise ValueError(f"a robot is called agent_0, agent_1 and so on, got {name!r}")
    return int(name[6:])


def live(pilot: Pilot, radio: Radio, driver: Driver, *, round_seconds: float, patience: float) -> None:
    """Take part in step after step until the world ends.

    A round ends when all have been heard that can be, or when its time is over: round k ends at the latest
    (k + 1) * `round_seconds` after the start of the step.

    Raises:
        TimeoutError: If no step begins within `patience` seconds.
    """
    while True:
        try:
            sensed = driver.sense(patience)
        except EndOfWorld:
            return
        if sensed is None:
            raise TimeoutError(f"no step has begun within {patience:g} seconds")
        deadline = time.monotonic()
        pilot.begin(sensed)
        while not pilot.over:
            deadline += round_seconds
            if (frame := pilot.outgoing()) is not None:
                radio.send(*frame)
            while (data := radio.receive(0.0 if pilot.complete else deadline - time.monotonic())) is not None:
                pilot.receive(data)
            pilot.close_round(lambda move, step=sensed.step: driver.accept(step, move))
        if not pilot.shields_itself:
            driver.propose(sensed.step, pilot.scores)


def _work(options: argparse.Namespace) -> None:
    number, key = number_of(options.name), team_key()
    if options.round_seconds <= 0 or options.patience <= 0:
        raise ValueError("--round-seconds and --patience must be positive")
    from gnn_policy.robot.exported import ExportedPolicy
    from gnn_policy.robot.remote_world import RemoteDriver
    from gnn_policy.robot.robot import Robot
    from gnn_policy.robot.zenoh_radio import ZenohRadio, open_session

    policy = ExportedPolicy(options.policy)
    session = open_session(options.listen, [options.world])
    radio = ZenohRadio(session, number)
    try:
        driver = RemoteDriver(session, number, key, policy.config, policy.execution, policy.fingerprint)
        pilot = Pilot(
            *(Robot(policy, seed=driver.seed), number, driver.seal),
            precision=options.precision,
            reservation_rounds=RESERVATION_ROUNDS if driver.shields_itself else 0,
        )
        live(pilot, radio, driver, round_seconds=options.round_seconds, patience=options.patience)
    finally:
        radio.close()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m gnn_policy.robot", description=__doc__)
    parser.add_argument("--name", required=True, help="the robot's name: agent_0, agent_1 and so on")
    parser.add_argument("--policy", required=True, help="a folder that `python -m gnn_policy.export` wrote")
    parser.add_argument("--world", required=True, help="zenoh endpoint of the world, such as tcp/127.0.0.1:7447")
    parser.add_argument(
        "--listen",
        default="tcp/127.0.0.1:0",
        help="zenoh endpoint where other robots reach this one (default: a free port of this machine only)",
    )
    parser.add_argument(
        "--precision", choices=get_args(Precision), default="float32", help="numbers of its messages (default: float32)"
    )
    parser.add_argument("--round-seconds", type=float, default=0.05, help="deadline of a round (default: 0.05)")
    parser.add_argument(
        "--patience",
        type=float,
        default=30.0,
        help="seconds without a step after which the robot gives up (default: 30)",
    )
    parser.add_argument("--debug", action="store_true", help="print the traceback of an error")
    return parser


if __name__ == "__main__":
    main()
