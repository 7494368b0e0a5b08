"""The PettingZoo environment under PettingZoo's own tests and ours."""

import copy
import pickle
from typing import Any

import numpy as np
import pettingzoo
import pytest
from gymnasium.vector import AutoresetMode
from pettingzoo.test import api_test, max_cycles_test, parallel_api_test, parallel_seed_test, seed_test

import mapf_env
import oracles
from mapf_env import BatchedEnv, GridEnv, Instance, grid_v0, parallel_env, random_instance

SMALL: dict[str, Any] = {"num_agents": 5, "height": 6, "width": 6, "max_cycles": 20}
MASKED_ADVICE = pytest.mark.filterwarnings(
    "ignore:Observation is not a NumPy array:UserWarning",
    "ignore:Observation space for each agent probably should be gymnasium.spaces.box or gymnasium.spaces.discrete",
)


def play(env: GridEnv, seed: int | None, episodes: int) -> list[Any]:
    """All that whole episodes of random actions bring; the actions are seeded apart."""
    generator, record = np.random.default_rng(0), []
    for episode in range(episodes):
        record.append(env.reset(seed=seed if episode == 0 else None))
        record.append((env.grid.tolist(), env.goals.tolist()))
        while env.agents:
            record.append(env.step({agent: int(generator.integers(5)) for agent in env.agents}))
            record.append(env.positions.tolist())
    return record


