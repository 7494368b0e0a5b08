"""Laws of the PettingZoo view's own arguments: forms of observation, preferences, reused buffers, state, rendering."""

import copy
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, render_test, state_test

import mapf_env
from mapf_env import parallel_env, parse_instance

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
    return np.array_equal(one, other)


@pytest.mark.parametrize("settings", [{}, {"task": "lifelong"}, {"observation": "box"}])
def test_reused_buffers_show_what_fresh_ones_show(settings: dict[str, Any]) -> None:
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
    with pytest.raises(ValueError, match="a value for each of the five moves"):
        env.step({"agent_0": 3})
    with pytest.raises(ValueError, match='preferences over all five moves need shield="pibt"'):
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
