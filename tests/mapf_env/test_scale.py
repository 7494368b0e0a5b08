"""Large teams and large maps: what is done in parts is what is done at once."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import strategies
from mapf_env import (
    BatchedEnv,
    Instance,
    MapSet,
    Maze,
    Senses,
    States,
    perceive,
    random_instance,
    rules,
    team_state,
)


@given(strategies.all_settings(), strategies.seeds, st.integers(0, 2000))
@hypothesis_settings(max_examples=150)
def test_tables_of_a_part_of_the_map_change_nothing(settings: dict[str, Any], seed: int, more: int) -> None:
    whole = BatchedEnv(2, **settings)
    with pytest.MonkeyPatch.context() as patch:
        least = 2 * 2 * whole.num_agents * (2 * whole.config.fov_radius + 1) ** 2
        patch.setattr(team_state, "MOST_TABLE_BYTES", least + more)
        parts = BatchedEnv(2, **settings)
    generator = np.random.default_rng(seed)
    for one, other in zip(whole.reset(seed), parts.reset(seed), strict=True):
        assert np.array_equal(one, other)
    for _ in range(whole.config.max_cycles):
        if whole.config.shield == "idle":
            actions = generator.integers(0, 5, (2, whole.num_agents))
        else:
            actions = generator.normal(size=(2, whole.num_agents, 5)).astype(np.float32)
        one, other = whole.step(actions), parts.step(actions)
        for here, there in zip(one.observation, other.observation, strict=True):
            assert np.array_equal(here, there)
        assert np.array_equal(one.rewards, other.rewards)
        assert np.array_equal(whole.positions, parts.positions)
        assert np.array_equal(whole.goals, parts.goals)
        if not whole.running.all():
            break


@pytest.mark.parametrize("loops", [0.0, 0.3])
def test_a_table_moves_with_its_robot_through_long_mazes(loops: float, monkeypatch: pytest.MonkeyPatch) -> None:
    settings: dict[str, Any] = {
        "num_agents": 12,
        "height": 61,
        "width": 45,
        "style": Maze(loops=loops),
        "extra_channels": ("cost_to_go", "greedy_cells"),
        "robot_features": ("steps_to_go", "greedy_moves"),
        "reward": "shaped",
        "shield": "pibt_swap",
        "task": "lifelong",
        "max_cycles": 1000,
    }
    whole = BatchedEnv(1, **settings)
    monkeypatch.setattr(team_state, "MOST_TABLE_BYTES", 2 * 12 * 13 * 13)
    parts = BatchedEnv(1, **settings)
    assert parts._state.distances.shape == (1, 12, 13, 13)
    whole.reset(5, observe=False)
    parts.reset(5, observe=False)
    generator = np.random.default_rng(0)
    for _ in range(150):
        bag, same = whole.bag(), parts.bag()
        assert all(np.array_equal(one, other) for one, other in zip(bag, same, strict=True))
        greedy = bag.scalars[:, 1:6] + generator.random((12, 5), np.float32) / 2  # robots travel far
        one, other = whole.step(greedy[None], observe=False), parts.step(greedy[None], observe=False)
        assert np.array_equal(one.rewards, other.rewards)
    assert whole._state.arrivals.sum() > 0
    goals = np.roll(whole.goals, 1, axis=1)
    whole.assign_goals(goals)
    parts.assign_goals(goals)
    assert all(np.array_equal(one, other) for one, other in zip(whole.bag(), parts.bag(), strict=True))


def test_no_table_is_smaller_than_what_a_robot_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    settings: dict[str, Any] = {"num_agents": 10, "extra_channels": ("cost_to_go",), "fov_radius": 3}
    monkeypatch.setattr(team_state, "MOST_TABLE_BYTES", 2 * 30 * 49)
    assert BatchedEnv(3, **settings)._state.distances.shape == (3, 10, 7, 7)
    with pytest.raises(ValueError, match="40 robots that know the map need 3,920 bytes"):
        BatchedEnv(4, **settings)
    assert BatchedEnv(400, num_agents=10)._state.distances.size == 0
    monkeypatch.setattr(team_state, "MOST_TABLE_BYTES", 2 * 10 * 10 * 200)
    long = BatchedEnv(1, **settings | {"height": 4, "width": 500, "density": 0.0})
    assert long._state.distances.shape == (1, 10, 10, 200)  # as much of the map as there is room for


@pytest.mark.parametrize("weights", ["binary", "distance"])
def test_a_large_team_perceives_what_the_dense_rules_say(weights: Any) -> None:
    instance = random_instance(height=90, width=110, density=0.1, num_agents=5000, seed=3)
    env = BatchedEnv(
        1, num_agents=5000, height=90, width=110, comm_weights=weights, extra_channels=("other_goals",), fill=True
    )
    env.reset(0, instances=[instance], observe=False)
    generator = np.random.default_rng(1)
    for _ in range(3):
        env.step(generator.integers(0, 5, (1, 5000)), observe=False)
    bag = env.bag()
    graph = rules.communication_graph(env.positions, 5.0, weights=weights)[0]
    receiver, sender = np.nonzero(graph)
    assert np.array_equal(bag.edge_index, [sender, receiver])
    assert np.array_equal(bag.edge_weight, graph[receiver, sender])
    views = rules.observe(rules.bordered(env.grids, 4), env.positions, env.goals, 4)[0]
    assert np.array_equal(bag.fov[:, :3], views)
    marks = np.pad(np.zeros((90, 110), np.float32), 4)
    marks[tuple((env.goals[0] + 4).T)] = 1
    for robot in generator.integers(0, 5000, 200).tolist():
        (row, col), goal = env.positions[0, robot], env.goals[0, robot] + 4
        window = marks[row : row + 9, col : col + 9].copy()
        down, right = goal - (row, col)
        if 0 <= down < 9 and 0 <= right < 9:
            window[down, right] = 0
        assert np.array_equal(bag.fov[robot, 3, 1:-1, 1:-1], window)


@pytest.mark.parametrize("shield", ["idle", "pibt", "pibt_swap"])
def test_robots_behind_walls_do_not_change_a_step(shield: str) -> None:
    """The first robots of a team, walled off from the others, perceive and move as if they were alone."""
    one = random_instance(height=30, width=30, density=0.1, num_agents=200, seed=1)
    other = random_instance(height=30, width=40, density=0.1, num_agents=500, seed=2)
    wall, east = np.ones((30, 9), np.bool_), np.array([0, 39])
    grid = np.concatenate([one.grid, wall, other.grid], axis=1)
    starts = np.concatenate([one.starts, other.starts + east])
    goals = np.concatenate([one.goals, other.goals + east])
    together = Instance(grid, starts, goals)
    settings: dict[str, Any] = {
        "height": 30,
        "density": 0.0,
        "style": "empty",
        "shield": shield,
        "extra_channels": ("cost_to_go",),
    }
    large = BatchedEnv(1, num_agents=together.num_agents, width=79, **settings)
    small = BatchedEnv(1, num_agents=200, width=30, **settings)
    large.reset(7, instances=[together], observe=False)
    small.reset(7, instances=[one], observe=False)
    generator = np.random.default_rng(0)
    for _ in range(30):
        whole, part = large.bag(), small.bag()
        heard = whole.edge_index[:, whole.edge_index[1] < 200]
        assert np.array_equal(whole.fov[:200], part.fov)
        assert np.array_equal(heard, part.edge_index)
        actions = generator.integers(0, 5, (1, together.num_agents))
        large.step(actions, observe=False)
        small.step(actions[:, :200], observe=False)
        assert np.array_equal(large.positions[:, :200], small.positions)


@given(strategies.seeds, st.integers(4, 40), st.integers(4, 40), st.floats(0, 1), st.floats(0, 9), st.floats(0, 0.6))
@hypothesis_settings(max_examples=60)
def test_edges_are_those_of_the_dense_graph_on_random_worlds(
    seed: int, height: int, width: int, crowded: float, radius: float, loss: float
) -> None:
    robots = max(round(crowded * 0.7 * height * width), 2)
    instance = random_instance(height=height, width=width, density=0.1, num_agents=robots, seed=seed)
    states = States.start_of([instance], Senses(comm_radius=radius), [0], seeds=[seed])
    bag = perceive(states, MapSet([instance.grid], 4), Senses(comm_weights="distance"), message_loss=loss)
    dense = rules.communication_graph(instance.starts[None], radius, weights="distance")
    dense = rules.lose_messages(dense, loss, states.seeds, np.zeros(1, np.int64))[0]
    receiver, sender = np.nonzero(dense)
    assert np.array_equal(bag.edge_index, [sender, receiver])
    assert np.array_equal(bag.edge_weight, dense[receiver, sender])


@pytest.mark.parametrize("shield", ["idle", "pibt"])
def test_regions_that_cannot_see_each_other_step_as_if_the_world_were_cut(shield: str) -> None:
    """Four walled regions of 1,500 robots each are one team that is read tile by tile; a region alone is not."""
    parts = [random_instance(height=150, width=130, density=0.1, num_agents=1500, seed=seed) for seed in range(4)]
    wall, shift = np.ones((150, 9), np.bool_), 139
    grid = np.concatenate([block for part in parts for block in (part.grid, wall)], axis=1)
    east = [np.array([0, shift * number]) for number in range(4)]
    starts = np.concatenate([part.starts + own for part, own in zip(parts, east, strict=True)])
    goals = np.concatenate([part.goals + own for part, own in zip(parts, east, strict=True)])
    together, width = Instance(grid, starts, goals), 4 * shift
    settings: dict[str, Any] = {"num_agents": 6000, "height": 150, "density": 0.0, "style": "empty", "shield": shield}
    env = BatchedEnv(1, width=width, **settings)
    alone = [BatchedEnv(1, width=width, **settings) for _ in parts]  # all others idle, so that numbers are the same
    for each in (env, *alone):
        each.reset(7, instances=[together], observe=False)
    generator = np.random.default_rng(0)
    for _ in range(6):
        actions = generator.integers(0, 5, (1, 6000))
        env.step(actions, observe=False)
        for number, each in enumerate(alone):
            own = slice(1500 * number, 1500 * (number + 1))
            wanted = np.full_like(actions, 4)
            wanted[:, own] = actions[:, own]
            each.step(wanted, observe=False)
            assert np.array_equal(env.positions[0, own], each.positions[0, own])
    bag, maps = env.bag(), MapSet([part.grid for part in parts], 4)
    first = 0
    for number, part in enumerate(parts):
        own = slice(1500 * number, 1500 * (number + 1))
        here = part.at(env.positions[0, own] - east[number])
        state = States.start_of([here], Senses(), [number])
        region = perceive(state, maps, Senses())
        last = first + region.edge_index.shape[1]
        assert np.array_equal(bag.fov[own], region.fov)
        assert np.array_equal(bag.edge_index[:, first:last], region.edge_index + 1500 * number)
        assert np.array_equal(bag.edge_weight[first:last], region.edge_weight)
        first = last
    assert first == bag.edge_index.shape[1]


def test_threads_change_nothing_in_large_teams() -> None:
    settings: dict[str, Any] = {"num_agents": 4500, "height": 150, "width": 150, "shield": "pibt"}
    one, several = (BatchedEnv(2, threads=threads, **settings) for threads in (1, 2))
    generator = np.random.default_rng(0)
    for each in (one, several):
        each.reset(0, observe=False)
    for _ in range(4):
        assert all(np.array_equal(ours, theirs) for ours, theirs in zip(one.bag(), several.bag(), strict=True))
        actions = generator.integers(0, 5, (2, 4500))
        for each in (one, several):
            each.step(actions, observe=False)
        assert np.array_equal(one.positions, several.positions)


def test_a_push_may_be_as_long_as_the_team() -> None:
    count = 300_000
    starts = np.stack([np.zeros(count, np.int32), np.arange(count, dtype=np.int32)], axis=1)
    corridor = np.zeros((1, count + 1), np.uint8)
    maps = rules.bordered(corridor[None] != 0, 1, np.uint8)
    waits = np.zeros((1, count), np.int32)
    waits[0, 0] = 1  # the last in the row pushes all the others
    seeds, times = np.zeros(1, np.uint64), np.zeros(1, np.int64)
    wanted = np.full((1, count), 3)
    executed = rules.pibt_shield(maps, 1, starts[None], wanted, waits, seeds, times)
    assert (executed == 3).all()


def test_dense_graphs_that_no_machine_holds_are_refused() -> None:
    env = BatchedEnv(1, num_agents=60_000, height=300, width=300, density=0.0)
    with pytest.raises(ValueError, match=r"call reset and step with observe=False and read bag\(\)"):
        env.reset(0)
    env.reset(0, observe=False)
    env.step(np.zeros((1, 60_000), np.int64), observe=False)
    assert len(env.bag().team) == 60_000
