"""A whole swarm in one process and without a clock: what the robots would do over a radio with given faults."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from gnn_policy.execution import Execution
from gnn_policy.robot.frame import Seal
from gnn_policy.robot.message import Precision
from gnn_policy.robot.parts import HasParts
from gnn_policy.robot.pilot import RESERVATION_ROUNDS, Pilot
from gnn_policy.robot.radio import Ether, Faults
from gnn_policy.robot.robot import Robot
from gnn_policy.robot.world import ShieldedBy, World
from mapf_env import Instance, Solution


@dataclass(frozen=True, slots=True, eq=False)
class Rehearsal:
    """The outcome of a swarm."""

    solution: Solution
    """The executed paths."""
    success: bool
    """All robots were on their goals at once."""
    sent: int
    """Bytes sent by all robots, headers included, each frame once for each receiver."""
    dropped: Counter[str]
    """Frames that robots dropped, by the reason."""


def rehearse(
    policy: HasParts,
    instance: Instance,
    *,
    execution: Execution | None = None,
    faults: Faults | None = None,
    shielded_by: ShieldedBy = "robots",
    absent: Mapping[int, range] | None = None,
    precision: Precision = "float32",
    reservation_rounds: int = RESERVATION_ROUNDS,
    key: bytes = b"rehearsal",
    seed: int = 0,
    max_steps: int = 128,
) -> Rehearsal:
    """Play an instance with one `Pilot` for each robot, round by round.

    Args:
        policy: A network or an exported policy.
        instance: The map, the starts and the goals.
        execution: How moves are chosen; the policy's own if not given.
        faults: What the radio does to frames; nothing if not given.
        shielded_by: Who keeps robots apart (`World`).
        absent: Steps in which a robot's process is dead; after them it starts again and knows nothing.
        precision: The numbers of the policy's messages.
        reservation_rounds: Rounds of the local shield in a step.
        key: The team's key.
        seed: Seed of draws, as in `rollout`, and of the radio's faults.
        max_steps: T_max.

    Raises:
        CollisionError: If robots that shield themselves collide.
    """
    parts = policy.parts()
    execution = parts.execution if execution is None else execution
    world = World(instance, parts.config, execution, shielded_by=shielded_by, seed=seed, max_steps=max_steps)
    ether, seal, absent = Ether(faults or Faults(), seed), Seal(key, seed), absent or {}
    rounds = reservation_rounds if shielded_by == "robots" else 0

    def process(number: int) -> Pilot:
        robot = Robot(policy, execution, seed=int(world.seeds[number]))
        return Pilot(robot, number, seal, precision=precision, reservation_rounds=rounds)

    pilots: dict[int, Pilot] = {}
    dropped: Counter[str] = Counter()
    while world.running:
        for number in range(instance.num_agents):
            dead = world.step_number in absent.get(number, ())
            if dead and number in pilots:
                dropped += pilots.pop(number).dropped
                ether.leave(number)
            elif not dead and number not in pilots:
                pilots[number] = process(number)
                ether.radio(number)
        moves = _one_step(world, pilots, ether)
        if shielded_by == "robots":
            world.execute(moves)
        else:
            world.execute_shielded({number: pilot.scores for number, pilot in pilots.items()})
    for pilot in pilots.values():
        dropped += pilot.dropped
    success = bool((world.paths[-1] == instance.goals).all())
    return Rehearsal(world.solution, success, ether.sent, dropped)


def _one_step(world: World, pilots: Mapping[int, Pilot], ether: Ether) -> dict[int, int]:
    """Run all rounds of a step; return the moves that drivers have accepted."""
    accepted: dict[int, int] = {}
    radios = {number: ether.radio(number) for number in pilots}
    sensed = world.sense()
    for number, pilot in pilots.items():
        pilot.begin(sensed[number])
    for _ in range(max((pilot.rounds for pilot in pilots.values()), default=0)):
        busy = {number: pilot for number, pilot in pilots.items() if not pilot.over}
        for number, pilot in busy.items():
            if (frame := pilot.outgoing()) is not None:
                radios[number].send(*frame)
        for number, pilot in pilots.items():
            while (data := radios[number].receive()) is not None:
                pilot.receive(data)
        for number, pilot in busy.items():

            def accept(move: int, number: int = number) -> bool:
                accepted[number] = move
                return True

            pilot.close_round(accept)
        ether.tick()
    return accepted
