"""Dataset aggregation: play a mixture of expert and policy, and ask the expert about the states that are visited.

Source: Ross, Gordon and Bagnell 2011 (DAgger). What matters there holds here: the states come from the mixture, the
labels from the expert alone, and the data of all rounds are kept. The variant that asks only where teams are stuck is
that of the paper's released code.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.nn.functional import one_hot
from torchrl.collectors import BaseCollector, Collector

import experts
from experts.many import SOLVER_NAMES
from gnn_policy.config import Backend, RobotOrder, TrainConfig
from gnn_policy.demonstrations import Demonstrations
from gnn_policy.finite import require_finite
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.plugins import import_by_name
from gnn_policy.precision import autocast
from gnn_policy.ranks import Ranks
from gnn_policy.team_env import ACTION, CASE, FOV, GRAPH, POSITIONS, TeamEnv
from mapf_env import Action, Instance, Solution, _native


class Teacher:
    """The expert, as training asks it: for the joint move in each of many states of known cases, or for its plan there.

    Args:
        instances: The training cases.
        solver: The expert: one of the solvers that `experts.solve_many` knows by name, or "module:function".
        w: ECBS's bound on suboptimality; other solvers are asked without one.
        robot_order: In which order it is given the robots of a state; it breaks ties by that.
        node_limit: ECBS's and LaCAM's effort for a state.
        threads: CPU threads.
        clock: What `seconds` are measured by.

    Raises:
        ValueError: If there is no such solver.
    """

    def __init__(
        self,
        instances: Sequence[Instance],
        *,
        solver: str = "ecbs",
        w: float,
        robot_order: RobotOrder = "index",
        node_limit: int,
        threads: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._instances, self._w, self._robot_order = instances, w, robot_order
        self._node_limit, self._threads, self._clock = node_limit, threads, clock
        self._solver = solver if solver in SOLVER_NAMES else import_by_name(solver, "the teacher", SOLVER_NAMES)
        self._goals = np.stack([each.goals for each in instances])
        self.seconds = 0.0
        """Time that it has taken to answer, so far."""

    def moves(
        self, cases: npt.NDArray[np.integer], positions: npt.NDArray[np.integer]
    ) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.bool_]]:
        """Joint moves (M, N) in M states (M, N, 2) of the given cases (M,), and which of them the expert solved."""
        if self._solver != "ecbs":
            plans = self.plans(cases, positions)
            moves = np.full(positions.shape[:2], Action.IDLE, np.int8)
            for state, plan in enumerate(plans):
                if plan is not None and len(plan.paths) > 1:
                    moves[state] = Solution(plan.paths[:2]).actions[0]
            return moves, np.array([plan is not None for plan in plans], np.bool_)
        began = self._clock()
        order = self._order(cases, positions)
        instances = [self._instances[i] for i in cases]
        if self._robot_order != "index":
            instances, positions = self._ordered(cases, positions, order), _rows(positions, order)
        moves, solved = experts.relabel(
            instances, positions, w=self._w, node_limit=self._node_limit, threads=self._threads
        )
        moves = _rows(moves, order.argsort(axis=1))
        self.seconds += self._clock() - began
        return moves, solved

    def plans(self, cases: npt.NDArray[np.integer], positions: npt.NDArray[np.integer]) -> list[Solution | None]:
        """The plan from each of M states, or None where the expert found none."""
        began = self._clock()
        order = self._order(cases, positions)
        results = experts.solve_many(
            self._ordered(cases, positions, order),
            solver=self._solver,
            w=self._w if self._solver == "ecbs" else None,
            threads=self._threads,
            time_limit=math.inf,
            node_limit=self._node_limit,
        )
        plans = [
            None if result.solution is None else Solution(result.solution.paths[:, back])
            for result, back in zip(results, order.argsort(axis=1), strict=True)
        ]
        self.seconds += self._clock() - began
        return plans

    def _order(self, cases: npt.NDArray[np.integer], positions: npt.NDArray[np.integer]) -> npt.NDArray[np.intp]:
        """(M, N) the robots of each state in the order in which the expert is given them, a function of the state."""
        M, N = positions.shape[:2]
        if self._robot_order == "index":
            return np.tile(np.arange(N), (M, 1))
        if self._robot_order == "random":
            state = cases.astype(np.uint64)
            for coordinates in positions.reshape(M, -1).T.astype(np.uint64):
                state = _native.mix(state, np.ascontiguousarray(coordinates))
            robots = np.tile(np.arange(N, dtype=np.uint64), M)
            return _native.mix(np.repeat(state, N), robots).reshape(M, N).argsort(axis=1)
        distances = np.abs(positions.astype(np.int64) - self._goals[cases]).sum(axis=2)
        return (distances if self._robot_order == "nearest" else -distances).argsort(axis=1, kind="stable")

    def _ordered(
        self, cases: npt.NDArray[np.integer], positions: npt.NDArray[np.integer], order: npt.NDArray[np.intp]
    ) -> list[Instance]:
        return [
            Instance(self._instances[case].grid, state[robots], self._goals[case][robots])
            for case, state, robots in zip(cases, positions, order, strict=True)
        ]

    def demonstrate(
        self, cases: npt.NDArray[np.integer], positions: npt.NDArray[np.integer]
    ) -> tuple[Demonstrations, int]:
        """Demonstrations of all states on the plans from the given ones, and how many the expert could not solve."""
        N, unsolved = positions.shape[1], 0
        parts = [Demonstrations(np.empty(0, np.int32), np.empty((0, N, 2), np.int16), np.empty((0, N), np.int8))]
        for case, plan in zip(cases, self.plans(cases, positions), strict=True):
            if plan is None:
                unsolved += 1
                continue
            steps = plan.makespan
            parts.append(
                Demonstrations(
                    np.full(steps, case, np.int32), plan.paths[:steps].astype(np.int16), plan.actions[:steps]
                )
            )
        return Demonstrations.concatenate(parts), unsolved

    def label(self, cases: npt.NDArray[np.integer], positions: npt.NDArray[np.integer]) -> tuple[Demonstrations, int]:
        """Demonstrations of the given states, in their order, and how many the expert could not solve.

        A state that was visited often counts as often, so states where teams are stuck weigh more; it is solved once.
        """
        rows = np.column_stack([cases, positions.reshape(len(cases), -1)]).astype(np.int32)
        _, first, which = np.unique(
            rows.view(np.dtype((np.void, rows.strides[0]))).ravel(), return_index=True, return_inverse=True
        )
        actions, solved = self.moves(cases[first], positions[first])
        actions, solved = actions[which], solved[which]
        labelled = Demonstrations(
            cases[solved].astype(np.int32), positions[solved].astype(np.int16), actions[solved].astype(np.int8)
        )
        return labelled, int((~solved).sum())


def _rows(array: npt.NDArray[Any], order: npt.NDArray[np.intp]) -> npt.NDArray[Any]:
    """(M, N, ...) with the N entries of each row in its own order (M, N)."""
    return array[np.arange(len(array))[:, None], order]


class Mixture(TensorDictModuleBase):
    """In each step a team follows the expert with probability `beta`, else the policy.

    Under the shield "pibt" an action is a value for each move: the policy's logits, or 1 for the expert's move.
    """

    beta: torch.Tensor
    seed: torch.Tensor

    def __init__(self, policy: DecentralizedPolicy, teacher: Teacher, config: TrainConfig) -> None:
        super().__init__()
        self.policy, self.teacher, self.config = policy, teacher, config
        self.in_keys = [FOV, GRAPH, POSITIONS, CASE]  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = [ACTION]  # pyright: ignore[reportAttributeAccessIssue]
        # Buffers, so that they reach a collector's processes together with the weights.
        self.register_buffer("beta", torch.ones(()))
        self.register_buffer("seed", torch.zeros((), dtype=torch.int64))
        self._random, self._seeded = torch.Generator(), -1

    def begin(self, beta: float, seed: int) -> None:
        """Set the share of the expert, and the seed of all draws from now on."""
        self.beta.fill_(beta)
        self.seed.fill_(seed)
        self.policy.eval()

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the joint actions (B, N)."""
        teams, cases = tensordict.batch_size[0], tensordict[CASE]
        if self._seeded != int(self.seed):
            self._seeded = int(self.seed)
            self._random.manual_seed(self._seeded + int(cases.sum()))  # collectors side by side play other cases
        by_expert = torch.rand(teams, generator=self._random) < self.beta.cpu()
        positions = tensordict[POSITIONS]
        values = torch.empty(*positions.shape[:2], len(Action))
        if not by_expert.all():
            device = self.policy.head.weight.device
            with autocast(self.config.precision, device):
                values = self.policy(tensordict[FOV].to(device), tensordict[GRAPH].to(device)).float().cpu()
            require_finite({"logits": values}, "the network's logits")
            if self.config.sample_rollouts:  # the greatest of the logits with Gumbel noise is a draw from the softmax
                values -= torch.empty_like(values).exponential_(generator=self._random).log()
        if by_expert.any():
            moves, _ = self.teacher.moves(np.asarray(cases[by_expert]), np.asarray(positions[by_expert]))
            values[by_expert] = one_hot(torch.from_numpy(moves.astype(np.int64)), len(Action)).float()
        return tensordict.set(ACTION, values if self.config.shield == "pibt" else values.argmax(-1))


