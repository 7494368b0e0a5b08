"""What the expert would do in the states that were visited: positions and moves, never observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import safetensors
import safetensors.numpy
import torch
from tensordict import TensorDict

from gnn_policy import symmetry
from gnn_policy.perception import Perception
from gnn_policy.policy_config import PolicyConfig
from gnn_policy.team_env import FOV, GRAPH
from mapf_env import Instance, rules
from mapf_env.files import replacing

EXPERT_ACTION = ("agents", "expert_action")


@dataclass(frozen=True, slots=True, eq=False)
class Demonstrations:
    """M labelled states of the training cases: 5 N + 4 bytes each."""

    cases: npt.NDArray[np.int32]
    """(M,) which case a state belongs to."""
    positions: npt.NDArray[np.int16]
    """(M, N, 2) where the robots stand."""
    actions: npt.NDArray[np.int8]
    """(M, N) what the expert does there."""

    def __len__(self) -> int:
        return len(self.cases)

    @staticmethod
    def concatenate(parts: Sequence[Demonstrations]) -> Demonstrations:
        """All states of `parts`, in order."""
        return Demonstrations(
            np.concatenate([part.cases for part in parts]),
            np.concatenate([part.positions for part in parts]),
            np.concatenate([part.actions for part in parts]),
        )

    def save(self, path: Path) -> None:
        """Write one file, as a whole or not at all."""
        arrays = {"cases": self.cases, "positions": self.positions, "actions": self.actions}
        with replacing(path) as draft:
            draft.write_bytes(safetensors.numpy.save(arrays))

    @staticmethod
    def load(path: Path) -> Demonstrations:
        """Read what `save` wrote.

        Raises:
            ValueError: If the file is damaged.
        """
        try:
            return Demonstrations(**safetensors.numpy.load_file(path))
        except (safetensors.SafetensorError, TypeError) as damage:
            raise ValueError(f"{path} is damaged ({damage}): delete the run folder and train anew") from None


class BatchMaker:
    """Rebuilds what robots observe in demonstrated states, under random symmetries of the world.

    Args:
        instances: The training cases, all of one size.
        config: What the policy perceives.
        augment: Turn and reflect every state at random.
    """

    def __init__(self, instances: Sequence[Instance], config: PolicyConfig, *, augment: bool) -> None:
        self._perception = Perception(config, instances)
        self._height, self._width = instances[0].grid.shape
        self._symmetries = symmetry.symmetries(self._height, self._width) if augment else np.array([0])
        known: dict[bytes, int] = {}
        self._map_of_case = np.array([known.setdefault(each.grid.tobytes(), len(known)) for each in instances])
        grids = np.frombuffer(b"".join(known), np.bool_).reshape(-1, self._height, self._width)
        self._goals = np.stack([each.goals for each in instances])
        self._obstacles = np.stack(
            [rules.bordered(symmetry.turn_maps(grids, g), config.fov_radius, np.uint8) for g in self._symmetries]
        )

    def batch(
        self, demonstrations: Demonstrations, chosen: npt.NDArray[np.integer], rng: np.random.Generator
    ) -> TensorDict:
        """Views, graphs and labels of the chosen states (B,), each under a symmetry drawn by `rng`."""
        cases = demonstrations.cases[chosen]
        choice = rng.integers(len(self._symmetries), size=len(chosen))
        turn = self._symmetries[choice]
        goals = self._turn(self._goals[cases], turn)
        positions = self._turn(demonstrations.positions[chosen], turn)
        obstacles = self._obstacles[choice, self._map_of_case[cases]]
        fov, graph = self._perception.observe(cases, obstacles, positions, goals)
        labels = symmetry.ACTIONS[turn[:, None], demonstrations.actions[chosen]].astype(np.int64)
        tensors = {key: torch.from_numpy(array) for key, array in ((FOV, fov), (GRAPH, graph), (EXPERT_ACTION, labels))}
        return TensorDict(tensors, batch_size=[len(chosen)])

    def _turn(self, cells: npt.NDArray[np.integer], turn: npt.NDArray[np.intp]) -> npt.NDArray[np.int32]:
        return np.ascontiguousarray(symmetry.turn_cells(cells, turn[:, None], self._height, self._width))
