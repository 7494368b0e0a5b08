"""A planner for lifelong tasks: it plans all robots a few steps ahead, again after each step."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

from experts import _native, arguments
from experts.cluster import map_cases
from mapf_env.instance import Instance, as_obstacles


class RollingHorizon:
    """Plans joint moves for teams whose goals change while they move, as in the lifelong task.

    Rolling-horizon collision resolution (Li et al. 2021, "Lifelong multi-agent path finding in large-scale
    warehouses"): plans have `window` steps without a conflict, and after `execute` of them the robots plan again. PIBT
    with swap makes a first plan of each window, so there always is one; large neighbourhood search improves it (Jiang
    et al. 2024, "Scaling lifelong multi-agent path finding to more realistic settings"). There is no time limit, so
    equal calls give equal moves.

    Args:
        grid: The map (H, W), True on obstacles. Distances to goals are kept, two bytes for each cell and goal.
        window: Steps to plan ahead.
        execute: Steps to execute of each plan, at most `window`; 1 plans before every step.
        rounds: Rounds of the neighbourhood search on each plan; more rounds bring more arrivals per step and take
            longer.
        seed: Random seed for ties and neighbourhoods.

    Raises:
        ValueError: If an argument is out of its range.
        TypeError: If an argument has the wrong type.
    """

    def __init__(
        self,
        grid: npt.ArrayLike,
        *,
        window: int = arguments.DEFAULT_WINDOW,
        execute: int = 1,
        rounds: int = arguments.DEFAULT_WINDOW_ROUNDS,
        seed: int = 0,
    ) -> None:
        window = arguments.at_least_one(window, "window", maximum=arguments.MAX_WINDOW)
        rounds = arguments.at_least_one(rounds, "rounds", maximum=arguments.MAX_ROUNDS)
        self._execute = arguments.at_least_one(execute, "execute", maximum=window)
        self._native = _native.RollingHorizon(as_obstacles(grid), window, rounds, arguments.seed(seed))
        self._plan = np.zeros((0, 0), np.int8)
        self._expected = np.zeros((0, 2), np.int32)
        self._time = 0

    def act(self, positions: npt.ArrayLike, goals: npt.ArrayLike) -> npt.NDArray[np.int8]:
        """Return the next joint action.

        Robots that are not where the last plan left them, as in a new episode, are planned from their positions.

        Args:
            positions: (N, 2) integers, the row and column of each robot.
            goals: (N, 2) integers, the current goal of each robot.

        Returns:
            (N,) int8, the `Action` of each robot. Together they have no conflict.

        Raises:
            ValueError: If shapes do not fit, or a robot or its goal is off the map, on an obstacle or out of reach.
            TypeError: If an array does not hold integers.
            KeyboardInterrupt: On Ctrl-C.
        """
        here = arguments.cells(positions, "positions", "(N, 2)")
        there = arguments.cells(goals, "goals", "(N, 2)")
        if len(there) != len(here) or len(here) == 0:
            raise ValueError(f"give a goal for each robot and at least one: {len(here)} positions, {len(there)} goals")
        follows = np.array_equal(here, self._expected)
        if not follows or self._time == self._execute:
            self._plan = self._native.plan(here, there, self._time if follows else 0)
            self._time = 0
        actions = self._plan[self._time]
        self._expected = here + _STEPS[actions]
        self._time += 1
        return actions


_MOST_IN_PART = 256
"""States that a worker of a cluster plans at a time."""
_STEPS = np.array([(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)], np.int32)


def next_moves(
    instances: Sequence[Instance],
    *,
    window: int = arguments.DEFAULT_WINDOW,
    rounds: int = arguments.DEFAULT_WINDOW_ROUNDS,
    threads: int = 1,
    seed: int = 0,
    cluster: str | None = None,
) -> npt.NDArray[np.int8]:
    """Return the next joint action of a `RollingHorizon` in each of many states: labels for lifelong tasks.

    Each state is planned afresh, as by `RollingHorizon(grid, ...).act(starts, goals)`.

    Args:
        instances: The states: where robots are, and their current goals. Teams and maps may differ.
        window: As for `RollingHorizon`.
        rounds: As for `RollingHorizon`.
        threads: Threads to share the states; the moves do not depend on it.
        seed: As for `RollingHorizon`.
        cluster: The address of a Ray cluster whose workers plan the states, as in `solve_many`.

    Returns:
        (R,) int8, the `Action` of each robot of all states, one state after the other.

    Raises:
        ValueError: If an argument is out of its range.
        TypeError: If an argument has the wrong type.
        KeyboardInterrupt: On Ctrl-C.
    """
    problems = list(arguments.each_of(instances, Instance, "instances"))
    limits = {
        "window": arguments.at_least_one(window, "window", maximum=arguments.MAX_WINDOW),
        "rounds": arguments.at_least_one(rounds, "rounds", maximum=arguments.MAX_ROUNDS),
        "seed": arguments.seed(seed),
    }
    threads = arguments.at_least_one(threads, "threads", maximum=arguments.MOST_THREADS)
    if cluster is not None and problems:
        plan = partial(next_moves, **limits)
        return np.concatenate(
            map_cases(plan, problems, arguments.address(cluster), workers=threads, most=_MOST_IN_PART)
        )
    return _native.next_moves([(each.grid, each.starts, each.goals) for each in problems], threads=threads, **limits)
