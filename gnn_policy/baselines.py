"""Teams that learn nothing, to compare a policy with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gnn_policy.execution import STUCK_MEMORY, is_stuck, robot_seeds, uniform
from gnn_policy.rollout import Teams
from mapf_env import MOVES, Instance, _native


class RandomActor:
    """Every robot draws one of the five moves."""

    border, memory = 1, 0

    def act(self, teams: Teams) -> npt.NDArray[np.int64]:
        """Uniform moves."""
        return _random_moves(teams)


class GreedyActor:
    """Every robot takes a move that shortens its way, drawn if there are several; it knows the map, but no robots.

    With `random_when_stuck` a robot that `is_stuck` draws one of the five moves instead.
    """

    border = 1

    def __init__(self, instances: Sequence[Instance], *, random_when_stuck: bool = False) -> None:
        self.memory = STUCK_MEMORY if random_when_stuck else 0
        self.distances = np.stack([_native.distances(each.grid, each.goals) for each in instances])

    def act(self, teams: Teams) -> npt.NDArray[np.int64]:
        """The move to the neighbouring cell nearest to the goal; idle on the goal."""
        neighbours = teams.positions[:, :, None, :] + MOVES
        height, width = self.distances.shape[2:]
        rows, cols = neighbours[..., 0].clip(0, height - 1), neighbours[..., 1].clip(0, width - 1)
        team, robot = np.ogrid[: neighbours.shape[0], : neighbours.shape[1]]
        steps = self.distances[teams.cases[team, None], robot[..., None], rows, cols]
        inside = (neighbours == np.stack([rows, cols], -1)).all(-1)
        greedy = np.where(inside & (steps >= 0), steps + _draws(teams), np.inf).argmin(-1)
        if self.memory == 0:
            return greedy
        return np.where(is_stuck(teams.positions, teams.goals, teams.past), _random_moves(teams), greedy)


def _random_moves(teams: Teams) -> npt.NDArray[np.int64]:
    return _draws(teams).argmax(-1)


def _draws(teams: Teams) -> npt.NDArray[np.float64]:
    return uniform(robot_seeds(teams.seeds, teams.positions.shape[1]), teams.time, len(MOVES))
