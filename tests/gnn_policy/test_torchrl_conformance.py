"""The PettingZoo environment as TorchRL's own wrapper sees it (here, because only the pupil knows TorchRL)."""

import pytest
import torch
from torchrl.envs import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

from mapf_env import parallel_env

pytestmark = pytest.mark.filterwarnings("ignore")  # TorchRL's own


@pytest.mark.parametrize("settings", [{}, {"observation": "box", "dtype": "uint8"}, {"task": "lifelong"}])
def test_the_wrapper_accepts_it(settings):
    env = PettingZooWrapper(parallel_env(num_agents=3, height=8, width=8, max_cycles=9, **settings), use_mask=False)
    check_env_specs(env)
    rollout = env.rollout(20, break_when_any_done=False)
    assert rollout["agent", "action"].shape[:2] == (20, 3)
    assert torch.isfinite(rollout["next", "agent", "reward"]).all()
