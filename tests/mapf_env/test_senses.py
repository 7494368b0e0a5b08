"""Each channel and feature against its definition in plain Python, which shares no code with the kernels.

A new channel or feature gets a function and a row in the table of its kind; a test fails as long as one is missing.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import oracles
import strategies
from mapf_env import HISTORY, MOVES, EnvConfig, MapSet, Senses, States, perceive, rules
from mapf_env.senses import channels, edge_features, robot_features


@dataclass
class World:
    """One team at one moment."""

    grid: oracles.Grid
    team: list[oracles.Cell]
    goals: list[oracles.Cell]
    moves: list[list[int]]
    under_way: list[int]
    seed: int
    time: int
    limit: int
    comm_radius: float
    fov_radius: int
    memory: int

    @cached_property
    def steps(self) -> list[dict[oracles.Cell, int]]:
        return [oracles.distances(self.grid, goal) for goal in self.goals]

    def greedy(self, robot: int) -> list[int]:
        """The moves that bring a robot one step nearer to its goal."""
        steps, here = self.steps[robot], self.team[robot]
        nearer = [a for a in range(4) if here in steps and steps.get(oracles.moved(here, a), math.inf) < steps[here]]
        return nearer or [oracles.IDLE]

    def states(self) -> States:
        N = len(self.team)
        return States(
            maps=np.zeros(1, np.int32),
            offsets=np.array([0, N]),
            positions=np.array(self.team, np.int32),
            goals=np.array(self.goals, np.int16),
            moves=np.array(self.moves, np.int8).reshape(N, HISTORY),
            under_way=np.array(self.under_way, np.int32),
            seeds=np.array([self.seed], np.uint64),
            times=np.array([self.time], np.int32),
            limits=np.array([self.limit], np.int32),
            comm_radius=np.array([self.comm_radius]),
        )


@st.composite
def worlds(draw: st.DrawFn, max_side: int = 7) -> World:
    grid, team = draw(strategies.crowds(max_side=max_side))
    N, some = len(team), st.one_of(st.integers(0, 3), st.integers(0, 200_000))
    goals = draw(st.permutations(sorted(oracles.free_cells(grid))))[:N]
    goals = [
        cell if draw(st.integers(0, 3)) == 0 and cell not in goals else goal
        for cell, goal in zip(team, goals, strict=True)
    ]
    ages = [draw(st.integers(0, HISTORY)) for _ in team]
    limit = draw(st.integers(1, 1000))
    return World(
        grid=grid,
        team=list(team),
        goals=goals,
        moves=[[draw(st.integers(0, 4)) if k < age else -1 for k in range(HISTORY)] for age in ages],
        under_way=[draw(some) for _ in team],
        seed=draw(st.integers(0, 2**64 - 1)),
        time=draw(st.integers(0, limit + 2)),
        limit=limit,
        comm_radius=draw(st.sampled_from([0.5, 1.5, 2.0, 4.0, math.inf])),
        fov_radius=draw(st.integers(1, 4)),
        memory=draw(st.integers(1, HISTORY)),
    )


# ---- channels: the value that a robot sees at a cell


def cost_to_go(world: World, robot: int, cell: oracles.Cell) -> float:
    steps, reach = world.steps[robot], 2 * world.fov_radius
    if cell not in steps:
        return 1
    return min(max(steps[cell] - steps.get(world.team[robot], math.inf), -reach), reach) / reach


def other_goals(world: World, robot: int, cell: oracles.Cell) -> float:
    return any(goal == cell for other, goal in enumerate(world.goals) if other != robot)


def previous_positions(world: World, robot: int, cell: oracles.Cell) -> float:
    for here, (last, *_) in zip(world.team, world.moves, strict=True):
        down, right = oracles.STEP[last] if last >= 0 else (0, 0)
        if cell == (here[0] - down, here[1] - right):
            return 1
    return 0


def greedy_cells(world: World, robot: int, cell: oracles.Cell) -> float:
    aims = [
        [oracles.moved(here, action) for action in world.greedy(other)]
        for other, here in enumerate(world.team)
        if other != robot
    ]
    return sum(cells.count(cell) / len(cells) for cells in aims)


def robots_on_goals(world: World, robot: int, cell: oracles.Cell) -> float:
    return any(here == goal == cell for here, goal in zip(world.team, world.goals, strict=True))


CHANNELS: dict[str, Callable[[World, int, oracles.Cell], float]] = {
    "cost_to_go": cost_to_go,
    "other_goals": other_goals,
    "previous_positions": previous_positions,
    "greedy_cells": greedy_cells,
    "robots_on_goals": robots_on_goals,
}


# ---- features of robots


def last_moves(world: World, robot: int) -> list[float]:
    return [float(move == action) for move in world.moves[robot][: world.memory] for action in range(5)]


def on_goal(world: World, robot: int) -> list[float]:
    return [world.team[robot] == world.goals[robot]]


def steps_left(world: World, robot: int) -> list[float]:
    return [max(world.limit - world.time, 0) / world.limit]


def steps_to_go(world: World, robot: int) -> list[float]:
    distance = world.steps[robot].get(world.team[robot])
    return [1 if distance is None else min(1, math.log2(1 + distance) / 16)]


def under_way(world: World, robot: int) -> list[float]:
    return [min(1, math.log2(1 + world.under_way[robot]) / 16)]


def greedy_moves(world: World, robot: int) -> list[float]:
    return [action in world.greedy(robot) for action in range(5)]


def stuck(world: World, robot: int) -> list[float]:
    row, col = world.team[robot]
    earlier = []
    for move in world.moves[robot]:
        if move < 0:
            break
        row, col = row - MOVES[move][0], col - MOVES[move][1]
        earlier.append((row, col))
    return [world.team[robot] != world.goals[robot] and tuple(world.team[robot]) in earlier]


def jammed(world: World, robot: int) -> list[float]:
    row, col = world.team[robot]
    cells = {(row, col)}
    for move in world.moves[robot]:
        row, col = row - MOVES[move][0], col - MOVES[move][1]
        cells.add((row, col))
    return [world.team[robot] != world.goals[robot] and min(world.moves[robot]) >= 0 and len(cells) <= 3]


ROBOT_FEATURES: dict[str, Callable[[World, int], list[float]]] = {
    "last_moves": last_moves,
    "on_goal": on_goal,
    "steps_left": steps_left,
    "steps_to_go": steps_to_go,
    "under_way": under_way,
    "greedy_moves": greedy_moves,
    "stuck": stuck,
    "jammed": jammed,
}


# ---- features of edges: what a receiver knows about a sender


def relative_position(world: World, receiver: int, sender: int) -> list[float]:
    return [(world.team[sender][axis] - world.team[receiver][axis]) / world.comm_radius for axis in (0, 1)]


def goal_direction(world: World, receiver: int, sender: int) -> list[float]:
    way = [world.goals[sender][axis] - world.team[sender][axis] for axis in (0, 1)]
    return [part / max(math.dist(world.goals[sender], world.team[sender]), 1) for part in way]


def priority(world: World, receiver: int, sender: int) -> list[float]:
    key = oracles.mixed(world.seed, 3)
    order = sorted(range(len(world.team)), key=lambda i: (-world.under_way[i], oracles.mixed(key, i) >> 32, i))
    return [order.index(sender) < order.index(receiver)]


EDGE_FEATURES: dict[str, Callable[[World, int, int], list[float]]] = {
    "relative_position": relative_position,
    "goal_direction": goal_direction,
    "greedy_moves": lambda world, _, sender: greedy_moves(world, sender),
    "last_moves": lambda world, _, sender: last_moves(world, sender),
    "on_goal": lambda world, _, sender: on_goal(world, sender),
    "priority": priority,
}


def test_every_channel_and_feature_has_a_definition_here() -> None:
    assert list(channels()) == ["obstacles", "goal", "robots", *CHANNELS]
    assert list(robot_features()) == list(ROBOT_FEATURES)
    assert list(edge_features()) == list(EDGE_FEATURES)


@given(worlds(), st.data())
@hypothesis_settings(max_examples=200)
def test_channels_are_as_defined(world: World, data: st.DataObject) -> None:
    names = tuple(data.draw(st.permutations(list(CHANNELS))))
    senses, radius = Senses(fov_radius=world.fov_radius, extra_channels=names), world.fov_radius
    bytes_, floats = (
        perceive(world.states(), MapSet([world.grid], radius, t), senses).fov for t in ("uint8", "float32")
    )
    assert bytes_.dtype == np.uint8
    assert floats.dtype == np.float32
    decoded = bytes_ / senses.channel_unit[:, None, None] + senses.channel_low[:, None, None]
    assert np.allclose(decoded, floats, atol=1e-6)
    assert (floats >= senses.channel_low[:, None, None]).all()
    assert (floats <= senses.channel_high[:, None, None]).all()
    for i, (row, col) in enumerate(world.team):
        assert np.array_equal(floats[i, :3], oracles.field_of_view(world.grid, world.team, world.goals, i, radius))
        for c, name in enumerate(names):
            expected = np.zeros((2 * radius + 3, 2 * radius + 3))
            for down in range(-radius, radius + 1):
                for right in range(-radius, radius + 1):
                    value = CHANNELS[name](world, i, (row + down, col + right))
                    expected[down + radius + 1, right + radius + 1] = value
            assert np.allclose(floats[i, 3 + c], expected, atol=1e-6), name


@given(worlds(), st.data())
@hypothesis_settings(max_examples=200)
def test_features_of_robots_are_as_defined(world: World, data: st.DataObject) -> None:
    names = tuple(data.draw(st.permutations(list(ROBOT_FEATURES))))
    senses = Senses(robot_features=names, memory=world.memory)
    scalars = perceive(world.states(), MapSet([world.grid], 4), senses).scalars
    assert scalars.shape == (len(world.team), senses.num_robot_features)
    for i, row in enumerate(scalars):
        assert np.allclose(row, np.concatenate([ROBOT_FEATURES[name](world, i) for name in names]), atol=1e-6)
    low, high = senses.robot_feature_bounds
    assert ((low <= scalars) & (scalars <= high)).all()


@given(worlds(), st.data(), st.sampled_from(["binary", "distance"]))
@hypothesis_settings(max_examples=200)
def test_edges_and_their_features_are_as_defined(world: World, data: st.DataObject, weights: Any) -> None:
    names = tuple(data.draw(st.permutations(list(EDGE_FEATURES))))
    senses = Senses(edge_features=names, memory=world.memory, comm_weights=weights)
    bag = perceive(world.states(), MapSet([world.grid], 4), senses)
    robots = range(len(world.team))
    hears = oracles.communication_graph(world.team, world.comm_radius)
    pairs = [(receiver, sender) for receiver in robots for sender in robots if hears[receiver, sender]]
    assert bag.edge_index.T.tolist() == [[sender, receiver] for receiver, sender in pairs]
    assert bag.edge_attr.shape == (len(pairs), senses.num_edge_features)
    for (receiver, sender), weight, row in zip(pairs, bag.edge_weight, bag.edge_attr, strict=True):
        far = math.dist(world.team[receiver], world.team[sender])
        assert math.isclose(weight, 1 if weights == "binary" else 1 / far, rel_tol=1e-6)
        expected = np.concatenate([EDGE_FEATURES[name](world, receiver, sender) for name in names])
        assert np.allclose(row, expected, atol=1e-6)
    low, high = senses.edge_feature_bounds
    assert ((low <= bag.edge_attr) & (bag.edge_attr <= high)).all()


@pytest.mark.parametrize("seed", range(20))
def test_the_one_with_priority_gets_the_cell_under_pibt(seed: int) -> None:
    corridor, ends = np.zeros((1, 3), bool), [(0, 0), (0, 2)]
    for waits in ([0, 0], [3, 1], [1, 3]):
        world = World(corridor, ends, ends[::-1], [[-1] * HISTORY] * 2, waits, seed, 0, 9, 5.0, 1, 1)
        bag = perceive(world.states(), MapSet([corridor], 1), Senses(fov_radius=1, edge_features=("priority",)))
        maps, team = rules.bordered(corridor[None], 1), np.array([ends], np.int32)
        wanted, seeds, times = np.array([[3, 1]]), np.array([seed], np.uint64), np.zeros(1, np.int64)
        executed = rules.pibt_shield(maps, 1, team, wanted, np.array([waits], np.int32), seeds, times)[0]
        goes = {
            sender: bool(first) for sender, first in zip(bag.edge_index[0].tolist(), bag.edge_attr[:, 0], strict=True)
        }
        assert goes == {i: bool(executed[i] != oracles.IDLE) for i in (0, 1)}


def test_senses_that_need_the_map_are_marked() -> None:
    assert not Senses().needs_map
    local: Any = {"extra_channels": ("other_goals",), "robot_features": ("under_way",), "edge_features": ("on_goal",)}
    assert not Senses(**local).needs_map
    assert Senses(extra_channels=("greedy_cells",)).needs_map
    assert Senses(robot_features=("steps_to_go",)).needs_map
    assert Senses(edge_features=("greedy_moves",)).needs_map
    tables = channels(), robot_features(), edge_features()
    history = {name for table in tables for name, facts in table.items() if facts.needs_history}
    assert history == {"previous_positions", "last_moves", "under_way", "priority", "stuck", "jammed"}


def test_the_senses_of_an_environment_are_passed_on_as_settings() -> None:
    lists: Any = {"extra_channels": ["other_goals"], "robot_features": ["on_goal"]}
    config = EnvConfig(fov_radius=3, comm_radius=2, num_agents=3, **lists)
    assert config.extra_channels == ("other_goals",)
    assert Senses(**config.senses()) == Senses(
        fov_radius=3, extra_channels=("other_goals",), robot_features=("on_goal",), comm_radius=2
    )
    assert (config.num_channels, config.fov_side, config.num_robot_features, config.num_edge_features) == (4, 9, 1, 0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"extra_channels": ("smell",)}, "extra_channels must be some of cost_to_go, .*'smell' is not one of them"),
        ({"extra_channels": ("robots",)}, "'robots' is not one of them"),
        ({"robot_features": ("on_goal", "on_goal")}, "robot_features must be some of last_moves, .* has one twice"),
        ({"edge_features": ("steps_left",)}, "edge_features must be some of relative_position, "),
        ({"memory": 17}, "memory must be at most 16"),
        ({"memory": 0}, "memory must be at least 1"),
        ({"comm_radius": -1.0}, "comm_radius must not be negative"),
        ({"comm_range": "far"}, "comm_range must be one of fixed, connected"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Senses(**settings)


def test_one_name_alone_is_refused_with_the_tuple_that_was_meant() -> None:
    with pytest.raises(TypeError, match=r'extra_channels must be a sequence of names such as \("cost_to_go",\)'):
        Senses(extra_channels="cost_to_go")  # pyright: ignore[reportArgumentType]
