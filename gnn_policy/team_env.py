"""The batched environment as TorchRL sees it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from mapf_env import Action, BatchedEnv, Instance, Observation, States
from mapf_env.arguments import choice
from mapf_env.grid_v0 import observation_spaces
from mapf_env.senses import HISTORY

FOV = ("agents", "fov")
GRAPH = ("agents", "graph")
SCALARS = ("agents", "scalars")
EDGE_ATTR = ("agents", "edge_attr")
POSITIONS = ("agents", "positions")
GOALS = ("agents", "goals")
MOVES = ("agents", "moves")
UNDER_WAY = ("agents", "under_way")
ACTION = ("agents", "action")
REWARD = ("agents", "reward")
CASE = "case"
ENDS = ("done", "terminated", "truncated")
_TEAM_FACTS = {
    "team_size": "team_sizes",
    "seed": "seeds",
    "time": "times",
    "limit": "max_cycles",
    "radius": "comm_radius",
}
"""Keys of facts about a team, and the property of `BatchedEnv` that has each."""
STATE_KEYS = (POSITIONS, GOALS, MOVES, UNDER_WAY, CASE, *_TEAM_FACTS)
"""All that `states_of` reads."""


class TeamEnv(EnvBase):
    """B teams as one TorchRL environment of batch size [B], over `mapf_env.BatchedEnv`.

    It reads `ACTION` (B, N), under a PIBT shield a score for each of the moves (B, N, 5), and writes `REWARD`
    (B, N, 1), `CASE` (B,), the number among `cases` of the one that a team plays (-1 for a random instance), and
    observations: "dense" ones are `FOV` (B, N, C, F, F), `GRAPH` (B, N, N), `POSITIONS` (B, N, 2) and, where features
    are asked for, `SCALARS` (B, N, K) and `EDGE_ATTR` (B, N, N, D). "state" writes no views but all that they are made
    from, which `states_of` reads: a fraction of the memory.

    Args:
        num_envs: The number of teams B.
        cases: Instances to play, of any sizes, in an order drawn again from the seed for each pass; random instances
            if not given.
        observation: "dense" or "state".
        settings: Fields of `mapf_env.EnvConfig`, or `grid`, a map on which starts and goals are drawn; the sizes of
            team and map follow from `cases`.
    """

    def __init__(
        self,
        num_envs: int,
        cases: Sequence[Instance] | None = None,
        *,
        observation: Literal["dense", "state"] = "dense",
        **settings: Any,
    ) -> None:
        super().__init__(batch_size=torch.Size([num_envs]))
        choice(observation, ("dense", "state"), "observation")
        self.cases, self._dense = cases, observation == "dense"
        if cases is not None:
            if not cases:
                raise ValueError("there are no cases to play: give some, or None for random instances")
            settings |= {
                "num_agents": max(each.num_agents for each in cases),
                "height": max(each.grid.shape[0] for each in cases),
                "width": max(each.grid.shape[1] for each in cases),
                "style": "empty",
                "fill": True,
            }
        self._batch = BatchedEnv(num_envs, **settings)
        self._rng = np.random.default_rng()
        self._order = self._endless_order()
        self._seed: int | None = None
        self._playing = np.full(num_envs, -1)
        self._define_specs()

    def _define_specs(self) -> None:
        config = self._batch.config
        N, teams = config.num_agents, self.batch_size
        robots = torch.Size([*teams, N])
        last_cell = torch.tensor([config.height - 1, config.width - 1], dtype=torch.int32).expand(*robots, 2)
        cells = Bounded(torch.zeros_like(last_cell), last_cell, last_cell.shape, dtype=torch.int32)
        seen: dict[str, Any] = {"positions": cells}
        if self._dense:
            for name, space in observation_spaces(config).items():
                low, high = (
                    torch.from_numpy(np.array(each)).expand(*robots, *space.shape) for each in (space.low, space.high)
                )
                seen[name] = Bounded(low, high, low.shape, dtype=low.dtype)
            facts: dict[str, Any] = {}
        else:
            seen["goals"] = cells.clone()
            seen["moves"] = Unbounded(torch.Size([*robots, HISTORY]), dtype=torch.int8)
            seen["under_way"] = Unbounded(robots, dtype=torch.int32)
            kinds = {"seed": torch.int64, "time": torch.int64, "radius": torch.float64}
            facts = {key: Unbounded(teams, dtype=kinds.get(key, torch.int32)) for key in _TEAM_FACTS}
        self.observation_spec = Composite(
            agents=Composite(seen, shape=teams), case=Unbounded(teams, dtype=torch.int64), **facts, shape=teams
        )
        action = (
            Unbounded(torch.Size([*robots, len(Action)]), dtype=torch.float32)
            if config.shield != "idle"
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
        observation = self._batch.reset(self._seed, instances=instances, mask=mask, observe=self._dense)
        self._seed = None
        done = {key: torch.zeros(self._batch.num_envs, 1, dtype=torch.bool) for key in ENDS}
        return TensorDict({**self._perceived(observation), **done}, batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        outcome = self._batch.step(tensordict.get(ACTION).cpu().numpy(), observe=self._dense)
        perceived = self._perceived(outcome.observation)
        perceived[REWARD] = torch.from_numpy(outcome.rewards)[..., None]
        terminated, truncated = (torch.from_numpy(each)[:, None] for each in (outcome.terminated, outcome.truncated))
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict({**perceived, **ends}, batch_size=self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self._rng = np.random.default_rng(seed)
        self._order = self._endless_order()
        self._seed = seed

    def _perceived(self, observation: Observation | None) -> dict[Any, torch.Tensor]:
        batch = self._batch
        arrays: dict[Any, npt.NDArray[Any]] = {POSITIONS: batch.positions, CASE: self._playing.copy()}
        if observation is not None:
            arrays |= {FOV: observation.fov, GRAPH: observation.graph}
            if observation.scalars.shape[-1]:
                arrays[SCALARS] = observation.scalars
            if observation.edge_attr.shape[-1]:
                arrays[EDGE_ATTR] = observation.edge_attr
        else:
            arrays |= {GOALS: batch.goals, MOVES: batch.moves, UNDER_WAY: batch.under_way}
            arrays |= {key: getattr(batch, name) for key, name in _TEAM_FACTS.items()}
            arrays["seed"] = arrays["seed"].view(np.int64)
        return {key: torch.from_numpy(array) for key, array in arrays.items()}

    def _endless_order(self) -> Iterator[int]:
        while self.cases is not None:
            yield from self._rng.permutation(len(self.cases)).tolist()


def states_of(visited: TensorDictBase, map_of_case: npt.NDArray[np.integer]) -> States:
    """Return the M states in what a `TeamEnv` with observation="state" wrote; `map_of_case` numbers the cases' maps."""
    flat = visited if visited.batch_dims == 1 else visited.reshape(-1)  # which fails where there is nothing

    def array(key: Any) -> npt.NDArray[Any]:
        return flat.get(key).cpu().numpy()

    sizes = array("team_size")
    there = np.arange(flat.get(POSITIONS).shape[1]) < sizes[:, None]
    return States(
        maps=map_of_case[array(CASE)].astype(np.int32),
        offsets=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        positions=array(POSITIONS)[there],
        goals=array(GOALS)[there],
        moves=array(MOVES)[there],
        under_way=array(UNDER_WAY)[there],
        seeds=array("seed").view(np.uint64),
        times=array("time").astype(np.int32),
        limits=array("limit").astype(np.int32),
        comm_radius=array("radius").astype(np.float64),
    )