def assert_same(one: Any, other: Any) -> None:
    """Two nested records are equal, arrays included."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    else:
        assert np.array_equal(one, other)


@pytest.mark.parametrize("settings", [{}, SMALL, {"num_agents": 1, "dtype": "uint8"}, {"style": "walls"}])
def test_pettingzoos_parallel_api_test(settings: dict[str, Any]) -> None:
    parallel_api_test(parallel_env(**settings), num_cycles=200)


def test_pettingzoos_seed_tests() -> None:
    parallel_seed_test(lambda: parallel_env(**SMALL), num_cycles=50)
    seed_test(lambda: mapf_env.env(**SMALL), num_cycles=50)


@MASKED_ADVICE
def test_pettingzoos_api_test_in_turns() -> None:
    api_test(mapf_env.env(**SMALL), num_cycles=200)


def test_pettingzoos_max_cycles_test() -> None:
    max_cycles_test(grid_v0)


def test_pettingzoo_makes_both_forms() -> None:
    parallel = pettingzoo.make("parallel", "mapf/grid-v0", num_agents=3, max_cycles=7)
    assert isinstance(parallel, GridEnv)
    parallel.reset(seed=0)
    assert parallel.num_agents == 3
    for _ in range(7):
        assert parallel.agents
        parallel.step(dict.fromkeys(parallel.agents, oracles.IDLE))
    assert not parallel.agents
    in_turns = pettingzoo.make("aec", "mapf/grid-v0", num_agents=3)
    in_turns.reset(seed=0)
    assert in_turns.agents == ["agent_0", "agent_1", "agent_2"]


def test_equal_seeds_give_equal_episodes_to_their_ends() -> None:
    first = play(parallel_env(**SMALL), 3, episodes=12)
    assert_same(first, play(parallel_env(**SMALL), 3, episodes=12))
    assert str(first) != str(play(parallel_env(**SMALL), 4, episodes=12))
    used = parallel_env(**SMALL)
    play(used, None, episodes=2)
    assert_same(first, play(used, 3, episodes=12))


def test_a_reset_without_a_seed_continues_the_stream() -> None:
    one, other = parallel_env(**SMALL), parallel_env(**SMALL)
    for env in (one, other):
        env.reset(seed=1)
    assert_same(play(one, None, 5), play(other, None, 5))


def test_it_is_the_batched_environment_with_a_batch_of_one() -> None:
    env, batch = parallel_env(**SMALL), BatchedEnv(1, **SMALL)
    (observations, infos), seen = env.reset(seed=6), batch.reset(seed=6)
    generator = np.random.default_rng(0)
    while True:
        for i, agent in enumerate(env.possible_agents):
            assert np.array_equal(observations[agent]["fov"], seen.fov[0, i])
            assert np.array_equal(observations[agent]["graph"], seen.graph[0, i])
            assert np.array_equal(infos[agent]["action_mask"], batch.action_mask()[0, i])
            assert infos[agent]["on_goal"] == batch.on_goal()[0, i]
        if not env.agents:
            break
        actions = generator.integers(0, 5, 5)
        observations, rewards, terminated, truncated, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        step = batch.step(actions[None])
        seen = step.observation
        assert list(rewards.values()) == step.rewards[0].tolist()
        assert set(terminated.values()) == set(step.terminated.tolist())
        assert set(truncated.values()) == set(step.truncated.tolist())
        assert [info["replaced"] for info in infos.values()] == step.replaced[0].tolist()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_made_mid_episode_continue_identically(duplicate: Any) -> None:
    env = parallel_env(**SMALL)
    env.reset(seed=2)
    for _ in range(5):
        env.step(dict.fromkeys(env.agents, oracles.LEFT))
    twin = duplicate(env)
    while env.agents:
        assert_same(env.step(dict.fromkeys(env.agents, 3)), twin.step(dict.fromkeys(twin.agents, 3)))
    assert_same(play(env, None, 3), play(twin, None, 3))


def test_copies_of_an_environment_not_yet_begun_play_episodes_of_their_own() -> None:
    """Wrappers make vector environments of pickled copies, and nobody wants the same team sixteen times."""
    env = parallel_env(**SMALL)
    copies = [pickle.loads(pickle.dumps(env)) for _ in range(5)] + [copy.deepcopy(env)]
    for each in copies:
        each.reset()
    assert len({str((each.grid, each.positions, each.goals)) for each in copies}) == len(copies)


def test_observations_lie_in_their_spaces_and_belong_to_the_caller() -> None:
    env = parallel_env(**SMALL)
    observations, infos = env.reset(seed=0)
    kept = copy.deepcopy(observations)
    while env.agents:
        for agent in env.agents:
            assert env.observation_space(agent).contains(observations[agent])
            assert env.action_space(agent).n == 5  # pyright: ignore[reportAttributeAccessIssue]
        after, _, _, _, later_infos = env.step(dict.fromkeys(env.agents, oracles.UP))
        assert infos["agent_0"].keys() == later_infos["agent_0"].keys()
        assert_same(observations, kept)
        observations, kept = after, copy.deepcopy(after)


def test_all_agents_live_to_the_joint_end() -> None:
    instance = Instance(np.zeros((1, 4), bool), [[0, 0], [0, 3]], [[0, 1], [0, 2]])
    env = parallel_env(num_agents=2, height=1, width=4, density=0, max_cycles=9)
    env.reset(options={"instance": instance, "unknown": 1})
    assert env.instance() == instance
    _, rewards, terminated, truncated, infos = env.step({"agent_1": oracles.IDLE, "agent_0": oracles.RIGHT})
    assert rewards == {"agent_0": 0.0, "agent_1": -1.0}
    assert terminated == truncated == {"agent_0": False, "agent_1": False}
    assert infos["agent_0"]["on_goal"]
    assert env.agents == ["agent_0", "agent_1"]
    assert env.instance() == instance.at([[0, 1], [0, 3]])
    observations, _, terminated, truncated, _ = env.step({"agent_0": oracles.IDLE, "agent_1": oracles.LEFT})
    assert terminated == {"agent_0": True, "agent_1": True}
    assert truncated == {"agent_0": False, "agent_1": False}
    assert observations.keys() == {"agent_0", "agent_1"}
    assert env.agents == []
    with pytest.raises(RuntimeError, match=r"call reset\(\) before step\(\)"):
        env.step({})


def test_truncation_ends_all_agents_at_once() -> None:
    env = parallel_env(num_agents=2, max_cycles=1)
    env.reset(seed=0)
    _, _, terminated, truncated, _ = env.step({"agent_0": 4, "agent_1": 4})
    assert set(terminated.values()) == {False}
    assert set(truncated.values()) == {True}
    assert env.agents == []


def test_bad_calls_are_refused() -> None:
    env = parallel_env(num_agents=2)
    with pytest.raises(RuntimeError, match=r"call reset\(\)"):
        env.step({"agent_0": 4, "agent_1": 4})
    with pytest.raises(RuntimeError, match=r"call reset\(\)"):
        env.instance()
    with pytest.raises(TypeError, match=r'options\["instance"\] must be a mapf_env.Instance, got str'):
        env.reset(options={"instance": "map.scen"})
    with pytest.raises(ValueError, match="the instance has 3 agents, the environment 2: make it with num_agents=3"):
        env.reset(options={"instance": random_instance(num_agents=3)})
    assert env.agents == []
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"missing: \['agent_1'\], unknown: \['agent_9'\]"):
        env.step({"agent_0": 4, "agent_9": 4})
    with pytest.raises(ValueError, match=r"action 5 of agent 1 .* is none of 0\.\.4 \(up, left, down, right, idle\)"):
        env.step({"agent_0": 4, "agent_1": 5})
    with pytest.raises(TypeError, match="actions must be a dictionary of one action for each agent, got list"):
        env.step([4, 4])  # pyright: ignore[reportArgumentType]
    for action in (1.0, None, "up"):
        with pytest.raises(TypeError, match="the action of agent_1 must be an integer"):
            env.step({"agent_0": 4, "agent_1": action})  # pyright: ignore[reportArgumentType]
    assert env.step({"agent_0": np.int8(4), "agent_1": np.int64(4)})[1]
    with pytest.raises(TypeError, match="colour"):
        parallel_env(colour="red")


@pytest.mark.parametrize("make", [parallel_env, mapf_env.env, mapf_env.joint_env])
@pytest.mark.parametrize(
    "option", [{"autoreset": AutoresetMode.SAME_STEP}, {"fill": True}, {"num_envs": 1}, {"threads": 2}]
)
def test_options_of_batches_are_refused(make: Any, option: dict[str, Any]) -> None:
    with pytest.raises(TypeError, match=next(iter(option))):
        make(**option)
