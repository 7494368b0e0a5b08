"""Bags: what teams of any sizes on maps of any sizes perceive together is what they perceive alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import oracles
import strategies
from mapf_env import (
    HISTORY,
    Bag,
    BatchedEnv,
    EnvConfig,
    Instance,
    MapSet,
    Senses,
    States,
    perceive,
    random_instance,
    rules,
)

ALL = Senses(
    fov_radius=2,
    extra_channels=("cost_to_go", "other_goals", "previous_positions", "greedy_cells", "robots_on_goals"),
    robot_features=("last_moves", "on_goal", "steps_left", "steps_to_go", "under_way", "greedy_moves"),
    edge_features=("relative_position", "goal_direction", "greedy_moves", "last_moves", "on_goal", "priority"),
    comm_radius=3.0,
    comm_weights="distance",
)


def assert_same(one: Bag, other: Bag) -> None:
    for name, a, b in zip(Bag._fields, one, other, strict=True):
        assert a.dtype == b.dtype, name
        assert np.array_equal(a, b), name


def joined(bags: list[Bag], teams: list[int]) -> Bag:
    """The bags one after the other, in plain steps."""
    index, robots = [], 0
    for bag in bags:
        index.append(bag.edge_index + robots)
        robots += len(bag.fov)
    return Bag(
        fov=np.concatenate([bag.fov for bag in bags]),
        scalars=np.concatenate([bag.scalars for bag in bags]),
        edge_index=np.concatenate(index, axis=1),
        edge_weight=np.concatenate([bag.edge_weight for bag in bags]),
        edge_attr=np.concatenate([bag.edge_attr for bag in bags]),
        team=np.concatenate([bag.team + team for bag, team in zip(bags, teams, strict=True)]),
    )


def played(instances: list[Instance], seed: int, steps: int) -> States:
    """States after some steps, of teams that took different numbers of them."""
    parts = []
    for t, instance in enumerate(instances):
        height, width = instance.grid.shape
        env = BatchedEnv(1, num_agents=instance.num_agents, height=height, width=width, density=0, comm_radius=3.0)
        env.reset(seed + t, instances=[instance])
        generator = np.random.default_rng(seed + t)
        for _ in range(steps + t):
            env.step(generator.integers(0, 5, (1, instance.num_agents)), observe=False)
        parts.append(replace(env.states(), maps=np.array([t], np.int32)))
    return States.concatenate(parts)


MIXED = [
    random_instance(num_agents=n, height=h, width=w, density=0.2, seed=n)
    for n, h, w in ((1, 4, 5), (9, 6, 7), (4, 9, 3))
]


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_splitting_and_joining_bags_changes_nothing(dtype: str) -> None:
    states, maps = played(MIXED, 0, 5), MapSet([each.grid for each in MIXED], 3, dtype)
    bag = perceive(states, maps, ALL, message_loss=0.3)
    alone = [perceive(states.take([t]), maps, ALL, message_loss=0.3) for t in range(3)]
    assert_same(bag, joined(alone, [0, 1, 2]))
    assert_same(bag, perceive(states, maps, ALL, message_loss=0.3, threads=3))
    order = [2, 0, 2, 1]
    assert_same(
        perceive(states.take(order), maps, ALL, message_loss=0.3), joined([alone[t] for t in order], [0, 1, 2, 3])
    )
    assert len(bag.edge_weight) > 10
    assert len(perceive(states.take([]), maps, ALL).fov) == 0


@given(strategies.all_settings(), strategies.seeds, st.integers(1, 3), st.integers(1, 2))
@hypothesis_settings(max_examples=60)
def test_an_environments_bag_equals_the_observation_of_its_states(
    settings: dict[str, Any], seed: int, num_envs: int, threads: int
) -> None:
    env, generator = BatchedEnv(num_envs, threads=threads, **settings), np.random.default_rng(seed)
    config, observation = env.config, env.reset(seed)
    limits = np.arange(1, num_envs + 1) * 2
    env.reset(seed, max_cycles=limits.tolist(), observe=False)
    while True:
        ended = env._state.ended.copy()
        maps = MapSet(env.grids, config.fov_radius, config.dtype)
        bag = env.bag()
        states = env.states(~ended)
        states = replace(states, maps=maps.index[states.maps])
        expected = perceive(states, maps, config, message_loss=config.message_loss)
        assert_same(bag, expected._replace(team=np.flatnonzero(~ended)[expected.team]))
        if ended.all():
            break
        observation = env.observe()
        N = config.num_agents
        assert np.array_equal(bag.fov, observation.fov[~ended].reshape(-1, *bag.fov.shape[1:]))
        assert np.array_equal(bag.scalars, observation.scalars[~ended].reshape(len(bag.fov), -1))
        dense = np.zeros_like(observation.graph[~ended])
        team, receiver = bag.edge_index[1] // N, bag.edge_index[1] % N
        dense[team, receiver, bag.edge_index[0] % N] = bag.edge_weight
        assert np.array_equal(dense, observation.graph[~ended])
        attributes = np.zeros_like(observation.edge_attr[~ended])
        attributes[team, receiver, bag.edge_index[0] % N] = bag.edge_attr
        assert np.array_equal(attributes, observation.edge_attr[~ended])
        step = env.step(generator.integers(0, 5, (num_envs, N)), observe=False)
        assert step.observation is None
        assert not step.rewards[ended].any()
    assert (env.times <= limits).all()


def test_a_mask_chooses_among_the_teams_that_are_under_way() -> None:
    env = BatchedEnv(4, num_agents=3, height=6, width=6)
    assert len(env.bag().fov) == 0, "nobody has begun"
    env.reset(seed=0, max_cycles=[9, 1, 9, 9], observe=False)
    env.step(np.full((4, 3), oracles.IDLE), observe=False)
    assert set(env.bag().team.tolist()) == {0, 2, 3}
    assert env.bag(np.array([True, True, False, True])).team.tolist() == [0, 0, 0, 3, 3, 3]
    states = env.states(np.array([False, True, False, True]))
    assert states.maps.tolist() == [1, 3]
    assert states.times.tolist() == [1, 1]
    assert states.limits.tolist() == [1, 9]
    assert (states.moves[:, 0] == oracles.IDLE).all()
    assert (states.moves[:, 1:] == -1).all()
    env.reset(mask=np.array([False, True, False, False]), observe=False)
    assert env.max_cycles.tolist() == [9, 128, 9, 9]
    with pytest.raises(ValueError, match="give one max_cycles or 4 of them, got 2"):
        env.reset(max_cycles=[1, 2])
    with pytest.raises(RuntimeError, match="have ended or were never reset"):
        BatchedEnv(4, num_agents=3).step(np.zeros((4, 3), int), observe=False)


@pytest.mark.parametrize("radius", [0.0, 1.0, 2.5, 6.0, float("inf")])
@pytest.mark.parametrize("weights", ["binary", "distance"])
def test_edges_of_large_teams_are_those_of_the_dense_graph(radius: float, weights: Any) -> None:
    instance = random_instance(num_agents=400, height=40, width=30, density=0.1, seed=0)
    states = States.start_of([instance], Senses(comm_radius=radius), [0])
    bag = perceive(states, MapSet([instance.grid], 4), Senses(comm_weights=weights))
    dense = rules.communication_graph(instance.starts, radius, weights=weights)
    receiver, sender = np.nonzero(dense)
    assert np.array_equal(bag.edge_index, [sender, receiver])
    assert np.array_equal(bag.edge_weight, dense[receiver, sender])


def test_lost_messages_are_those_of_the_dense_graph() -> None:
    instance = random_instance(num_agents=60, height=12, width=12, density=0.1, seed=0)
    states = States.start_of([instance] * 3, Senses(comm_radius=2.5), [0] * 3, seeds=[1, 2, 3])
    bag = perceive(states, MapSet([instance.grid], 4), Senses(), message_loss=0.4)
    graph = rules.communication_graph(np.array([instance.starts] * 3), 2.5)
    kept = rules.lose_messages(graph, 0.4, states.seeds, np.zeros(3, np.int64))
    team, receiver, sender = np.nonzero(kept)
    assert np.array_equal(bag.edge_index, [team * 60 + sender, team * 60 + receiver])
    assert 0.5 < len(team) / graph.sum() < 0.7


def test_states_are_taken_and_concatenated() -> None:
    states = played(MIXED, 3, 4)
    assert len(states) == 3
    assert states.num_robots == 14
    assert states.team.tolist() == [0] * 1 + [1] * 9 + [2] * 4
    again = states.take([2, 0])
    assert again.offsets.tolist() == [0, 4, 5]
    assert np.array_equal(again.positions, np.concatenate([states.positions[10:], states.positions[:1]]))
    assert np.array_equal(states.take(np.array([True, False, True])).maps, [0, 2])
    parts = [states.take([t]) for t in range(3)]
    for name in States.__slots__:
        assert np.array_equal(getattr(States.concatenate(parts), name), getattr(states, name)), name
    with pytest.raises(ValueError, match="no states to concatenate"):
        States.concatenate([])


def test_the_start_of_instances() -> None:
    states = States.start_of(MIXED, Senses(comm_radius=1.0, comm_range="connected"), [0, 1, 2], limits=[5, 6, 7])
    assert states.comm_radius.tolist() == [rules.connecting_radius(each.starts, 1.0) for each in MIXED]
    assert states.limits.tolist() == [5, 6, 7]
    assert np.array_equal(states.positions, np.concatenate([each.starts for each in MIXED]))
    assert (states.moves == -1).all()
    assert not states.stuck().any()


@given(strategies.instances(max_side=3, min_agents=2, max_agents=4), strategies.seeds, st.integers(0, 25))
def test_stuck_robots_stand_off_their_goals_where_they_stood_before(instance: Instance, seed: int, steps: int) -> None:
    height, width = instance.grid.shape
    env = BatchedEnv(1, num_agents=instance.num_agents, height=height, width=width, density=0, fov_radius=1)
    env.reset(seed, instances=[instance])
    generator, past = np.random.default_rng(seed), []
    for _ in range(steps):
        if env._state.ended[0]:
            break
        past.append(env.positions[0].tolist())
        env.step(generator.integers(0, 5, (1, instance.num_agents)), observe=False)
    here, goals = env.positions[0].tolist(), env.goals[0].tolist()
    expected = [
        here[i] != goals[i] and any(then[i] == here[i] for then in past[-HISTORY:]) for i in range(instance.num_agents)
    ]
    assert env.states().stuck().tolist() == expected


def test_equal_maps_share_their_memory() -> None:
    grids = [MIXED[0].grid, MIXED[1].grid, MIXED[0].grid.copy(), np.zeros((2, 8), bool), np.zeros((8, 2), bool)]
    maps = MapSet(grids, 2)
    assert maps.index.tolist() == [0, 1, 0, 2, 3]
    assert len(maps) == 4
    for grid, number in zip(grids, maps.index, strict=True):
        assert np.array_equal(maps.grid(number), grid)
    with pytest.raises(ValueError, match="border must be at least 1"):
        MapSet(grids, 0)
    with pytest.raises(ValueError, match="dtype must be one of uint8, float32"):
        MapSet(grids, 1, "int8")


START = States.start_of(MIXED, ALL, [0, 1, 2])


@pytest.mark.parametrize(
    ("states", "message"),
    [
        (replace(START, maps=np.array([0, 3, 2], np.int32)), "the map of team 1 is number 3, but there are 3 maps"),
        (replace(START, maps=np.array([0, -1, 2], np.int32)), "the map of team 1 is number -1"),
        (replace(START, maps=np.array([0], np.int32)), r"offsets must have shape \(T \+ 1,\)"),
        (replace(START, offsets=np.array([0, 1, 20, 14])), "offsets must not fall, as they do after team 2"),
        (replace(START, offsets=np.array([0, 1, 9, 13])), "offsets end with 13, but there are 14 robots"),
        (replace(START, offsets=np.array([1, 1, 9, 14])), "begin with 0"),
        (replace(START, positions=START.positions - 100), "robot 0 of team 0 at .* lies outside the map"),
        (replace(START, goals=START.goals + 100), "the goal of robot 0 of team 0 at .* lies outside the map"),
        (replace(START, positions=START.positions * 0), "lies on an obstacle|two robots of team 1 stand at"),
        (replace(START, moves=START.moves - 1), r"moves must lie in -1\.\.4, got -2 for robot 0"),
        (replace(START, moves=START.moves[:, :5]), r"moves must have shape \(R, 16\)"),
        (replace(START, limits=START.limits * 0), "the limit of team 0 must be at least 1"),
        (replace(START, comm_radius=-START.comm_radius), "the comm_radius of team 0 must not be negative"),
        (replace(START, comm_radius=START.comm_radius * np.nan), "the comm_radius of team 0 must not be negative"),
        (replace(START, seeds=START.seeds[:2]), r"seeds, times, limits and comm_radius must have shape \(T,\)"),
        (replace(START, under_way=START.under_way[:2]), r"under_way must have shape \(R,\)"),
        (replace(START, positions=START.positions[0]), r"states.positions must have 2 axes, got shape \(2,\)"),
        (replace(START, times=np.array([2**40] * 3)), "states.times must fit into int32"),
    ],
)
def test_states_that_do_not_fit_are_refused(states: States, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        perceive(states, MapSet([each.grid for each in MIXED], 2), ALL)


def test_wrong_arguments_of_perceive_are_refused() -> None:
    maps = MapSet([each.grid for each in MIXED], 2)
    with pytest.raises(TypeError, match=r"states.positions must be int32, got dtype float64"):
        perceive(replace(START, positions=START.positions * 1.0), maps, ALL)
    with pytest.raises(ValueError, match="need a border of at least fov_radius"):
        perceive(START, maps, Senses())
    with pytest.raises(ValueError, match="cost_to_go takes 257 values with fov_radius=64"):
        perceive(START, maps, Senses(fov_radius=64, extra_channels=("cost_to_go",)))
    with pytest.raises(ValueError, match=r"message_loss must lie in \[0, 1\]"):
        perceive(START, maps, ALL, message_loss=2.0)
    with pytest.raises(ValueError, match="threads must be at least 1"):
        perceive(START, maps, ALL, threads=0)
    with pytest.raises(TypeError, match=r"senses must be a mapf_env\.Senses"):
        perceive(START, maps, {"fov_radius": 2})  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"maps must be a mapf_env\.MapSet"):
        perceive(START, [each.grid for each in MIXED], ALL)  # pyright: ignore[reportArgumentType]


def test_settings_of_an_environment_are_senses_too() -> None:
    env = BatchedEnv(2, num_agents=4, height=7, width=7, fov_radius=3, dtype="uint8", robot_features=("on_goal",))
    env.reset(seed=0)
    assert isinstance(env.config, EnvConfig)
    assert_same(env.bag(), perceive(env.states(), MapSet(env.grids, 3), env.config))
