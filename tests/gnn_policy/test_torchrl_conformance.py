"""The PettingZoo environment as TorchRL's own wrapper sees it (here, because only `gnn_policy` imports TorchRL)."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

from gnn_policy.team_env import ACTION, FOV, GRAPH, REWARD, TeamEnv
from mapf_env import parallel_env, random_instance

pytestmark = pytest.mark.filterwarnings("ignore")  # TorchRL's own


@pytest.mark.parametrize("settings", [{}, {"observation": "box", "dtype": "uint8"}, {"task": "lifelong"}])
def test_the_wrapper_accepts_it(settings):
    env = PettingZooWrapper(parallel_env(num_agents=3, height=8, width=8, max_cycles=9, **settings), use_mask=False)
    check_env_specs(env)
    rollout = env.rollout(20, break_when_any_done=False)
    assert rollout["agent", "action"].shape[:2] == (20, 3)
    assert torch.isfinite(rollout["next", "agent", "reward"]).all()


def test_a_collector_fills_batches_from_it():
    """Frames follow one another as the environment played them, and trajectories end where episodes do."""
    settings = {"num_agents": 3, "height": 8, "width": 8, "max_cycles": 9, "observation": "box"}
    collector = Collector(
        PettingZooWrapper(parallel_env(**settings), categorical_actions=True, use_mask=False, seed=4),
        None,
        frames_per_batch=30,
        total_frames=60,
    )
    batches = list(collector)
    collector.shutdown()
    assert [tuple(batch.batch_size) for batch in batches] == [(30,), (30,)]
    played: Any = torch.cat(batches)
    assert played["next", "done"].sum() == 6
    assert played["collector", "traj_ids"].unique().numel() == 7
    for now, later in pairwise(played):
        done = bool(now["next", "done"])
        assert done == bool(now["next", "agent", "truncated"].all() or now["next", "agent", "terminated"].all())
        assert done == bool(now["collector", "traj_ids"] != later["collector", "traj_ids"])
        assert done or torch.equal(now["next", "agent", "observation"], later["agent", "observation"])
        moved = now["next", "agent", "observation"][:, 0] != now["agent", "observation"][:, 0]
        idle = now["agent", "action"] == 4
        assert not moved[idle].any(), "a robot that stays sees the same obstacles"


@pytest.mark.parametrize("shield", ["idle", "pibt"])
def test_wrapper_and_team_env_play_the_same_trajectory(shield):
    """The same instance, seed and actions, to the end of the episode, its last observation included."""
    settings = {"fov_radius": 2, "comm_radius": 3.0, "message_loss": 0.2, "shield": shield, "max_cycles": 25}
    case = random_instance(height=6, width=7, density=0.1, num_agents=8, seed=1)
    ours = TeamEnv(1, [case], **settings)
    theirs = PettingZooWrapper(
        parallel_env(num_agents=8, height=6, width=7, **settings), categorical_actions=True, use_mask=False
    )
    ours.set_seed(3)
    one, other = ours.reset(), theirs.reset(seed=3, options={"instance": case})
    generator = np.random.default_rng(0)
    for time in range(1, 26):
        assert torch.equal(one[FOV][0], other["agent", "observation", "fov"])
        assert torch.equal(one[GRAPH][0], other["agent", "observation", "graph"])
        if time > 1:
            assert torch.equal(one[REWARD][0], other["agent", "reward"])
            assert bool(one["done"].all()) == bool(other["done"])
        moves = torch.from_numpy(generator.integers(5, size=8))
        one = ours.step(one.set(ACTION, moves[None]))["next"]
        other = theirs.step(other.set(("agent", "action"), moves))["next"]
    assert torch.equal(one[FOV][0], other["agent", "observation", "fov"])
    assert one["truncated"].all()
    assert other["agent", "truncated"].all()
