"""The joint view passes Gymnasium's own check and is the batch of one."""

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RenderCollection

from mapf_env import BatchedEnv, JointEnv, joint_env, parallel_env, parse_instance, random_instance


@pytest.mark.parametrize(
    "settings", [{"num_agents": 3}, {"num_agents": 2, "dtype": "uint8", "extra_channels": ("cost_to_go",)}]
)
def test_gymnasiums_check(settings: dict[str, Any]) -> None:
    check_env(joint_env(**settings), skip_render_check=True)


@pytest.mark.parametrize("mode", ["ansi", "rgb_array", "human"])
def test_it_renders_like_the_pettingzoo_environment(mode: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def episode(make: Any, step: Any) -> tuple[list[Any], str]:
        env = make(num_agents=3, height=5, width=6, render_mode=mode, task="lifelong")
        with pytest.raises(RuntimeError, match="nothing to render before the first reset"):
            env.render()
        env.reset(seed=3)
        shown = [env.render()]
        for action in (0, 1, 2, 3):
            env.step(step(action))
            shown.append(env.render())
        return shown, capsys.readouterr().out

    agents = [f"agent_{i}" for i in range(3)]
    expected, printed = episode(parallel_env, lambda action: dict.fromkeys(agents, action))
    found, printed_too = episode(joint_env, lambda action: [action] * 3)
    assert all(np.array_equal(one, other) for one, other in zip(found, expected, strict=True))
    assert printed == printed_too
    assert bool(printed) == (mode == "human")
    assert mode in JointEnv.metadata["render_modes"]


def test_rendering_is_refused_and_left_out_as_in_the_pettingzoo_environment() -> None:
    with pytest.raises(ValueError, match="render_mode must be one of ansi, rgb_array, human, got 'hologram'"):
        joint_env(render_mode="hologram")
    env = joint_env(num_agents=2)
    env.reset(seed=0)
    assert env.render() is None


def test_gymnasium_records_its_pictures() -> None:
    env = RenderCollection(joint_env(num_agents=2, render_mode="rgb_array"))
    env.reset(seed=0)
    env.step(np.array([4, 4]))
    frames: Any = env.render()
    assert [frame.shape for frame in frames] == [(320, 320, 3)] * 2


def test_infos_of_lifelong_tasks_have_arrivals() -> None:
    instance = parse_instance("Aa.")
    env = joint_env(num_agents=1, height=1, width=3, density=0.0, task="lifelong")
    assert not env.reset(options={"instance": instance})[1]["arrived"].any()
    assert env.step(np.array([3]))[-1]["arrived"].tolist() == [True]
    assert env.step(np.array([4]))[-1]["arrived"].tolist() == [False]


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
