"""The local shield: robots that nobody watches agree by messages who moves, and never collide.

In each step a robot keeps the set of moves that it may still make. It tells the set to the robots within two cells,
again in each round of the step, and the set only ever shrinks. To stay where it is needs nobody's consent and is not in
the set. A robot **commits** to a move of its set by handing it to its driver; once the driver has accepted it, it tells
so.

Before robot i commits to a move from its cell p into a cell c, all of this must hold:

1. *Nobody stands there to stay.* If robot j stands on c, i has heard that j has committed to a move, not onto p.
2. *Nobody else comes.* For each other robot k that stands next to c: i precedes k in this step, or i has heard from k
   a set without the move onto c. Who precedes is the order of a hash of episode, step and number: all know it without a
   message, and it changes with each step, so that everybody's turn comes.

Why no step collides, whatever messages are lost, late or repeated:

- A set that was heard is true for the rest of the step, whenever and how often it comes, since sets only shrink; a
  message that is lost leaves a robot with a larger set in mind than the true one. So less is allowed, never more.
- *Two robots enter c.* Both stand next to c, so they are within two cells and see each other. Let i precede k. Then k
  has heard from i a set without the move onto c. Sets never grow, so i does not commit to c: not both enter.
- *One enters c, where j stays.* By rule 1 the one that enters has heard that j's driver had accepted a move away from
  c.
- *Two swap their cells.* By rule 1 i has heard that j had committed to a move that does not lead onto p.

What this assumes, and a driver must provide:

- A robot sees which robots stand within two cells of it, and which numbers they have. One whose number it cannot tell
  gets a negative number: it precedes everybody and is never heard, so that nobody enters its cell or one next to it.
- The driver carries out a move that it has accepted in this step, even if the robot's process ends at once, and refuses
  a move that comes after the end of the step. A robot without an accepted move stays on its cell. Where the driver's
  answer is lost, the robot says nothing more in this step, so that others go on with what they heard before.
- A process that starts again takes part from the next step on: in the old one it may have promised what it forgot.
- Nobody outside the team has its key: a forged message has a wrong tag and is dropped (`gnn_policy.robot.frame`). Under
  a checksum alone the argument holds for damage, not for an enemy. A robot of the team that lies is not covered either.

A silent robot is therefore an obstacle where it stands, and it delays the robots near it: into a cell next to it they
move only in steps in which they precede it. At the price of waiting, robots move even where no message comes.

Which moves are tried, and in what order, changes nothing of this. The order is that of the policy's scores, with the
two rules of priority inheritance: a robot gives up a cell that a robot with higher priority wants; and where one with
higher priority wants the cell on which it stands, it takes over that priority and prefers any move to staying. Priority
is the time since a robot was on its goal.

Source of the priorities: PIBT (Okumura et al. 2022). The reservation is this project's own.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np
import numpy.typing as npt

from mapf_env import MOVES, Action

Cell = tuple[int, int]
STEPS: tuple[Cell, ...] = tuple((int(row), int(col)) for row, col in MOVES)
"""The change of row and column of each of the five moves."""
SIGHT = 2
"""Robots within so many moves must be seen."""
_BODY = struct.Struct("<BBBH")
_ALL = (1 << Action.IDLE) - 1


@dataclass(slots=True)
class _Neighbour:
    """Knowledge of a robot within two cells."""

    cell: Cell
    moves: int = _ALL
    """The set of moves that it may still make, as bits."""
    committed: int | None = None
    """The move that its driver has accepted, or IDLE if it stays."""
    wants: Cell | None = None
    priority: int = 0


class Reservation:
    """One robot's part in one step of the protocol above.

    Args:
        number: The robot's number.
        turn: Episode and step, which settle who precedes.
        cell: Where it stands.
        free: (5,) the moves that lead onto free cells of the map.
        scores: (5,) how much it wants each move.
        nearby: The other robots within two cells and where they stand.
        priority: Steps since it was on its goal.
    """

    def __init__(
        self,
        number: int,
        turn: tuple[int, int],
        cell: Cell,
        free: npt.NDArray[np.bool_],
        scores: npt.NDArray[np.float32],
        nearby: Mapping[int, Cell],
        priority: int,
    ) -> None:
        self.number, self.cell, self.turn = number, cell, turn
        self._order = [int(move) for move in np.argsort(-scores, kind="stable")]
        self._own = self._priority = min(priority, 2**16 - 1)
        self._moves = sum(1 << move for move in range(Action.IDLE) if free[move])
        self._known = {name: _Neighbour(place) for name, place in nearby.items()}
        self._precedes = {name: name >= 0 and self._rank(number) < self._rank(name) for name in nearby}
        self._wanted = self._order[0]
        self.committed: int | None = None
        """The move that the driver has accepted, or IDLE; None while it is open."""
        self._unsure = False

    @property
    def settled(self) -> bool:
        """True if it and all that it sees have committed, as far as it knows: there is nothing left to say."""
        return self.committed is not None and all(each.committed is not None for each in self._known.values())

    def heard_all(self, heard: set[int]) -> bool:
        """True if nobody is left to wait for in a round in which these robots were heard."""
        return all(name in heard or each.committed is not None for name, each in self._known.items())

    def message(self) -> bytes | None:
        """Return what it tells the robots within two cells in this round: five bytes, or None if it must be silent."""
        if self._unsure:
            return None
        return _BODY.pack(self._moves, self.committed is not None, self._wanted, self._priority)

    def hear(self, sender: int, body: bytes) -> None:
        """Take a message of this step, of any round, in any order and any number of times.

        Raises:
            ValueError: If it is not a message of this protocol.
        """
        if len(body) != _BODY.size:
            raise ValueError(f"a reservation has {_BODY.size} bytes, got {len(body)}")
        moves, committed, wanted, priority = _BODY.unpack(body)
        if moves > _ALL or committed > 1 or wanted > Action.IDLE or (committed and moves & (moves - 1)):
            raise ValueError("a reservation names moves that there are not, or is committed to several")
        known = self._known.get(sender)
        if known is None:
            return
        known.moves &= moves
        if committed:
            known.committed = moves.bit_length() - 1 if moves else int(Action.IDLE)
        known.wants, known.priority = _beyond(known.cell, wanted), priority

    def resolve(self, accept: Callable[[int], bool | None], *, last: bool) -> None:
        """Commit to a move if one is allowed; give up those that cannot be had.

        Args:
            accept: Hands a move to the driver; returns False if that is refused, None if no answer came.
            last: After this round there is none: what is not allowed now will not be made.
        """
        if self.committed is not None:
            return
        order = self._preferences()
        for move in range(Action.IDLE):
            if self._hopeless(move):
                self._moves &= ~(1 << move)
        for move in order:
            if move == Action.IDLE or (self._moves >> move & 1 and self._allowed(move)):
                self._commit(move, accept)
                return
            if self._moves >> move & 1 and not last:
                self._wanted = move
                return

    def _commit(self, move: int, accept: Callable[[int], bool | None]) -> None:
        answer = accept(move)
        if answer is None:
            self._unsure = move != Action.IDLE
        self.committed = move if answer else int(Action.IDLE)
        self._moves = 0 if self.committed == Action.IDLE else 1 << self.committed
        self._wanted = self.committed

    def _preferences(self) -> list[int]:
        """Return the moves in the order in which they are tried."""
        pushing = [each for each in self._known.values() if each.wants == self.cell and each.committed is None]
        urgent = max(pushing, key=lambda each: each.priority, default=None)
        if urgent is None or urgent.priority <= self._own:
            self._priority = self._own
            return self._order
        self._priority = urgent.priority
        away = [move for move in self._order if move != Action.IDLE and _beyond(self.cell, move) != urgent.cell]
        return [*away, int(Action.IDLE)]

    def _hopeless(self, move: int) -> bool:
        """True if the move will not be allowed in this step, or is left to a robot with higher priority."""
        target = _beyond(self.cell, move)
        for name, each in self._known.items():
            if each.cell == target:
                stays = each.committed == Action.IDLE or each.moves == 0
                swaps = each.committed is not None and _beyond(each.cell, each.committed) == self.cell
                if stays or swaps:
                    return True
            elif each.committed is not None:
                if _beyond(each.cell, each.committed) == target:
                    return True
            elif each.wants == target and (each.priority, not self._precedes[name]) > (self._priority, False):
                return True
        return False

    def _allowed(self, move: int) -> bool:
        """Return whether both rules of the protocol hold."""
        target = _beyond(self.cell, move)
        for name, each in self._known.items():
            if each.cell == target:
                if each.committed is None or _beyond(each.cell, each.committed) in (target, self.cell):
                    return False
            elif not self._precedes[name] and any(
                each.moves >> other & 1 and _beyond(each.cell, other) == target for other in range(Action.IDLE)
            ):
                return False
        return True

    def _rank(self, number: int) -> tuple[bytes, int]:
        return blake2b(struct.pack("<QQQ", *self.turn, number), digest_size=8).digest(), number


def _beyond(cell: Cell, move: int) -> Cell:
    row, col = STEPS[move]
    return cell[0] + row, cell[1] + col
