"""The PettingZoo view's own arguments: forms of observation, preferences, reused buffers, state, rendering."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, render_test, state_test

import mapf_env
from mapf_env import parallel_env, parse_instance, random_instance

SMALL: dict[str, Any] = {"num_agents": 4, "height": 6, "width": 6, "max_cycles": 15}


@pytest.mark.parametrize(
    "settings",
    [
        {"observation": "box"},
        {"shield": "pibt", "preferences": True},
        {"reuse_buffers": True},
        {"extra_channels": ("cost_to_go", "other_goals", "previous_positions")},
        {"extra_channels": ("cost_to_go",), "dtype": "uint8", "observation": "box"},
        {"task": "lifelong", "reward": "shaped", "comm_range": "connected", "comm_weights": "distance"},
    ],
)
def test_pettingzoos_parallel_api_test(settings: dict[str, Any]) -> None:
    parallel_api_test(parallel_env(**SMALL, **settings), num_cycles=100)


def test_pettingzoos_render_and_state_tests() -> None:
    render_test(lambda render_mode: mapf_env.env(**SMALL, render_mode=render_mode))  # pyright: ignore[reportArgumentType]
    env = parallel_env(**SMALL)
    env.reset(seed=0)
    in_turns = mapf_env.env(**SMALL)
    in_turns.reset(seed=0)
    state_test(in_turns, env)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return np.array_equal(one, other)


@pytest.mark.parametrize("settings", [{}, {"task": "lifelong"}, {"observation": "box"}])
def test_reused_buffers_equal_new_ones(settings: dict[str, Any]) -> None:
    fresh, reused = parallel_env(**SMALL, **settings), parallel_env(**SMALL, **settings, reuse_buffers=True)
    generator, first = np.random.default_rng(0), None
    for episode in range(4):
        seed = 3 if episode == 0 else None
        for one, other in zip(fresh.reset(seed=seed), reused.reset(seed=seed), strict=True):
            assert same(one, other)
        while fresh.agents:
            joint = {agent: int(generator.integers(5)) for agent in fresh.agents}
            one, other = fresh.step(joint), reused.step(joint)
            assert all(same(a, b) for a, b in zip(one, other, strict=True))
            first = other if first is None else first
            assert all(a is b for a, b in zip(first, other, strict=True))
            if generator.random() < 0.1:
                reused, first = copy.deepcopy(reused), None
        assert not reused.agents


def test_preferences_are_executed_in_their_order() -> None:
    instance = parse_instance("A.a")
    env = parallel_env(num_agents=1, height=1, width=3, density=0, shield="pibt", preferences=True)
    env.reset(options={"instance": instance})
    _, _, _, _, infos = env.step({"agent_0": [9, 0, 0, 8, 1]})  # up is a wall, so right
    assert env.positions.tolist() == [[0, 1]]
    assert infos["agent_0"]["replaced"]
    with pytest.raises(ValueError, match="a score for each of the five moves"):
        env.step({"agent_0": 3})
    with pytest.raises(ValueError, match='preferences over all five moves need shield="pibt" or'):
        parallel_env(preferences=True)


def test_the_state_tells_everything() -> None:
    env = parallel_env(**SMALL)
    with pytest.raises(RuntimeError, match="no state before the first reset"):
        env.state()
    env.reset(seed=1)
    state = env.state()
    assert env.state_space.contains(state)
    assert (state[0] == env.grid).all()
    for plane, cells in ((1, env.positions), (2, env.goals)):
        numbers = np.rint(state[plane] * 4).astype(int)
        assert [np.argwhere(numbers == i + 1)[0].tolist() for i in range(4)] == cells.tolist()
        assert np.count_nonzero(numbers) == 4


def test_rendering(capsys: pytest.CaptureFixture[str]) -> None:
    instance = parse_instance("AB#\n.ba")
    size: dict[str, Any] = {"num_agents": 2, "height": 2, "width": 3, "density": 0}
    env = parallel_env(**size, render_mode="ansi")
    with pytest.raises(RuntimeError, match="nothing to render before the first reset"):
        env.render()
    env.reset(options={"instance": instance})
    assert env.render() == "AB#\n.ba"
    env.step({"agent_0": 4, "agent_1": 2})
    assert env.render() == "A.#\n.*a"
    env = parallel_env(**size, render_mode="rgb_array")
    env.reset(options={"instance": instance})
    picture = env.render()
    assert isinstance(picture, np.ndarray)
    assert picture.shape == (32, 48, 3)
    assert picture.dtype == np.uint8
    assert (picture[8, 40] == (59, 66, 82)).all(), "the obstacle"
    assert (picture[8, 8] != picture[8, 24]).any(), "two robots, two colours"
    env = parallel_env(**size, render_mode="human")
    env.reset(options={"instance": instance})
    assert capsys.readouterr().out == "AB#\n.ba\n"
    env.step({"agent_0": 4, "agent_1": 2})
    assert capsys.readouterr().out == "\nA.#\n.*a\n"
    assert parallel_env(**size).render() is None
    with pytest.raises(ValueError, match="render_mode must be"):
        parallel_env(render_mode="hologram")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="observation must be one of dict, box, got"):
        parallel_env(observation="smell")  # pyright: ignore[reportArgumentType]


def test_in_a_terminal_each_state_takes_the_place_of_the_one_before(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []
    monkeypatch.setattr("time.sleep", waits.append)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    env = parallel_env(num_agents=2, height=2, width=3, density=0, render_mode="human")
    env.reset(options={"instance": parse_instance("AB#\n.ba")})
    env.step({"agent_0": 4, "agent_1": 2})
    assert capsys.readouterr().out == "AB#\n.ba\n\x1b[2F\x1b[JA.#\n.*a\n"
    assert waits == [0.25]


FOUR: dict[str, Any] = {"num_agents": 4, "fov_radius": 2, "extra_channels": ("cost_to_go",), "reward": "shaped"}


@pytest.mark.parametrize("settings", [{}, {"reuse_buffers": True}, {"task": "lifelong", "comm_range": "connected"}])
@pytest.mark.parametrize(("height", "width"), [(4, 9), (30, 25), (6, 5), (2, 2)])
def test_a_given_instance_may_have_a_map_of_any_size(height: int, width: int, settings: dict[str, Any]) -> None:
    """It is played as by an environment of its own size, and afterwards the stream of random ones goes on."""
    instance = random_instance(num_agents=4, height=height, width=width, density=0.0, seed=1)
    sized = parallel_env(**FOUR, **settings, height=height, width=width, density=0.0)
    env, plain = (
        parallel_env(**FOUR, **settings, height=6, width=6),
        parallel_env(**FOUR, **settings, height=6, width=6),
    )
    spaces = copy.deepcopy(env.observation_spaces)
    for each in (env, plain):
        each.reset(seed=5)
        each.step(dict.fromkeys(each.agents, 4))
    for seed in (7, None):
        assert same(
            env.reset(seed=seed, options={"instance": instance}), sized.reset(seed=seed, options={"instance": instance})
        )
        assert env.instance() == instance
        assert (env.grid == instance.grid).all()
        for action in (0, 1, 2, 3, 4):
            if not env.agents:
                break
            joint = dict.fromkeys(env.agents, action)
            outcome = env.step(joint)
            assert same(outcome, sized.step(joint))
            assert all(env.observation_spaces[agent].contains(seen) for agent, seen in outcome[0].items())
        assert env.render() is None
    assert env.observation_spaces == spaces
    if (height, width) != (6, 6):
        with pytest.raises(ValueError, match=rf"maps, 6x6, but this .* one of {height}x{width}: .* height={height}"):
            env.state()
    plain.reset(seed=7)
    plain.reset()
    for each in (env, plain):
        each.reset()
    assert env.state().shape == env.state_space.shape
    assert env.instance() == plain.instance()


def test_copies_made_on_a_map_of_another_size_continue_identically() -> None:
    env = parallel_env(num_agents=2, height=4, width=4)
    env.reset(seed=1, options={"instance": random_instance(num_agents=2, height=7, width=3, density=0.0, seed=0)})
    twin = pickle.loads(pickle.dumps(copy.deepcopy(env)))
    joint = dict.fromkeys(env.agents, 2)
    assert same(env.step(joint), twin.step(joint))
    assert same(env.reset(), twin.reset())
    assert env.instance() == twin.instance()


def test_a_map_of_another_size_is_played_in_turns_and_as_one_agent_too() -> None:
    instance = parse_instance("A#\na#")
    in_turns = mapf_env.env(num_agents=1)
    in_turns.reset(options={"instance": instance})
    in_turns.step(2)
    assert in_turns.terminations == {"agent_0": True}
    env = mapf_env.joint_env(num_agents=1, render_mode="ansi")
    seen, _ = env.reset(options={"instance": instance})
    assert env.observation_space.contains(seen)
    assert env.render() == "A#\na#"
    assert env.step(np.array([2]))[2]
    env.reset(seed=3)
    assert str(env.render()).count("\n") == 19


def test_a_refused_instance_leaves_the_episode_as_it_was() -> None:
    for env in (parallel_env(num_agents=2), mapf_env.joint_env(num_agents=2)):
        env.reset(seed=0)
        before = env._batch.positions
        with pytest.raises(ValueError, match="the instance has 3 agents, the environment 2"):
            env.reset(options={"instance": random_instance(num_agents=3, height=9, width=9)})
        assert (env._batch.positions == before).all()
    with pytest.raises(ValueError, match="the instance's map is 9x9, the environment's 20x20"):
        mapf_env.BatchedEnv(1, num_agents=3).reset(instances=[random_instance(num_agents=3, height=9, width=9)])
