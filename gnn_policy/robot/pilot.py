"""One robot's steps: rounds of messages, whoever keeps the time and whatever carries the frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np

from gnn_policy.robot.driver import Sensed
from gnn_policy.robot.frame import Content, Frame, FrameError, Seal
from gnn_policy.robot.message import Message, Precision
from gnn_policy.robot.reservation import STEPS, Reservation
from gnn_policy.robot.robot import Robot
from mapf_env import Action

PRECISIONS: dict[Content, Precision] = {
    Content.FLOAT32: "float32",
    Content.FLOAT16: "float16",
    Content.INT8: "int8",
}
RESERVATION_ROUNDS = 4
_MOST_EARLY = 1024


class Pilot:
    """Runs a `Robot` through the rounds of its steps: first those of the policy, then those of the local shield.

    A step is `begin`, and then while it is not `over`: `outgoing`, `receive` for all that comes, and `close_round`. A
    message of the policy that comes after its round was closed is late and counts as lost. What comes before its time
    is kept until then. What is damaged, foreign, late or repeated is dropped and counted.

    Args:
        robot: The policy.
        number: The robot's number, 0..65535.
        seal: Makes and checks frames.
        precision: The numbers of the messages that it sends; it understands all.
        reservation_rounds: Rounds of the local shield; 0 if the world shields the team.

    Raises:
        ValueError: If the number is out of range.
    """

    def __init__(
        self,
        robot: Robot,
        number: int,
        seal: Seal,
        *,
        precision: Precision = "float32",
        reservation_rounds: int = RESERVATION_ROUNDS,
    ) -> None:
        if not 0 <= number < 2**16:
            raise ValueError(f"a robot's number must lie in 0..65535, got {number}")
        self.robot, self.number, self.seal = robot, number, seal
        self.precision: Precision = precision
        self.rounds = robot.rounds + reservation_rounds
        self.dropped: Counter[str] = Counter()
        """Number of dropped frames by reason: damaged, foreign, late, repeated."""
        self.scores = np.zeros(len(Action), np.float32)
        """(5,) the scores of the moves, once the policy's rounds are over."""
        self._content = next(content for content, name in PRECISIONS.items() if name == precision)
        self._reservation: Reservation | None = None
        self._sensed: Sensed | None = None
        self._round, self._under_way = 0, 0
        self._early: list[Frame] = []
        self._messages: dict[int, Message] = {}
        self._heard: dict[int, int] = {}
        """The latest round of this step in which each robot within two cells spoke."""
        self._told = False

    def begin(self, sensed: Sensed) -> None:
        """Begin a step, whatever became of the last one.

        Raises:
            ValueError: If what is sensed is not what the policy reads.
        """
        self.robot.begin(sensed.view, sensed.links, sensed.cell, scalars=sensed.scalars, edge_attr=sensed.edge_attr)
        centre = sensed.view.shape[-1] // 2
        self._under_way = 0 if sensed.view[1, centre, centre] else self._under_way + 1
        self._sensed, self._round, self._reservation, self._told = sensed, 0, None, False
        self._heard = {}
        self._open_round()

    @property
    def shields_itself(self) -> bool:
        """True if it moves only where the local shield allows it."""
        return self.rounds > self.robot.rounds

    @property
    def over(self) -> bool:
        """True if there is nothing left to say or to wait for in this step."""
        settled = self._reservation is not None and self._reservation.settled and self._told
        return settled or self._round >= self.rounds

    @property
    def complete(self) -> bool:
        """True if all that can come in this round has come."""
        if self._reservation is not None:
            return self._reservation.heard_all({name for name, last in self._heard.items() if last >= self._round})
        return self._messages.keys() >= self.robot.links.keys()

    def outgoing(self) -> tuple[bytes, list[int]] | None:
        """Return the frame of this round and the robots that it is for, or None if it must be silent."""
        sensed = self._begun()
        if self._reservation is None:
            content, body, receivers = self._content, self.robot.message.to_bytes(self.precision), sensed.links
        else:
            content, body, receivers = Content.RESERVATION, self._reservation.message(), sensed.nearby
            self._told = self._reservation.committed is not None
        if body is None:
            return None
        frame = Frame(content, self.number, sensed.step, self._round, body)
        return self.seal.pack(frame), [name for name in receivers if name >= 0]

    def receive(self, data: bytes) -> None:
        """Take bytes from the radio, whatever they are."""
        try:
            self._take(self.seal.unpack(data))
        except FrameError as fault:
            self.dropped[str(fault).partition(":")[0]] += 1

    def close_round(self, accept: Callable[[int], bool | None]) -> None:
        """End a round with what has come.

        Args:
            accept: Hands a move to the driver (`Driver.accept`).
        """
        self._round += 1
        if self._reservation is not None:
            self._reservation.resolve(accept, last=self._round >= self.rounds)
        else:
            self.robot.hear(self._messages)
        self._open_round()

    def _open_round(self) -> None:
        self._messages = {}
        if self._round == self.robot.rounds:
            self._decide()
        early, self._early = self._early, []
        for frame in early:
            try:
                self._take(frame)
            except FrameError as fault:
                self.dropped[str(fault).partition(":")[0]] += 1

    def _decide(self) -> None:
        """Choose what it wants; with a local shield, begin to reserve."""
        self.scores = self.robot.scores()
        if not self.shields_itself:
            return
        sensed = self._begun()
        centre = sensed.view.shape[-1] // 2
        free = np.array([sensed.view[0, centre + row, centre + col] == 0 for row, col in STEPS])
        self._reservation = Reservation(
            *(self.number, (self.seal.episode, sensed.step), sensed.cell),
            *(free, self.scores, sensed.nearby, self._under_way),
        )

    def _take(self, frame: Frame) -> None:
        """Put a frame where it belongs.

        Raises:
            FrameError: If it must be dropped.
        """
        step = -1 if self._sensed is None else self._sensed.step
        if frame.sender == self.number:
            raise FrameError("foreign: a frame of its own")
        if frame.step < step:
            raise FrameError("late: of an earlier step")
        if frame.content is not Content.RESERVATION and frame.content not in PRECISIONS:
            raise FrameError("foreign: not for a robot's ears")
        if frame.step == step and self._reservation is not None and frame.content is Content.RESERVATION:
            try:  # of any round: it is true for the rest of the step
                self._reservation.hear(frame.sender, frame.body)
            except ValueError as fault:
                raise FrameError(f"damaged: {fault}") from fault
            self._heard[frame.sender] = max(frame.round, self._heard.get(frame.sender, 0))
        elif (frame.step, frame.round) == (step, self._round) and self._reservation is None:
            self._hear(frame)
        elif (frame.step, frame.round) < (step, self._round):
            raise FrameError("late: of an earlier round")
        elif len(self._early) >= _MOST_EARLY or frame.step > step + 1 > 0:
            raise FrameError("early: of a step that is far away, or there are too many")
        else:
            self._early.append(frame)

    def _hear(self, frame: Frame) -> None:
        if frame.sender not in self.robot.links:
            raise FrameError("foreign: of a robot that it does not hear")
        if frame.sender in self._messages:
            raise FrameError("repeated: its message of this round is here")
        try:
            message = Message.from_bytes(frame.body, PRECISIONS[frame.content])
        except (KeyError, ValueError) as fault:
            raise FrameError(f"damaged: {fault}") from fault
        if message.features.shape != self.robot.message.features.shape:
            raise FrameError("foreign: of another policy")
        self._messages[frame.sender] = message

    def _begun(self) -> Sensed:
        if self._sensed is None:
            raise RuntimeError("the robot has not begun a step: begin() first")
        return self._sensed
