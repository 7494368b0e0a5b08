"""A simulated world in a process of its own: the driver that robots reach it by, and its side of the wire."""

from __future__ import annotations

import secrets
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import zenoh

from gnn_policy.execution import Execution
from gnn_policy.policy_config import PolicyConfig
from gnn_policy.robot.driver import EndOfWorld, Sensed
from gnn_policy.robot.frame import Content, Frame, FrameError, Seal
from gnn_policy.robot.world import World
from gnn_policy.robot.zenoh_radio import Inbox
from mapf_env import Action

_WELCOME = struct.Struct("<16sQQHB8s")
"""The nonce of the robot that asked, the episode, its seed, the number of robots, whether they shield themselves, and
the policy's fingerprint."""
_SCORES = np.dtype("<f4")
WORLD = 2**16 - 1
"""The number by which the world signs its frames."""
_ALIVE = "mapf/alive"
ANSWER_SECONDS = 1.0
MEETING_SECONDS = 20.0


class RemoteDriver:
    """A robot's body in a world process (`gnn_policy.robot.driver.Driver`).

    Args:
        session: The robot's session, connected to the world's.
        number: The robot's number.
        key: The team's key.
        policy: What the robot perceives.
        execution: How the policy is executed.
        fingerprint: The policy's; the world must have the same.
        timeout: Seconds to wait for the world.

    Raises:
        TimeoutError: If there is no world that answers.
        ValueError: If it has another policy or no place for this robot.
    """

    def __init__(
        self,
        session: zenoh.Session,
        number: int,
        key: bytes,
        policy: PolicyConfig,
        execution: Execution,
        fingerprint: str,
        timeout: float = 30.0,
    ) -> None:
        self._session, self.number, self._policy, self._execution = session, number, policy, execution
        self._inbox = Inbox(session, f"mapf/sensed/{number}")
        self._gone = threading.Event()
        self._token = session.liveliness().declare_token(f"{_ALIVE}/{number}")
        self._watch = session.liveliness().declare_subscriber(f"{_ALIVE}/{WORLD}", self._notice)
        self.seal = Seal(key, 0)
        """Makes and checks frames of the world's episode."""
        nonce, until = secrets.token_bytes(16), time.monotonic() + timeout
        while True:
            answer = self._ask(f"mapf/join/{number}", Frame(Content.WELCOME, number, 0, 0, nonce))
            if answer is not None and len(answer.body) == _WELCOME.size:
                came, episode, self.seed, count, shielded, whose = _WELCOME.unpack(answer.body)
                if came == nonce:
                    break
            if time.monotonic() > until:
                raise TimeoutError(f"no world has answered agent_{number} within {timeout:g} seconds")
            time.sleep(0.05)
        if whose.hex() != fingerprint:
            raise ValueError(f"the world has the policy {whose.hex()}, this robot {fingerprint}: give both the same")
        self.shields_itself = bool(shielded)
        """True if robots must not collide by their own agreement."""
        self.seal = Seal(key, episode)
        self._meet(count, until)
        self._ask(f"mapf/join/{number}", Frame(Content.READY, number, 0, 0, b""))

    def sense(self, timeout: float) -> Sensed | None:
        """Return what is perceived at the start of the newest step, or None if none begins within `timeout` seconds.

        Steps that went by while the robot was late are skipped.

        Raises:
            EndOfWorld: If the world has ended.
            ConnectionError: If it is gone without a word.
        """
        until, newest = time.monotonic() + timeout, None
        while (left := until - time.monotonic()) > 0:
            if (data := self._inbox.get(min(left, 0.2) if newest is None else 0.0)) is not None:
                try:
                    frame = self.seal.unpack(data)
                except FrameError:  # not of the world: it says nothing about the step
                    continue
                if frame.content is Content.END:
                    raise EndOfWorld
                if frame.content is Content.SENSED:
                    newest = frame.body
            elif newest is not None:
                break
            elif self._gone.is_set():
                raise ConnectionError("the world is gone without having ended")
        return None if newest is None else Sensed.from_bytes(newest, self._policy, self._execution)

    def accept(self, step: int, move: int) -> bool | None:
        """Hand a move to the world; False if it refuses, None if no answer came."""
        answer = self._ask(f"mapf/command/{self.number}", self._frame(step, bytes([move])))
        if answer is None or answer.step != step or answer.content is not Content.COMMAND:
            return None
        return answer.body == bytes([move, 1])

    def propose(self, step: int, scores: npt.NDArray[np.float32]) -> None:
        """Hand the scores of all moves to the world, which shields the team."""
        self._ask(f"mapf/command/{self.number}", self._frame(step, scores.astype(_SCORES).tobytes()))

    def _meet(self, count: int, until: float) -> None:
        """Wait until the other robots of the team are connected, but not for those that do not come."""
        until = min(until, time.monotonic() + MEETING_SECONDS)
        while time.monotonic() < until:
            tokens = self._session.liveliness().get(f"{_ALIVE}/*", timeout=ANSWER_SECONDS)
            if sum(reply.ok is not None for reply in tokens) > count:  # the robots and the world
                return
            time.sleep(0.1)

    def _frame(self, step: int, body: bytes) -> Frame:
        return Frame(Content.COMMAND, self.number, step, 0, body)

    def _ask(self, key: str, frame: Frame) -> Frame | None:
        for reply in self._session.get(key, payload=self.seal.pack(frame), timeout=ANSWER_SECONDS):
            if reply.ok is not None:
                try:
                    answer = self.seal.unpack(reply.ok.payload.to_bytes())
                except FrameError:
                    continue
                if answer.sender == WORLD:
                    return answer
        return None

    def _notice(self, sample: Any) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._gone.set()


