"""The batched environment as TorchRL sees it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from mapf_env import Action, BatchedEnv, Instance, Observation

FOV = ("agents", "fov")
GRAPH = ("agents", "graph")
POSITIONS = ("agents", "positions")
ACTION = ("agents", "action")
REWARD = ("agents", "reward")
CASE = "case"
ENDS = ("done", "terminated", "truncated")


class TeamEnv(EnvBase):
    """B teams as one TorchRL environment of batch size [B], over `mapf_env.BatchedEnv`.

    It reads `ACTION` (B, N), under the shield "pibt" a value for each of the moves (B, N, 5), and writes `FOV`
    (B, N, C, F, F), `GRAPH` (B, N, N), `POSITIONS` (B, N, 2), `REWARD` (B, N, 1) and `CASE` (B,): which of `cases` a
    team plays, -1 for a random instance.

    Args:
        num_envs: The number of teams B.
        cases: Instances to play, in an order drawn anew from the seed for each pass; random instances if not given.
        settings: Fields of `mapf_env.EnvConfig`; the size of the team and of the map follow from `cases`.
    """

    def __init__(self, num_envs: int, cases: Sequence[Instance] | None = None, **settings: Any) -> None:
        super().__init__(batch_size=torch.Size([num_envs]))
        self.cases = cases
        if cases is not None:
            if not cases:
                raise ValueError("there are no cases to play: give some, or None for random instances")
            height, width = cases[0].grid.shape
            settings |= {"num_agents": cases[0].num_agents, "height": height, "width": width, "density": 0.0}
        self._batch = BatchedEnv(num_envs, **settings)
        self._rng = np.random.default_rng()
        self._order = self._endless_order()
        self._seed: int | None = None
        self._playing = np.full(num_envs, -1)
        config = self._batch.config
        N, side = config.num_agents, config.fov_side
        fov_dtype = torch.uint8 if config.dtype == "uint8" else torch.float32
        span = (0, 1)
        if "cost_to_go" in config.extra_channels:
            span = (0, 4 * config.fov_radius) if config.dtype == "uint8" else (-1, 1)
        last_cell = torch.tensor([config.height - 1, config.width - 1], dtype=torch.int32).expand(num_envs, N, 2)
        teams = torch.Size([num_envs])
        robots = torch.Size([num_envs, N])
        self.observation_spec = Composite(
            agents=Composite(
                fov=Bounded(*span, torch.Size([*robots, config.num_channels, side, side]), dtype=fov_dtype),
                graph=Bounded(0, 1, torch.Size([*robots, N]), dtype=torch.float32),
                positions=Bounded(torch.zeros_like(last_cell), last_cell, torch.Size([*robots, 2]), dtype=torch.int32),
                shape=teams,
            ),
            case=Unbounded(teams, dtype=torch.int64),
            shape=teams,
        )
        action = (
            Unbounded(torch.Size([*robots, len(Action)]), dtype=torch.float32)
            if config.shield == "pibt"
            else Categorical(len(Action), robots, dtype=torch.int64)
        )
        self.action_spec = Composite(agents=Composite(action=action, shape=teams), shape=teams)
        self.reward_spec = Composite(
            agents=Composite(reward=Unbounded(torch.Size([*robots, 1]), dtype=torch.float32), shape=teams), shape=teams
        )
        self.done_spec = Composite(
            {key: Binary(1, torch.Size([*teams, 1]), dtype=torch.bool) for key in ENDS}, shape=teams
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = np.ones(self._batch.num_envs, np.bool_)
        if tensordict is not None and "_reset" in tensordict:
            mask = tensordict.get("_reset").cpu().numpy().reshape(-1)
        instances = None
        if self.cases is not None:
            self._playing[mask] = [next(self._order) for _ in range(int(mask.sum()))]
            instances = [self.cases[i] for i in self._playing[mask]]
        observation = self._batch.reset(self._seed, instances=instances, mask=mask)
        self._seed = None
        done = {key: torch.zeros(self._batch.num_envs, 1, dtype=torch.bool) for key in ENDS}
        return TensorDict({**self._perceived(observation), **done}, batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        outcome = self._batch.step(tensordict.get(ACTION).cpu().numpy())
        perceived = self._perceived(outcome.observation)
        perceived[REWARD] = torch.from_numpy(outcome.rewards)[..., None]
        terminated, truncated = (torch.from_numpy(each)[:, None] for each in (outcome.terminated, outcome.truncated))
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict({**perceived, **ends}, batch_size=self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self._rng = np.random.default_rng(seed)
        self._order = self._endless_order()
        self._seed = seed

    def _perceived(self, observation: Observation) -> dict[Any, torch.Tensor]:
        arrays = {
            FOV: observation.fov,
            GRAPH: observation.graph,
            POSITIONS: self._batch.positions,
            CASE: self._playing.copy(),
        }
        return {key: torch.from_numpy(array) for key, array in arrays.items()}

    def _endless_order(self) -> Iterator[int]:
        while self.cases is not None:
            yield from self._rng.permutation(len(self.cases)).tolist()
