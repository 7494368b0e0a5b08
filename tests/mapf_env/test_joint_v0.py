"""The joint view passes Gymnasium's own check and is the batch of one."""

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from mapf_env import BatchedEnv, joint_env, random_instance


@pytest.mark.parametrize(
    "settings", [{"num_agents": 3}, {"num_agents": 2, "dtype": "uint8", "extra_channels": ("cost_to_go",)}]
)
def test_gymnasiums_check(settings: dict[str, Any]) -> None:
    check_env(joint_env(**settings), skip_render_check=True)


def test_it_is_the_batched_environment_with_a_batch_of_one() -> None:
    env, batch = joint_env(num_agents=4), BatchedEnv(1, num_agents=4)
    (seen, _), expected = env.reset(seed=5), batch.reset(seed=5)
    for _ in range(20):
        assert np.array_equal(seen["fov"], expected.fov[0])
        action = env.action_space.sample()
        seen, reward, terminated, truncated, infos = env.step(action)
        step = batch.step(action[None])
        expected = step.observation
        assert reward == step.rewards.sum()
        assert (terminated, truncated) == (step.terminated[0], step.truncated[0])
        assert (infos["replaced"] == step.replaced[0]).all()
    instance = random_instance(num_agents=4, seed=1)
    env.reset(options={"instance": instance})
    assert (env._batch.positions[0] == instance.starts).all()
