"""One robot on its own: a policy executed from its own view and the messages of its neighbours."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from gnn_policy.execution import Execution, gumbel
from gnn_policy.robot.message import Message
from gnn_policy.robot.parts import Features, HasParts, Heard, State
from mapf_env.files import PathLike
from mapf_env.senses import HISTORY


class Robot:
    """A robot that runs a policy by itself.

    A step is: `begin` with what it perceives and whom it hears, then for each of `rounds` exchanges send `message` and
    `hear` the messages of the same round, then `act`. All robots of a team together do exactly what the network does
    for the team at once.

    A message that is lost adds nothing to what the robot gathers in that round. Messages carry neither names nor the
    number of the round: the radio says who sent one, and delivers it in the round in which it was sent or not at all.

    Args:
        policy: The policy: a network, whose weights are shared and which is put into evaluation mode, or an exported
            one (`Robot.load`).
        execution: The choice of actions, the policy's own if not given; shield and communication range belong to
            the environment and are ignored here.
        seed: Seed of its draws; robots of one team need different ones.

    Raises:
        ValueError: If the policy's graph layer cannot be run on one robot, its weights are not finite, or the seed is
            out of range.
    """

    def __init__(self, policy: HasParts, execution: Execution | None = None, seed: int = 0) -> None:
        if not 0 <= seed < 2**64:
            raise ValueError(f"seed must lie in 0..2**64 - 1, got {seed}")
        self._parts = policy.parts()
        self._config = self._parts.config
        self._execution = self._parts.execution if execution is None else execution
        self._seed = np.array([seed], np.uint64)
        self.reset()

    @staticmethod
    def load(folder: PathLike, execution: Execution | None = None, seed: int = 0) -> Robot:
        """Return a robot that runs a policy which `python -m gnn_policy.export` wrote; torch is not needed.

        Args:
            folder: The folder with the manifest.
            execution: As for `Robot`.
            seed: As for `Robot`.

        Raises:
            OSError: If a file is missing.
            ValueError: If a file is damaged, or the seed is out of range.
            ImportError: If onnxruntime is missing.
        """
        from gnn_policy.robot.exported import ExportedPolicy

        return Robot(ExportedPolicy(folder), execution, seed)

    def reset(self) -> None:
        """Forget all steps: the next is the first one of another episode."""
        self._track: deque[tuple[int, ...]] = deque(maxlen=HISTORY)
        self._time = -1
        self._weights: dict[Hashable, float] = {}
        self._edge_attr: dict[Hashable, Features] = {}
        self._state: State = ()
        self._round = -1
        self._message: Message | None = None
        self._stuck = self._alarmed = False
        self._greedy: npt.NDArray[np.bool_] | None = None
        self._jammed = np.zeros(1, np.bool_)

    @property
    def rounds(self) -> int:
        """The number of messages that it sends in a step."""
        return self._parts.rounds

    @property
    def links(self) -> Mapping[Hashable, float]:
        """The neighbours that it hears in this step and the weights of their links."""
        return self._weights

    def begin(
        self,
        view: npt.NDArray[Any],
        links: Mapping[Any, float],
        cell: Iterable[int],
        *,
        scalars: npt.ArrayLike = (),
        edge_attr: Mapping[Any, npt.ArrayLike] | None = None,
    ) -> None:
        """Start a step; anything left of another is dropped.

        Args:
            view: (C, S, S) its field of view, as `mapf_env` makes it.
            links: The weights of the links to the neighbours that it hears, by whatever names they have: 1, or 1 /
                distance for a policy whose comm_weights are "distance".
            cell: Row and column of where it stands, in any frame that stays the same, such as its odometry's.
            scalars: (K,) the robot features that the policy reads; where stuck robots fall back on their shortest way,
                those of `Execution.robot_features`.
            edge_attr: (D,) the edge features of each link, by the same names, if the policy reads any.

        Raises:
            ValueError: If something is not what the policy reads, or not finite, or a weight is not positive.
        """
        wrong = [name for name, weight in links.items() if not 0 < weight < np.inf]
        if wrong:
            raise ValueError(f"links must have positive weights, got {links[wrong[0]]} to {wrong[0]!r}")
        columns = self._config.num_edge_features
        facts = {name: np.asarray((edge_attr or {}).get(name, ()), np.float32) for name in links}
        for name, fact in facts.items():
            if fact.shape != (columns,) or not np.isfinite(fact).all():
                raise ValueError(
                    f"the policy reads {columns} finite edge features ({', '.join(self._config.edge_features)}) "
                    f"of each link, got {fact.tolist()} of {name!r}"
                )
        own = np.asarray(scalars, np.float32)
        if own.ndim != 1 or not np.isfinite(own).all():
            raise ValueError(f"scalars must be a row of finite numbers, got {own.tolist()}")
        self._config.require_perceived(view.shape, len(own))
        if self._execution.actions == "fallback":
            self._greedy = self._execution.facts(own[None], self._config)["greedy_moves"]
        self._weights, self._edge_attr = dict(links), facts
        state = self._parts.encode(
            self._config.decoded(view), own[: self._config.num_robot_features], self._heard(self._weights)
        )
        if not all(np.isfinite(part).all() for part in state):
            raise ValueError("the features of the view are not finite: check the view and the policy's weights")
        self._state, self._message = state, None
        self._time += 1
        self._round = 0
        place, centre = tuple(int(each) for each in cell), view.shape[-1] // 2
        on_goal = bool(view[1, centre, centre])
        self._stuck = self._alarmed = not on_goal and place in self._track
        cells = len({*self._track, place})
        self._jammed = np.array([not on_goal and len(self._track) == HISTORY and cells <= 3])
        self._track.append(place)

    @property
    def message(self) -> Message:
        """The message for its neighbours in this round."""
        if not 0 <= self._round < self.rounds:
            raise RuntimeError(f"there are {self.rounds} rounds in a step: begin() the next step or act()")
        if self._message is None:
            self._message = Message(self._parts.send(self._state, self._round), self._stuck)
        return self._message

    def hear(self, messages: Mapping[Any, Message]) -> None:
        """Take the messages of this round that came, by the names of the links.

        Raises:
            ValueError: If one came over no link, or is of another policy, or has features that are not finite.
            RuntimeError: If the rounds of the step are over.
        """
        size = self.message.features.shape
        if strange := messages.keys() - self._weights.keys():
            raise ValueError(f"got a message of {next(iter(strange))!r}, to whom begin() was given no link")
        for name, message in messages.items():
            if message.features.shape != size:
                raise ValueError(f"{name!r} sent {message.features.shape} features, this policy has {size}")
            if not np.isfinite(message.features).all():
                raise ValueError(
                    f"{name!r} sent features that are not finite: leave the message out as if it were lost"
                )
            self._alarmed |= message.stuck and self._execution.actions == "stuck"
        names = [name for name in self._weights if name in messages]  # in the links' order, as the network sums them
        heard = np.array([messages[name].features for name in names], np.float32).reshape(len(names), *size)
        self._state = self._parts.combine(self._state, heard, self._heard(names), self._round)
        self._message = None
        self._round += 1

    def logits(self) -> Features:
        """Return the logits (5,) of its moves.

        Raises:
            RuntimeError: If rounds are missing.
            ValueError: If they are not finite.
        """
        if self._round != self.rounds:
            raise RuntimeError(f"it heard {max(self._round, 0)} of {self.rounds} rounds: begin() and hear() first")
        logits = self._parts.decide(self._state)
        if not np.isfinite(logits).all():
            raise ValueError("the logits are not finite numbers: check the messages and the policy's weights")
        return logits

    def scores(self) -> Features:
        """Return a score (5,) for each move: its logits and the noise of its draws. The PIBT shield takes their order.

        Raises:
            RuntimeError: If rounds are missing.
        """

        def noise(drawn: npt.NDArray[np.bool_]) -> Features:
            return gumbel(self._seed, np.array([self._time]))

        return self._execution.scores(
            self.logits()[None], np.array([self._alarmed]), noise, self._greedy, self._jammed
        )[0]

    def act(self) -> int:
        """Return the move that it wants, 0..4, the one with the greatest score; the environment's shield decides.

        Raises:
            RuntimeError: If rounds are missing.
        """
        return int(self.scores().argmax())

    def _heard(self, names: Iterable[Hashable]) -> Heard:
        chosen = list(names)
        attr = np.array([self._edge_attr[name] for name in chosen], np.float32)
        weight = np.array([self._weights[name] for name in chosen], np.float32)
        return Heard(weight, attr.reshape(len(chosen), self._config.num_edge_features))
