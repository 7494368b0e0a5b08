"""Dataset aggregation: play a mixture of expert and policy, and ask the expert about the states that are visited.

Source: Ross, Gordon and Bagnell 2011 (DAgger). What matters there holds here: the states come from the mixture, the
labels from the expert alone, and the data of all rounds are kept. The variant that asks only where teams failed is
that of the authors' code.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector

from gnn_policy.acting import scores_of
from gnn_policy.cases import Cases, Task
from gnn_policy.config import Aggregation, Backend, TrainConfig
from gnn_policy.demonstrations import Demonstrations
from gnn_policy.execution import episode_noise
from gnn_policy.labelling import Labeller
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.precision import autocast
from gnn_policy.processes import Process
from gnn_policy.team_env import ACTION, CASE, POSITIONS, STATE_KEYS, TeamEnv, states_of
from mapf_env import Action, Bag, MapSet, States, perceive


class Mixture(TensorDictModuleBase):
    """In each step a team follows the expert with probability `beta`, else the policy.

    Under a PIBT shield an action is a score for each move: the policy's, or 1 for the expert's move.
    """

    beta: torch.Tensor
    seed: torch.Tensor
    task: Task

    def __init__(
        self,
        policy: DecentralizedPolicy,
        labeller: Labeller,
        config: TrainConfig,
        cases: Cases,
        task: Task = "one_shot",
        exploration: float | None = None,
    ) -> None:
        super().__init__()
        self.policy, self.labeller, self.config, self.task = policy, labeller, config, task
        self.exploration = exploration
        self._map_of = cases.map_of
        self._senses = config.rollout_execution.senses(config.policy)
        self._maps = MapSet(cases.grids, self._senses.fov_radius, "uint8")
        self.in_keys = list(STATE_KEYS)  # pyright: ignore[reportAttributeAccessIssue]
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
        """Write the joint actions (B, N), or scores (B, N, 5)."""
        count, cases = tensordict.batch_size[0], tensordict[CASE]
        if self._seeded != int(self.seed):
            self._seeded = int(self.seed)
            self._random.manual_seed(self._seeded + int(cases.sum()))  # collectors side by side play other cases
        by_expert = (torch.rand(count, generator=self._random) < self.beta.cpu()).numpy()
        states = states_of(tensordict, self._map_of)
        scores = np.zeros((states.num_robots, len(Action)), np.float32)
        guided = by_expert[states.team]
        if not by_expert.all():
            scores[~guided] = self._score(states.take(~by_expert))
        if by_expert.any():
            moves, _ = self.labeller.moves(states.take(by_expert), self.task)
            scores[guided] = np.eye(len(Action), dtype=np.float32)[moves]
        sizes = np.diff(states.offsets)
        present = np.arange(tensordict[POSITIONS].shape[1]) < sizes[:, None]
        action = np.zeros((*present.shape, len(Action)), np.float32)
        action[present] = scores
        if self.config.rollout_execution.shield != "idle":
            return tensordict.set(ACTION, torch.from_numpy(action))
        chosen = action.argmax(-1)
        chosen[~present] = Action.IDLE
        return tensordict.set(ACTION, torch.from_numpy(chosen))

    def perceive(self, states: States) -> Bag:
        """Return what the robots perceive in the given states, for the policy and for its execution."""
        return perceive(replace(states, maps=self._maps.index[states.maps]), self._maps, self._senses)

    def _score(self, states: States) -> npt.NDArray[np.float32]:
        team = states.team
        robot = np.arange(states.num_robots) - states.offsets[team]
        noise = episode_noise(states.seeds[team], states.times[team], robot)
        with autocast(self.config.precision, self.policy.head.weight.device):
            return scores_of(self.policy, self.perceive(states), self.config.rollout_execution, noise, self.exploration)


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


def teams_side_by_side(config: TrainConfig, process: Process) -> int:
    """Return the number of teams that this process plays at a time.

    Raises:
        ValueError: If processes, or the collectors of a process, cannot share them evenly.
    """
    teams = process.share("rollout_teams", config.rollout_teams)
    if teams % config.collectors:
        raise ValueError(
            f"rollout_teams of a process must be a multiple of its {config.collectors} collectors, got {teams}"
        )
    return teams


def split_teams(teams: int, by_task: Mapping[Task, Cases], collectors: int) -> dict[Task, int]:
    """Return the teams of each task, in proportion to its cases and at least one for each collector.

    Raises:
        ValueError: If a collector has fewer teams than there are tasks.
    """
    each = teams // collectors
    if each < len(by_task):
        raise ValueError(
            f"rollout_teams must be at least {len(by_task)} for each collector, one for each task, got {each}"
        )
    if len(by_task) == 1:
        return dict.fromkeys(by_task, teams)
    one_shot, lifelong = (len(by_task[task]) for task in ("one_shot", "lifelong"))
    share = min(max(round(each * lifelong / (one_shot + lifelong)), 1), each - 1)
    return {"one_shot": (each - share) * collectors, "lifelong": share * collectors}


class Player:
    """Plays the cases of one task through a TorchRL collector."""

    def __init__(
        self,
        config: TrainConfig,
        policy: DecentralizedPolicy,
        labeller: Labeller,
        task: Task,
        cases: Cases,
        teams: int,
        *,
        exploration: float | None = None,
        reward: str = "flowtime",
    ) -> None:
        self.task: Task = task
        self.cases, self.teams = cases, teams
        self._config = config
        self._mixture = Mixture(policy, labeller, config, cases, task, exploration)
        self._mixture.begin(beta=1.0, seed=0)
        make_env = functools.partial(
            TeamEnv,
            teams // config.collectors,
            cases.instances,
            observation="state",
            task=task,
            max_cycles=config.rollout_length,
            dtype="uint8",
            reward=reward,
            **config.rollout_execution.env_settings(config.policy),
        )
        self._collector = _collector(
            config.backend,
            config.collectors,
            make_env,
            self._mixture,
            frames_per_batch=teams * config.rollout_length,
            reset_at_each_iter=True,
            trust_policy=True,
        )
        self._batches: Iterator[TensorDictBase] = iter(self._collector)

    def begin(self, beta: float, seed: int) -> None:
        """Set the share of the expert, and the seed of all draws from now on; take over the policy's weights."""
        self._mixture.begin(beta, seed)
        if self._config.backend != "direct":
            self._collector.update_policy_weights_(self._mixture)
        self._collector.set_seed(seed)

    def visit(self) -> TensorDictBase:
        """Play the teams from their starts (teams, rollout_length); the next call writes over what is returned."""
        return next(self._batches).reshape(-1, self._config.rollout_length)  # collectors side by side are stacked

    def perceive(self, states: States) -> Bag:
        """Return what the robots perceive in states on any of the training maps."""
        return self._mixture.perceive(states)

    def play(self, beta: float, seed: int, times: int, mining: int, *, only_failed: bool) -> States:
        """Play the teams `times` times for each one that is kept, and return the states of those.

        With `mining` above 1 the one in so many is kept that arrived last. With `only_failed` only the last states of
        teams that did not arrive are returned.
        """
        self.begin(beta, seed)
        keys = (*STATE_KEYS, ("next", "truncated"), ("next", "terminated"))
        parts = [self.visit().select(*keys).clone() for _ in range(mining * times)]
        played: Any = torch.cat(parts)  # pyright: ignore[reportArgumentType, reportCallIssue]
        arrived = np.asarray(played["next", "terminated"]).reshape(len(played), -1).any(axis=1)
        teams = np.sort(arrived.argsort(kind="stable")[: len(played) // mining])
        chosen = played[torch.from_numpy(teams)].reshape(-1)
        if only_failed:
            chosen = chosen[chosen["next", "truncated"][:, 0]]
        return states_of(chosen, self.cases.map_of)

    def close(self) -> None:
        """Shut the collector down."""
        self._collector.shutdown()


class Demonstrator:
    """Collects demonstrations round by round: teams of each task, as many as its share of the cases."""

    def __init__(
        self,
        config: TrainConfig,
        policy: DecentralizedPolicy,
        labeller: Labeller,
        cases: Cases,
        process: Process = Process(),
    ) -> None:
        self._config, self._labeller = config, labeller
        self._rank, self._num_processes = process.rank, process.count
        by_task = cases.by_task()
        teams = split_teams(teams_side_by_side(config, process), by_task, config.collectors)
        self._players = [Player(config, policy, labeller, task, own, teams[task]) for task, own in by_task.items()]

    def collect(self, round_number: int, steps: int) -> tuple[Demonstrations, int]:
        """Play this process's share of at least `steps` team steps and label them.

        The demonstrations of a round depend on its number, the process's number and the weights.

        Returns:
            The demonstrations of all states of the round, or of plans from where teams failed, and the number of
            states that the expert could not solve.
        """
        config = self._config
        seed = int(np.random.SeedSequence([config.seed, round_number, self._rank]).generate_state(1)[0])
        demonstrated = round_number == 0
        aggregation = "visited" if demonstrated and config.aggregation == "failed" else config.aggregation
        beta, mining = config.beta_decay**round_number, 1 if demonstrated else config.hard_case_mining
        times = -(-steps // (config.rollout_teams * config.rollout_length))
        labelled = []
        for player in self._players:
            if demonstrated and aggregation == "plans" and player.task == "one_shot":
                starts = self._starts(player, steps, np.random.default_rng(seed))
                labelled.append(self._labeller.demonstrate(starts, config.plan_steps))
                continue
            states = player.play(beta, seed, times, mining, only_failed=aggregation == "failed")
            labelled.append(self._label(states, player.task, aggregation, seed))
        return Demonstrations.concatenate([part for part, _ in labelled]), sum(count for _, count in labelled)

    def _label(self, states: States, task: Task, aggregation: Aggregation, seed: int) -> tuple[Demonstrations, int]:
        config = self._config
        if aggregation == "failed":
            return self._labeller.demonstrate(states)
        if aggregation == "visited" or task == "lifelong":
            return self._labeller.label(states, task)
        weight = np.where(np.logical_or.reduceat(states.stuck(), states.offsets[:-1]), config.stuck_weight, 1.0)
        count = max(len(states) // config.plan_steps, 1)
        asked = np.random.default_rng(seed).choice(len(states), count, replace=False, p=weight / weight.sum())
        return self._labeller.demonstrate(states.take(np.sort(asked)), config.plan_steps)

    def _starts(self, player: Player, steps: int, rng: np.random.Generator) -> States:
        """Return the starts of as many cases as have plans of about the player's share of so many steps."""
        config, cases = self._config, player.cases
        teams = sum(each.teams for each in self._players)
        count = max(steps * player.teams // teams // config.plan_steps // self._num_processes, 1)
        chosen = rng.integers(len(cases), size=count)
        return States.start_of(
            [cases.instances[case] for case in chosen],
            config.policy,
            maps=cases.map_of[chosen],
            seeds=rng.integers(2**63, size=count).astype(np.uint64),
            limits=config.rollout_length,
        )

    def close(self) -> None:
        """Shut the collectors down."""
        for player in self._players:
            player.close()
