"""Visited states with the expert's moves, as training data; observations are rebuilt when batches are drawn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt
import safetensors
import safetensors.numpy
import torch
from tensordict import TensorDict

from gnn_policy import symmetry
from gnn_policy.acting import tensors
from gnn_policy.imitation import EXPERT_ACTION
from mapf_env import MapSet, Senses, States, perceive
from mapf_env.files import replacing

Parts = Sequence[npt.NDArray[np.integer]]
"""The states of a batch by their numbers, in parts whose gradients are computed side by side."""


@dataclass(frozen=True, slots=True, eq=False)
class Demonstrations:
    """M labelled states of teams of any sizes, R robots in all."""

    states: States
    """The M states, their maps numbered as the training maps are."""
    actions: npt.NDArray[np.int8]
    """(R,) the expert's move of each robot."""

    def __len__(self) -> int:
        return len(self.states)

    @staticmethod
    def concatenate(parts: Sequence[Demonstrations]) -> Demonstrations:
        """Return all states of `parts`, in order."""
        return Demonstrations(
            States.concatenate([part.states for part in parts]), np.concatenate([part.actions for part in parts])
        )

    def take(self, chosen: npt.NDArray[np.integer]) -> Demonstrations:
        """Return the chosen states (B,), in that order."""
        return Demonstrations(self.states.take(chosen), self.actions[self.states.rows(chosen)])

    def save(self, path: Path) -> None:
        """Write one file, as a whole or not at all."""
        arrays = {each.name: getattr(self.states, each.name) for each in fields(States)}
        with replacing(path) as draft:
            draft.write_bytes(safetensors.numpy.save({**arrays, "actions": self.actions}))

    @staticmethod
    def load(path: Path) -> Demonstrations:
        """Read what `save` wrote.

        Raises:
            ValueError: If the file is damaged.
        """
        try:
            arrays = safetensors.numpy.load_file(path)
            actions = arrays.pop("actions")
            return Demonstrations(States(**arrays), actions)
        except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as damage:
            raise ValueError(f"{path} is damaged ({damage}): delete the run folder and train again") from None


class BatchMaker:
    """Rebuilds what robots perceive in demonstrated states, under random symmetries of the grid.

    Args:
        grids: The training maps.
        senses: What the policy's robots perceive.
        augment: Rotate and reflect every state at random.
        threads: CPU threads.
    """

    def __init__(
        self, grids: Sequence[npt.NDArray[np.bool_]], senses: Senses, *, augment: bool, threads: int = 1
    ) -> None:
        self._senses, self._threads = senses, threads
        self._symmetries = 8 if augment else 1
        self._shapes = np.array([grid.shape for grid in grids])
        turned = [symmetry.turn_map(grid, g) for grid in grids for g in range(self._symmetries)]
        self._maps = MapSet(turned, senses.fov_radius, "uint8")

    def batch(
        self, demonstrations: Demonstrations, chosen: npt.NDArray[np.integer], rng: np.random.Generator
    ) -> TensorDict:
        """Return what `ImitationLoss` reads: the bag of the chosen states (B,) and their labels (M,).

        Each state is under a symmetry drawn by `rng`.
        """
        picked = demonstrations.take(chosen)
        states = picked.states
        turn = rng.integers(self._symmetries, size=len(states))
        turn_of = turn[states.team]
        shapes = self._shapes[states.maps][states.team]
        turned = States(
            maps=self._maps.index[states.maps * self._symmetries + turn],
            offsets=states.offsets,
            positions=symmetry.turn_cells(states.positions, turn_of, shapes),
            goals=symmetry.turn_cells(states.goals, turn_of, shapes),
            moves=symmetry.turn_actions(states.moves, turn_of[:, None]),
            under_way=states.under_way,
            seeds=states.seeds,
            times=states.times,
            limits=states.limits,
            comm_radius=states.comm_radius,
        )
        bag = perceive(turned, self._maps, self._senses, threads=self._threads)
        labels = symmetry.turn_actions(picked.actions, turn_of).astype(np.int64)
        return TensorDict({**tensors(bag)._asdict(), EXPERT_ACTION: torch.from_numpy(labels)})

    def batches(
        self, demonstrations: Demonstrations, draws: Sequence[Parts], rng: np.random.Generator, *, ahead: bool
    ) -> Iterator[list[TensorDict]]:
        """Yield the parts of each batch that was drawn.

        Args:
            demonstrations: The states to draw from.
            draws: The numbers of the states in each batch.
            rng: Draws the symmetries.
            ahead: Prepare the next batch while the current one is in use. That is faster if another device computes,
                and slower on a CPU whose cores are all busy.
        """

        def make(parts: Parts) -> list[TensorDict]:
            return [self.batch(demonstrations, chosen, rng) for chosen in parts]

        if not ahead:
            yield from map(make, draws)
            return
        with ThreadPoolExecutor(1) as maker:
            waiting = None
            for parts in draws:
                after = maker.submit(make, parts)
                if waiting is not None:
                    yield waiting.result()
                waiting = after
            if waiting is not None:
                yield waiting.result()


_ATTEMPTS = 8


class Filler:
    """Draws states of teams of any sizes that have a given number of robots together.

    The operations of a network are fastest on arrays of always the same size.

    Args:
        sizes: (M,) the robots in each state.
        newest: The first of the states that count as new.
        fresh_share: Share of the draws among the new states; the others are among all.
        rng: Makes the draws.
    """

    def __init__(
        self, sizes: npt.NDArray[np.integer], newest: int, fresh_share: float, rng: np.random.Generator
    ) -> None:
        self._sizes, self._newest, self._fresh_share, self._rng = sizes, newest, fresh_share, rng
        order = sizes.argsort(kind="stable")
        kinds, first = np.unique(sizes[order], return_index=True)
        self._of_size = dict(zip(kinds.tolist(), np.split(order, first[1:]), strict=True))

    def __call__(self, robots: int) -> npt.NDArray[np.intp]:
        """Return states with exactly this number of robots, or a few less if no team has the missing number."""
        for _ in range(_ATTEMPTS):
            drawn, filled = self._draw(robots)
            for number in range(len(drawn), max(len(drawn) - 2, -1), -1):
                missing = robots - int(filled[number])
                if missing == 0:
                    return drawn[:number]
                if missing in self._of_size:
                    return np.append(drawn[:number], self._rng.choice(self._of_size[missing]))
        drawn, _ = self._draw(robots)
        return drawn if len(drawn) else self._rng.integers(len(self._sizes), size=1)

    def _draw(self, robots: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.integer]]:
        """Return as many states as fit, n of them, and how many robots the first 0..n of them have."""
        count = robots // min(self._of_size)
        first = np.where(self._rng.random(count) < self._fresh_share, self._newest, 0)
        drawn = self._rng.integers(first, len(self._sizes))
        filled = np.append(0, self._sizes[drawn].cumsum())
        most = int(filled.searchsorted(robots, side="right")) - 1
        return drawn[:most], filled[: most + 1]