class WorldServer:
    """Serves a `World` to robots in processes of their own.

    Args:
        session: The world's session; robots connect to it.
        world: The world.
        key: The team's key.
        fingerprint: The policy's.
        step_seconds: A step ends when all robots that are there have moved, or after this time.
    """

    def __init__(
        self, session: zenoh.Session, world: World, key: bytes, fingerprint: str, step_seconds: float = 5.0
    ) -> None:
        self.world = world
        self.seconds: list[float] = []
        """Duration of each step."""
        self._session, self._step_seconds = session, step_seconds
        self._fingerprint = bytes.fromhex(fingerprint)
        self._door, self._seal = Seal(key, 0), Seal(key, secrets.randbits(63) + 1)
        self._change = threading.Condition()
        self._there: set[int] = set()
        self._open = False
        self._moves: dict[int, int] = {}
        self._scores: dict[int, npt.NDArray[np.float32]] = {}
        self._robots = range(world.instance.num_agents)
        self._declared = [
            session.declare_queryable("mapf/join/*", self._join),
            session.declare_queryable("mapf/command/*", self._command),
            session.liveliness().declare_subscriber(f"{_ALIVE}/*", self._notice, history=True),
            session.liveliness().declare_token(f"{_ALIVE}/{WORLD}"),
        ]

    def wait_for_robots(self, timeout: float, check: Callable[[], None] = lambda: None) -> None:
        """Wait until all robots are there, and call `check` several times a second meanwhile.

        Raises:
            TimeoutError: If they are not within `timeout` seconds.
        """
        until = time.monotonic() + timeout
        with self._change:
            while not self._change.wait_for(lambda: len(self._there) == len(self._robots), 0.2):
                check()
                if time.monotonic() < until:
                    continue
                missing = sorted(set(self._robots) - self._there)
                raise TimeoutError(
                    f"{len(missing)} robots did not come within {timeout:g} s, the first agent_{missing[0]}"
                )

    def run(self, progress: Callable[[World], None] = lambda world: None) -> None:
        """Play until the end and tell the robots; `progress` is called after each step.

        Raises:
            CollisionError: If robots that shield themselves collide.
        """
        try:
            while self.world.running:
                self._one_step()
                progress(self.world)
        finally:
            for number in self._robots:
                self._tell(number, Content.END, b"")

    def _one_step(self) -> None:
        before = time.perf_counter()
        sensed = self.world.sense()
        with self._change:
            self._moves, self._scores, self._open = {}, {}, True
            there = sorted(self._there)
        for number in there:
            self._tell(number, Content.SENSED, sensed[number].to_bytes())
        with self._change:
            self._change.wait_for(
                lambda: self._there <= self._moves.keys() | self._scores.keys() | (set(self._robots) - set(there)),
                self._step_seconds,
            )
            self._open = False
            moves, scores = dict(self._moves), dict(self._scores)
        if self.world.shielded_by == "robots":
            self.world.execute(moves)
        else:
            self.world.execute_shielded(scores)
        self.seconds.append(time.perf_counter() - before)

    def _tell(self, number: int, content: Content, body: bytes) -> None:
        data = self._seal.pack(Frame(content, WORLD, self.world.step_number, 0, body))
        self._session.put(f"mapf/sensed/{number}", data)

    def _join(self, query: Any) -> None:
        frame = self._asked(query, self._door)
        if frame is None or frame.content is not Content.WELCOME or len(frame.body) != 16:
            self._admit(query)
            return
        shielded, seed = self.world.shielded_by == "robots", int(self.world.seeds[frame.sender])
        known = (frame.body, self._seal.episode, seed, len(self._robots), shielded, self._fingerprint)
        query.reply(query.key_expr, self._door.pack(Frame(Content.WELCOME, WORLD, 0, 0, _WELCOME.pack(*known))))

    def _admit(self, query: Any) -> None:
        frame = self._asked(query, self._seal)
        if frame is None or frame.content is not Content.READY:
            return
        query.reply(query.key_expr, self._seal.pack(Frame(Content.READY, WORLD, 0, 0, b"")))
        with self._change:
            self._there.add(frame.sender)
            self._change.notify_all()

    def _command(self, query: Any) -> None:
        frame = self._asked(query, self._seal)
        if frame is None or frame.content is not Content.COMMAND:
            return
        number, body = frame.sender, frame.body
        with self._change:
            accepted = self._open and frame.step == self.world.step_number
            if len(body) == 1 and body[0] <= Action.IDLE:
                accepted = accepted and number not in self._moves
                if accepted:
                    self._moves[number] = body[0]
            elif len(body) == len(Action) * _SCORES.itemsize and accepted:
                scores = np.frombuffer(body, _SCORES).astype(np.float32)
                if np.isfinite(scores).all():
                    self._scores[number] = scores
            self._change.notify_all()
        answer = Frame(Content.COMMAND, WORLD, frame.step, 0, body[:1] + bytes([accepted]))
        query.reply(query.key_expr, self._seal.pack(answer))

    def _asked(self, query: Any, seal: Seal) -> Frame | None:
        """The frame of a query, if a robot of the team sent it."""
        try:
            frame = seal.unpack(b"" if query.payload is None else query.payload.to_bytes())
        except FrameError:
            return None
        return frame if frame.sender in self._robots else None

    def _notice(self, sample: Any) -> None:
        """A robot's process has come or gone; it takes part only once it has joined."""
        number = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.DELETE and number.isdigit():
            with self._change:
                self._there.discard(int(number))
                self._change.notify_all()
