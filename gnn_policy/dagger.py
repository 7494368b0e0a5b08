"""Dataset aggregation: play a mixture of expert and policy, and ask the expert about every state that is visited.

Source: Ross, Gordon and Bagnell 2011 (DAgger). What matters there holds here: the states come from the mixture, the
labels from the expert alone, and the data of all rounds are kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

import experts
from gnn_policy.config import TrainConfig
from gnn_policy.demonstrations import Demonstrations
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.team_env import ACTION, CASE, FOV, GRAPH, POSITIONS, TeamEnv
from mapf_env import Instance


class Teacher:
    """The expert, as training asks it: for the joint move in each of many states of known cases.

    Args:
        instances: The training cases.
        w: The expert's bound on suboptimality.
        node_limit: Its effort for a state.
        threads: CPU threads.
    """

    def __init__(self, instances: Sequence[Instance], *, w: float, node_limit: int, threads: int) -> None:
        self._instances, self._w, self._node_limit, self._threads = instances, w, node_limit, threads

    def moves(
        self, cases: npt.NDArray[np.integer], positions: npt.NDArray[np.integer]
    ) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.bool_]]:
        """Joint moves (M, N) in M states (M, N, 2) of the given cases (M,), and which of them the expert solved."""
        return experts.relabel(
            [self._instances[i] for i in cases],
            positions,
            w=self._w,
            node_limit=self._node_limit,
            threads=self._threads,
        )

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


class Mixture(TensorDictModuleBase):
    """In each step a team follows the expert with probability `beta`, else the policy."""

    def __init__(self, policy: DecentralizedPolicy, teacher: Teacher, *, sample: bool) -> None:
        super().__init__()
        self.policy, self.teacher, self.sample = policy, teacher, sample
        self.in_keys = [FOV, GRAPH, POSITIONS, CASE]  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = [ACTION]  # pyright: ignore[reportAttributeAccessIssue]
        self.beta = 1.0
        self.random = torch.Generator()

    @torch.inference_mode()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the joint actions (B, N)."""
        teams = tensordict.batch_size[0]
        by_expert = torch.rand(teams, generator=self.random) < self.beta
        positions = tensordict[POSITIONS]
        actions = torch.empty(positions.shape[:2], dtype=torch.int64)
        if not by_expert.all():
            device = self.policy.head.weight.device
            logits = self.policy(tensordict[FOV].to(device), tensordict[GRAPH].to(device)).cpu()
            actions = self._sampled(logits) if self.sample else logits.argmax(-1)
        if by_expert.any():
            moves, _ = self.teacher.moves(np.asarray(tensordict[CASE][by_expert]), np.asarray(positions[by_expert]))
            actions[by_expert] = torch.from_numpy(moves.astype(np.int64))
        return tensordict.set(ACTION, actions)

    def _sampled(self, logits: torch.Tensor) -> torch.Tensor:
        probabilities = torch.softmax(logits, -1).flatten(0, 1)
        return torch.multinomial(probabilities, 1, generator=self.random).view(logits.shape[:2])


class Aggregator:
    """Collects demonstrations round by round through a TorchRL collector."""

    def __init__(self, config: TrainConfig, policy: DecentralizedPolicy, instances: Sequence[Instance], threads: int):
        self._config = config
        self._teacher = Teacher(instances, w=config.w, node_limit=config.expert_nodes, threads=threads)
        self._mixture = Mixture(policy, self._teacher, sample=config.sample_rollouts)
        self._env = TeamEnv(
            config.rollout_teams,
            instances,
            fov_radius=config.policy.fov_radius,
            comm_radius=config.policy.comm_radius,
            max_cycles=config.rollout_length,
            dtype="uint8",
        )
        self._collector = Collector(
            self._env,
            self._mixture,
            frames_per_batch=config.rollout_teams * config.rollout_length,
            reset_at_each_iter=True,
            compact_obs=True,
            trust_policy=True,
            auto_register_policy_transforms=False,
        )
        self._batches: Iterator[TensorDictBase] = iter(self._collector)

    def collect(self, round_number: int, steps: int) -> tuple[Demonstrations, int]:
        """Play at least `steps` team steps and label them; what a round yields depends on its number and the weights.

        Returns:
            The demonstrations of all states of the round, and the number of those the expert could not solve.
        """
        seed = int(np.random.SeedSequence([self._config.seed, round_number]).generate_state(1)[0])
        self._env.set_seed(seed)
        self._mixture.random.manual_seed(seed)
        self._mixture.beta = self._config.beta_decay**round_number
        self._mixture.policy.eval()
        cases, positions = [], []
        for _ in range(-(-steps // (self._config.rollout_teams * self._config.rollout_length))):
            visited = next(self._batches)
            cases.append(np.asarray(visited[CASE].flatten()).copy())
            positions.append(np.asarray(visited[POSITIONS].flatten(0, 1)).copy())
        return self._teacher.label(np.concatenate(cases), np.concatenate(positions))

    def close(self) -> None:
        """Shut the collector down."""
        self._collector.shutdown()
