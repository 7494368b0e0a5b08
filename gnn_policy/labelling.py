"""Labels for training: the expert's joint move in each of many states, or its plan from there."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

import experts
from experts.many import SOLVER_NAMES
from gnn_policy.cases import Task
from gnn_policy.config import RobotOrder
from gnn_policy.demonstrations import Demonstrations
from gnn_policy.plugins import import_by_name
from mapf_env import MOVES, Action, Instance, Solution, States
from mapf_env.hashing import mix


class Labeller:
    """An expert that labels states on known maps.

    Args:
        grids: The maps, as the states number them.
        solver: One of the solvers that `experts.solve_many` knows by name, or "module:function".
        w: ECBS's bound on suboptimality; other solvers are asked without one.
        robot_order: The order in which it is given the robots of a state; it breaks ties by that.
        node_limit: Nodes that ECBS or LaCAM may generate for a state.
        rounds: Rounds of the neighbourhood search where the first steps of plans are labelled.
        threads: CPU threads.
        clock: The clock that `seconds` are measured by.
        cluster: The address of a Ray cluster that labels the states, as in `experts.solve_many`.

    Raises:
        ValueError: If the solver is unknown.
    """

    def __init__(
        self,
        grids: Sequence[npt.NDArray[np.bool_]],
        *,
        solver: str = "ecbs",
        w: float,
        robot_order: RobotOrder = "index",
        node_limit: int,
        rounds: int = 400,
        threads: int,
        clock: Callable[[], float] = time.monotonic,
        cluster: str | None = None,
    ) -> None:
        self._grids, self._w, self._robot_order = grids, w, robot_order
        self._node_limit, self._rounds, self._clock = node_limit, rounds, clock
        self._where: dict[str, Any] = {"threads": threads, "cluster": cluster}
        self._solver = solver if solver in SOLVER_NAMES else import_by_name(solver, "the expert", SOLVER_NAMES)
        self.seconds = 0.0
        """Seconds spent in the expert so far."""

    def moves(self, states: States, task: Task = "one_shot") -> tuple[npt.NDArray[np.int8], npt.NDArray[np.bool_]]:
        """Return the moves (R,) of all robots and which of the T states the expert solved; the others idle.

        In lifelong tasks the planner with a rolling horizon takes the place of ECBS, whose plans end at goals which
        change on arrival.
        """
        if not len(states):
            return np.empty(0, np.int8), np.empty(0, np.bool_)
        if self._solver != "ecbs":
            plans = self.plans(states)
            moves = np.full(states.num_robots, Action.IDLE, np.int8)
            for t, plan in enumerate(plans):
                if plan is not None and len(plan.paths) > 1:
                    moves[states.offsets[t] : states.offsets[t + 1]] = Solution(plan.paths[:2]).actions[0]
            return moves, np.array([plan is not None for plan in plans], np.bool_)
        began = self._clock()
        order = self._order(states)
        if task == "lifelong":
            labels = experts.next_moves(self._instances(states, order), **self._where)
            solved = np.ones(len(states), np.bool_)
        else:
            labels, solved = experts.relabel(
                self._problems(states, order),
                states.positions[order],
                offsets=states.offsets,
                w=self._w,
                node_limit=self._node_limit,
                **self._where,
            )
        moves = np.empty(states.num_robots, np.int8)
        moves[order] = labels
        self.seconds += self._clock() - began
        return moves, solved

    def plans(self, states: States) -> list[Solution | None]:
        """Return the plan from each of T states, or None where the expert did not solve it.

        Plans without a proof are left out, too: `w` sets how good the labels are.
        """
        if not len(states):
            return []
        began = self._clock()
        order = self._order(states)
        results = experts.solve_many(
            self._instances(states, order),
            solver=self._solver,
            w=self._w if self._solver == "ecbs" else None,
            **self._where,
            time_limit=math.inf,
            node_limit=self._node_limit,
        )
        plans: list[Solution | None] = []
        for first, last, result in zip(states.offsets[:-1], states.offsets[1:], results, strict=True):
            back = (order[first:last] - first).argsort()
            plan = result.solution if result.solved else None
            plans.append(None if plan is None else Solution(plan.paths[:, back]))
        self.seconds += self._clock() - began
        return plans

    def _order(self, states: States) -> npt.NDArray[np.intp]:
        """Return the rows (R,) of all robots, state by state in the order in which the expert is given them."""
        team = states.team
        if self._robot_order == "index":
            return np.arange(states.num_robots)
        if self._robot_order == "random":
            # A function of the state: its map, and all its robots' cells.
            cells = states.positions.astype(np.uint64)
            key = np.repeat(states.maps.astype(np.uint64), np.diff(states.offsets))
            robots = mix(mix(key, cells[:, 0]), cells[:, 1])
            key = mix(np.add.reduceat(robots, states.offsets[:-1])[team], robots)
        else:
            key = np.abs(states.positions.astype(np.int64) - states.goals).sum(axis=1)
            key = key if self._robot_order == "nearest" else -key
        return np.lexsort((np.arange(states.num_robots), key, team))

    def _problems(self, states: States, order: npt.NDArray[np.intp]) -> list[Instance]:
        """Return the problem of each state, one object for all states with the same map and goals."""
        positions, goals = states.positions[order].astype(np.int32), states.goals[order].astype(np.int32)
        known: dict[tuple[int, bytes], Instance] = {}
        problems = []
        for number, first, last in zip(states.maps.tolist(), states.offsets[:-1], states.offsets[1:], strict=True):
            key = number, goals[first:last].tobytes()
            if key not in known:
                known[key] = Instance(self._grids[number], positions[first:last], goals[first:last])
            problems.append(known[key])
        return problems

    def _instances(self, states: States, order: npt.NDArray[np.intp]) -> list[Instance]:
        """Return each state as an instance: its robots start where they stand."""
        spans = zip(self._problems(states, order), states.offsets[:-1], states.offsets[1:], strict=True)
        return [problem.at(states.positions[order[first:last]]) for problem, first, last in spans]

    def demonstrate(self, states: States, steps: int | None = None) -> tuple[Demonstrations, int]:
        """Return the states on the plans from the given ones, labelled, and how many states were not solved.

        Args:
            states: The states to plan from.
            steps: Steps of each plan to label; all of them if not given.
        """
        if steps is not None and self._solver == "ecbs":
            return self._label_plans(states, steps)
        parts = [Demonstrations(states.take(np.empty(0, np.intp)), np.empty(0, np.int8))]
        plans = self.plans(states)
        for t, plan in enumerate(plans):
            if plan is not None:
                parts += _along(states.take(np.array([t])), plan, steps)
        return Demonstrations.concatenate(parts), sum(plan is None for plan in plans)

    def _label_plans(self, states: States, steps: int) -> tuple[Demonstrations, int]:
        """Label the first steps of plans by the experts' cascade of ECBS and LaCAM, which solves crowds."""
        began = self._clock()
        order = self._order(states)
        labels = experts.label_plans(
            self._instances(states, order),
            steps=steps,
            w=self._w,
            node_limit=self._node_limit,
            rounds=self._rounds,
            **self._where,
        )
        self.seconds += self._clock() - began
        parts = [Demonstrations(states.take(np.empty(0, np.intp)), np.empty(0, np.int8))]
        here, sources = states, np.arange(len(states))
        for step in range(steps):
            found = np.flatnonzero(labels.time == step)
            if not len(found):
                break
            here = here.take(np.isin(sources, labels.source[found]))
            sources = labels.source[found]
            robots = order[states.rows(sources)]  # the robots in the order of the labels, as rows of the given states
            place = robots - np.repeat(states.offsets[sources] - here.offsets[:-1], np.diff(here.offsets))
            rows = _rows_of(labels.offsets, found)
            actions = np.empty(here.num_robots, np.int8)
            positions = np.empty((here.num_robots, 2), np.int32)
            actions[place], positions[place] = labels.actions[rows], labels.positions[rows]
            here = replace(here, positions=positions)
            parts.append(Demonstrations(here, actions))
            here = _after(here, actions)
        return Demonstrations.concatenate(parts), int((~labels.solved).sum())

    def label(self, states: States, task: Task = "one_shot") -> tuple[Demonstrations, int]:
        """Return the given states, in their order, labelled, and how many were not solved.

        A state that was visited often counts as often, so states where teams make no progress weigh more; it is solved
        once.
        """
        numbers: dict[tuple[int, bytes, bytes], int] = {}
        first, which = [], np.empty(len(states), np.intp)
        for t in range(len(states)):
            rows = slice(states.offsets[t], states.offsets[t + 1])
            key = int(states.maps[t]), states.positions[rows].tobytes(), states.goals[rows].tobytes()
            which[t] = numbers.setdefault(key, len(numbers))
            if which[t] == len(first):
                first.append(t)
        distinct = states.take(np.array(first, np.intp))
        moves, solved = self.moves(distinct, task)
        labelled = np.flatnonzero(solved[which])
        return (
            Demonstrations(states.take(labelled), moves[distinct.rows(which[labelled])]),
            int((~solved[which]).sum()),
        )


def _along(state: States, plan: Solution, steps: int | None) -> list[Demonstrations]:
    """Return the states on the first steps of a plan from one state, with the plan's moves; all if None is given."""
    parts = []
    for actions in plan.actions[: plan.makespan][:steps]:
        parts.append(Demonstrations(state, actions))
        state = _after(state, actions)
    return parts


def _after(states: States, actions: npt.NDArray[np.int8]) -> States:
    """Return the states after the moves (R,) of all robots."""
    positions = (states.positions + MOVES[actions]).astype(np.int32)
    on_goal = (positions == states.goals).all(axis=1)
    return replace(
        states,
        positions=positions,
        moves=np.column_stack([actions, states.moves[:, :-1]]),
        under_way=np.where(on_goal, 0, states.under_way + 1).astype(np.int32),
        times=states.times + 1,
    )


def _rows_of(offsets: npt.NDArray[np.integer], chosen: npt.NDArray[np.integer]) -> npt.NDArray[np.intp]:
    """Return the rows of the robots of the chosen states, of which state s has rows offsets[s]:offsets[s + 1]."""
    return np.concatenate([np.arange(int(offsets[s]), int(offsets[s + 1])) for s in chosen])
