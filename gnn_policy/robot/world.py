"""The simulated world of a swarm: what its robots sense in each step, and what becomes of the moves that they chose."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import numpy.typing as npt

from gnn_policy.execution import Execution, episode_seeds, robot_seeds
from gnn_policy.policy_config import PolicyConfig
from gnn_policy.robot.driver import Sensed
from gnn_policy.robot.reservation import SIGHT, STEPS
from mapf_env import Action, BatchedEnv, Instance, Solution

ShieldedBy = Literal["robots", "world"]


class CollisionError(RuntimeError):
    """Robots that shield themselves would have collided or left the free cells: a law of the project is broken."""


class World:
    """An instance that robots of a policy move in, one step after another, exactly as `gnn_policy.rollout` plays it.

    Args:
        instance: The map, the starts and the goals.
        policy: What the robots perceive.
        execution: How the policy is executed; its shield is used if the world shields the team.
        shielded_by: "robots": moves are executed as they come, and a judge of its own stops the world if they collide;
            "world": the execution's shield sees all robots and replaces moves.
        seed: As in `rollout`.
        max_steps: Steps after which the episode ends.
    """

    def __init__(
        self,
        instance: Instance,
        policy: PolicyConfig,
        execution: Execution,
        *,
        shielded_by: ShieldedBy = "robots",
        seed: int = 0,
        max_steps: int = 128,
    ) -> None:
        self.instance, self.shielded_by, self.execution = instance, shielded_by, execution
        settings = execution.env_settings(policy)
        if shielded_by == "robots":
            settings["shield"] = "idle"
        height, width = instance.grid.shape
        self._env = BatchedEnv(
            1, fill=True, num_agents=instance.num_agents, height=height, width=width, style="empty", **settings
        )
        self._low, self._unit = (each[:, None, None] for each in (policy.channel_low, policy.channel_unit))
        seeds = episode_seeds([instance], [seed])
        self._env.reset(seeds.tolist(), instances=[instance], max_cycles=[max_steps], observe=False)
        self.seeds = robot_seeds(np.repeat(self._env.seeds, instance.num_agents), np.arange(instance.num_agents))
        """(N,) the seeds of the robots' draws."""
        self.paths = [self._env.positions[0]]
        """The positions (N, 2) at each time so far."""

    @property
    def step_number(self) -> int:
        """Steps so far."""
        return len(self.paths) - 1

    @property
    def running(self) -> bool:
        """False once all robots are on their goals at once, or the steps are over."""
        return bool(self._env.running[0]) and not bool((self.paths[-1] == self.instance.goals).all())

    @property
    def solution(self) -> Solution:
        """The paths so far."""
        return Solution(np.stack(self.paths))

    def sense(self) -> dict[int, Sensed]:
        """Return what each robot perceives now, by its number."""
        bag, positions = self._env.bag(), self.paths[-1]
        count = len(positions)
        views = np.asarray(bag.fov, np.float32)
        if bag.fov.dtype == np.uint8:
            views = views / self._unit + self._low
        far = np.abs(positions[:, None] - positions[None]).sum(-1)
        cells = [(int(row), int(col)) for row, col in positions]
        sensed = {}
        for i in range(count):
            own = np.flatnonzero(bag.edge_index[1] == i)
            senders = bag.edge_index[0][own].tolist()
            near = np.flatnonzero((far[i] <= SIGHT) & (np.arange(count) != i)).tolist()
            sensed[i] = Sensed(
                *(self.step_number, cells[i], views[i], bag.scalars[i]),
                dict(zip(senders, bag.edge_weight[own].tolist(), strict=True)),
                dict(zip(senders, bag.edge_attr[own], strict=True)),
                {j: cells[j] for j in near},
            )
        return sensed

    def execute(self, moves: Mapping[int, int]) -> None:
        """Carry out the moves of robots that shield themselves; a robot without one stays.

        Raises:
            CollisionError: If two robots would collide, or one would leave the free cells.
        """
        before = self.paths[-1]
        after = [(int(row), int(col)) for row, col in before]
        for robot, move in moves.items():
            after[robot] = (after[robot][0] + STEPS[move][0], after[robot][1] + STEPS[move][1])
        self._judge(after)
        wanted = np.full((1, len(after)), Action.IDLE)
        wanted[0, list(moves)] = list(moves.values())
        self._take(wanted)

    def execute_shielded(self, scores: Mapping[int, npt.NDArray[np.float32]]) -> None:
        """Carry out what robots want under the world's shield; one that is silent stays.

        Raises:
            ValueError: If a robot is silent and the shield is one that moves robots aside: it cannot move this one.
        """
        silent = sorted(set(range(self.instance.num_agents)) - scores.keys())
        if silent and self.execution.shield != "idle":
            raise ValueError(
                f"robot {silent[0]} is silent, and the world's shield {self.execution.shield!r} would move it: let the "
                "robots shield themselves"
            )
        stay = np.eye(len(Action), dtype=np.float32)[Action.IDLE]
        wanted = np.stack([scores.get(robot, stay) for robot in range(self.instance.num_agents)])[None]
        self._take(wanted if self.execution.shield != "idle" else wanted.argmax(-1))

    def _take(self, wanted: npt.NDArray[np.generic]) -> None:
        self._env.step(wanted, observe=False)
        self.paths.append(self._env.positions[0])

    def _judge(self, after: list[tuple[int, int]]) -> None:
        before = [(int(row), int(col)) for row, col in self.paths[-1]]
        grid, when = self.instance.grid, f"in step {self.step_number}"
        there: dict[tuple[int, int], int] = {}
        for robot, (row, col) in enumerate(after):
            if not (0 <= row < grid.shape[0] and 0 <= col < grid.shape[1]) or grid[row, col]:
                raise CollisionError(f"robot {robot} would enter ({row}, {col}), which is not free, {when}")
            if (row, col) in there:
                raise CollisionError(f"robots {there[row, col]} and {robot} would collide at ({row}, {col}) {when}")
            there[row, col] = robot
        for robot, cell in enumerate(after):
            other = there.get(before[robot], robot)
            if other != robot and before[other] == cell:
                raise CollisionError(f"robots {robot} and {other} would swap their cells {when}")