def _collector(
    backend: Backend, players: int, make_env: Callable[[], TeamEnv], mixture: Mixture, **settings: Any
) -> BaseCollector:
    """TorchRL's collector in this process, or in as many others as there are players."""
    own: dict[str, Any] = {"compact_obs": True, "auto_register_policy_transforms": False}
    if backend == "direct":
        return Collector(make_env(), mixture, backend=backend, **settings, **own)
    torch.multiprocessing.set_sharing_strategy("file_system")  # open files cannot be passed to spawned processes
    settings |= {"num_collectors": players, "sync": True}
    return Collector([make_env] * players, mixture, backend=backend, **settings, **own)


def teams_side_by_side(config: TrainConfig, ranks: Ranks) -> int:
    """How many teams this process plays at a time.

    Raises:
        ValueError: If processes, or the collectors of a process, cannot share them evenly.
    """
    teams = ranks.share("rollout_teams", config.rollout_teams)
    if teams % config.collectors:
        raise ValueError(
            f"rollout_teams of a process must be a multiple of its {config.collectors} collectors, got {teams}"
        )
    return teams


class Aggregator:
    """Collects demonstrations round by round through a TorchRL collector."""

    def __init__(
        self,
        config: TrainConfig,
        policy: DecentralizedPolicy,
        teacher: Teacher,
        instances: Sequence[Instance],
        ranks: Ranks = Ranks(),
    ) -> None:
        self._config, self._teacher, self._rank = config, teacher, ranks.rank
        teams, players = teams_side_by_side(config, ranks), config.collectors
        self._mixture = Mixture(policy, teacher, config)
        self._mixture.begin(beta=1.0, seed=0)
        make_env = functools.partial(
            TeamEnv,
            teams // players,
            instances,
            fov_radius=config.policy.fov_radius,
            extra_channels=("cost_to_go",) if config.policy.cost_to_go else (),
            comm_radius=config.policy.comm_radius,
            comm_range=config.policy.comm_range,
            comm_weights=config.policy.comm_weights,
            shield=config.shield,
            max_cycles=config.rollout_length,
            dtype="uint8",
        )
        self._collector = _collector(
            config.backend,
            players,
            make_env,
            self._mixture,
            frames_per_batch=teams * config.rollout_length,
            reset_at_each_iter=True,
            trust_policy=True,
        )
        self._batches: Iterator[TensorDictBase] = iter(self._collector)

    def collect(self, round_number: int, steps: int) -> tuple[Demonstrations, int]:
        """Play this process's share of at least `steps` team steps and label them.

        What a round yields depends on its number, the process's and the weights.

        Returns:
            The demonstrations of all states of the round, or of plans from where teams were stuck, and the number of
            states that the expert could not solve.
        """
        seed = int(np.random.SeedSequence([self._config.seed, round_number, self._rank]).generate_state(1)[0])
        self._mixture.begin(self._config.beta_decay**round_number, seed)
        if self._config.backend != "direct":
            self._collector.update_policy_weights_(self._mixture)
        self._collector.set_seed(seed)
        config, demonstrated = self._config, round_number == 0
        stuck_only = config.aggregation == "stuck" and not demonstrated
        mining = 1 if demonstrated else config.hard_case_mining
        keys = (CASE, POSITIONS, ("next", "truncated"), ("next", "terminated"))
        seen: list[list[npt.NDArray[Any]]] = [[] for _ in keys]
        for _ in range(mining * -(-steps // (config.rollout_teams * config.rollout_length))):
            visited = next(self._batches).reshape(-1, config.rollout_length)  # collectors side by side are stacked
            for key, found in zip(keys, seen, strict=True):
                found.append(np.asarray(visited[key]).copy())
        cases, positions, truncated, terminated = map(np.concatenate, seen)
        arrived = terminated.reshape(len(terminated), -1).any(axis=1)
        teams = np.sort(arrived.argsort(kind="stable")[: len(terminated) // mining])
        asked = truncated[teams, :, 0] if stuck_only else np.ones(cases[teams].shape, np.bool_)
        ask = self._teacher.demonstrate if stuck_only else self._teacher.label
        return ask(cases[teams][asked], positions[teams][asked])

    def close(self) -> None:
        """Shut the collector down."""
        self._collector.shutdown()
