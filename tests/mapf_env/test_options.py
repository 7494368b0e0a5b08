"""The options beyond the paper: each one against its definition, and all of them at once against the rules."""

import math
from collections.abc import Sequence
from itertools import pairwise, permutations, product
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.vector import AutoresetMode
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import oracles
import strategies
from mapf_env import (
    HISTORY,
    SCHEMES,
    BatchedEnv,
    Instance,
    MapSet,
    Observation,
    Rewards,
    States,
    communication_edges,
    perceive,
    random_instance,
    rules,
)
from mapf_env.senses import channels, edge_features, robot_features


def by_the_rules(env: BatchedEnv, moves: list[npt.NDArray[np.int8]], under_way: npt.NDArray[np.int32]) -> Observation:
    """Build the observation from the pure functions; `moves` are all moves so far, newest first."""
    config, positions, goals = env.config, env.positions, env.goals
    B, N = positions.shape[:2]
    maps = rules.bordered(env.grids, config.fov_radius, config.dtype)
    graph = rules.communication_graph(positions, env.comm_radius, weights=config.comm_weights)
    graph = rules.lose_messages(graph, config.message_loss, episode_seeds(env), env.times)
    remembered = [*moves, *[np.full((B, N), -1, np.int8)] * HISTORY][:HISTORY]
    # Equal grids share one map, so a team's map is not its number.
    shared = MapSet(env.grids, config.fov_radius, config.dtype)
    states = States(
        maps=shared.index,
        offsets=np.arange(B + 1) * N,
        positions=positions.reshape(-1, 2),
        goals=goals.reshape(-1, 2),
        moves=np.stack(remembered, -1).reshape(-1, HISTORY),
        under_way=under_way.reshape(-1),
        seeds=episode_seeds(env),
        times=env.times.astype(np.int32),
        limits=np.full(B, config.max_cycles, np.int32),
        comm_radius=env.comm_radius,
    )
    bag = perceive(states, shared, config, message_loss=config.message_loss)
    fov = bag.fov.reshape(B, N, *bag.fov.shape[1:])
    assert np.array_equal(fov[:, :, :3], rules.observe(maps, positions, goals, config.fov_radius))
    edge_attr = np.zeros((B, N, N, config.num_edge_features), np.float32)
    edge_attr[bag.edge_index[1] // N, bag.edge_index[1] % N, bag.edge_index[0] % N] = bag.edge_attr
    return Observation(fov, graph, bag.scalars.reshape(B, N, -1), edge_attr)


def episode_seeds(env: BatchedEnv) -> npt.NDArray[np.uint64]:
    return env._state.seeds.copy()


@given(strategies.all_settings(), strategies.seeds, st.integers(1, 4), st.integers(1, 3))
@hypothesis_settings(max_examples=150)
def test_the_fused_step_is_the_rules_one_after_another(
    settings: dict[str, Any], seed: int, num_envs: int, threads: int
) -> None:
    env, generator = BatchedEnv(num_envs, threads=threads, **settings), np.random.default_rng(seed)
    config, N = env.config, env.num_agents
    observation = env.reset(seed)
    seeds, moves = episode_seeds(env), list[npt.NDArray[np.int8]]()
    under_way, arrivals = np.zeros((num_envs, N), np.int32), np.zeros((num_envs, N), np.int32)
    for time in range(config.max_cycles):
        expected = by_the_rules(env, moves, under_way)
        for one, other in zip(observation, expected, strict=True):
            assert np.array_equal(one, other)
        before, goals = env.positions, env.goals
        maps = rules.bordered(env.grids, config.fov_radius, config.dtype)
        wanted = generator.integers(0, 5, (num_envs, N))
        values = generator.normal(size=(num_envs, N, 5)).astype(np.float32)
        by_scores = config.shield != "idle" and time % 2 == 1
        times = np.full(num_envs, time)
        if config.shield == "idle":
            executed = rules.shield(maps, config.fov_radius, before, wanted, seeds, times)
        else:
            asked = values if by_scores else wanted
            swap: dict[str, Any] = {}
            if config.shield == "pibt_swap":
                swap = {"goals": goals, "distances": rules.distance_tables(maps, config.fov_radius, goals)}
            executed = rules.pibt_shield(maps, config.fov_radius, before, asked, under_way, seeds, times, **swap)
            wanted = values.argmax(-1) if by_scores else wanted
        step = env.step(values if by_scores else wanted)
        observation, moves = step.observation, [executed, *moves]
        after = rules.move(before, executed)
        assert (env.positions == after).all()
        assert (step.replaced == (executed != wanted)).all()
        on_goal, was_on_goal = (after == goals).all(-1), (before == goals).all(-1)
        lifelong = config.task == "lifelong"
        arrived = on_goal & ~was_on_goal
        assert (step.arrived == arrived).all()
        arrivals += arrived
        under_way = np.where(on_goal, 0, under_way + 1).astype(np.int32)
        solved = on_goal.all(1) & (not lifelong)
        assert (step.terminated == solved).all()
        assert (step.truncated == (~solved & (time + 1 == config.max_cycles))).all()
        scheme = config.rewards
        expected_rewards = np.where(on_goal, scheme.on_goal, scheme.off_goal) + scheme.arrival * arrived
        expected_rewards = expected_rewards + scheme.replaced * step.replaced + scheme.solved * solved[:, None]
        for b in range(num_envs) if scheme.closer else []:
            for i in range(N):
                steps = oracles.distances(env.grids[b], tuple(goals[b, i].tolist()))
                closer = steps[tuple(before[b, i].tolist())] - steps[tuple(after[b, i].tolist())]
                expected_rewards[b, i] += scheme.closer * closer
        assert np.allclose(step.rewards, expected_rewards)
        if lifelong:
            assert (
                env.goals == rules.draw_goals(maps, config.fov_radius, after, goals, on_goal, arrivals, seeds)
            ).all()
        else:
            assert (env.goals == goals).all()
        if (step.terminated | step.truncated).any():
            return


@given(strategies.crowds(max_side=6), st.data(), strategies.seeds)
def test_pibt_never_collides_and_the_first_robot_gets_its_wanted_action(
    crowd: tuple[oracles.Grid, list[oracles.Cell]], data: st.DataObject, seed: int
) -> None:
    grid, team = crowd
    n, generator = len(team), np.random.default_rng(seed)
    maps, positions = rules.bordered(grid[None], 2), np.array([team], np.int32)
    under_way = np.array([data.draw(st.permutations(range(n)))], np.int32)
    values = generator.normal(size=(1, n, 5)).astype(np.float32)
    seeds, times = np.array([seed], np.uint64), np.zeros(1, np.int64)
    executed = rules.pibt_shield(maps, 2, positions, values, under_way, seeds, times)[0].tolist()
    after = [oracles.moved(cell, action) for cell, action in zip(team, executed, strict=True)]
    assert oracles.faults(grid, team, after) == []
    wanted = np.array([data.draw(strategies.joint_actions(n))])
    executed = rules.pibt_shield(maps, 2, positions, wanted, under_way, seeds, times)[0].tolist()
    after = [oracles.moved(cell, action) for cell, action in zip(team, executed, strict=True)]
    assert oracles.faults(grid, team, after) == []
    free, first = oracles.free_cells(grid), int(under_way[0].argmax())
    target = oracles.moved(team[first], int(wanted[0, first]))
    if target in free and target not in team:
        assert executed[first] == wanted[0, first], "nobody is more important, and the cell is empty"


@given(strategies.crowds(max_side=6), st.data())
@hypothesis_settings(max_examples=300)
def test_pibt_is_the_algorithm_of_its_paper(
    crowd: tuple[oracles.Grid, list[oracles.Cell]], data: st.DataObject
) -> None:
    """Priorities and preferences without ties leave nothing to the lot, so the whole joint action is known."""
    grid, team = crowd
    under_way = data.draw(st.permutations(range(len(team))))
    wishes = [data.draw(st.permutations(range(5))) for _ in team]
    values = np.array([[[-wish.index(action) for action in range(5)] for wish in wishes]], np.float32)
    order = sorted(range(len(team)), key=lambda robot: -under_way[robot])
    expected = oracles.pibt(grid, team, order, wishes)
    assert pibt_alone(grid, team, values, under_way, seed=data.draw(strategies.seeds)) == expected


@given(strategies.instances(max_side=6, max_agents=8), st.data())
@hypothesis_settings(max_examples=500)
def test_swaps_are_those_of_the_paper(instance: Instance, data: st.DataObject) -> None:
    grid, team, goals = instance.grid, oracles.cells(instance.starts), oracles.cells(instance.goals)
    under_way = data.draw(st.permutations(range(len(team))))
    wishes = [data.draw(st.permutations(range(5))) for _ in team]
    by_distance = data.draw(st.booleans())  # as a planner would have them
    if by_distance:
        tables = [oracles.distances(grid, goal) for goal in goals]
        wishes = [
            tuple(sorted(wish, key=lambda action: table.get(oracles.moved(cell, action), 10**6)))
            for wish, table, cell in zip(wishes, tables, team, strict=True)
        ]
    values = np.array([[[-wish.index(action) for action in range(5)] for wish in wishes]], np.float32)
    order = sorted(range(len(team)), key=lambda robot: -under_way[robot])
    expected = oracles.pibt(grid, team, order, wishes, goals)
    executed = pibt_alone(grid, team, values, under_way, seed=0, goals=goals)
    assert executed == expected
    after = [oracles.moved(cell, action) for cell, action in zip(team, executed, strict=True)]
    assert oracles.faults(grid, team, after) == []


@pytest.mark.parametrize("walls", [["....", "##.#"], [".#.", "...", ".#."], ["...", ".#.", "..."]])
def test_no_swap_of_a_small_team_is_illegal(walls: list[str]) -> None:
    """All teams of two robots with all goals on maps of a few cells, and of three on the smallest."""
    grid = np.array([[cell == "#" for cell in row] for row in walls])
    free = sorted(oracles.free_cells(grid))
    maps = rules.bordered(grid[None], 2)
    wishes = {
        (cell, goal): sorted(range(5), key=lambda action: table.get(oracles.moved(cell, action), 99))
        for goal in free
        for table in [oracles.distances(grid, goal)]
        for cell in free
    }
    for n in (2, 3) if len(free) <= 5 else (2,):
        for team in permutations(free, n):
            joint = [goals for goals in permutations(free, n) if goals != team]
            count = len(joint)
            positions, targets = np.array([team] * count, np.int32), np.array(joint, np.int32)
            values = np.array(
                [
                    [[-wishes[cell, goal].index(a) for a in range(5)] for cell, goal in zip(team, goals, strict=True)]
                    for goals in joint
                ],
                np.float32,
            )
            many = np.broadcast_to(maps, (count, *maps.shape[1:])).copy()
            zeros = np.zeros((count, n), np.int32) + np.arange(n, 0, -1, dtype=np.int32)
            tables = rules.distance_tables(many, 2, targets)
            seeds, times = np.zeros(count, np.uint64), np.zeros(count, np.int64)
            executed = rules.pibt_shield(
                many, 2, positions, values, zeros, seeds, times, goals=targets, distances=tables
            )
            for actions, goals in zip(executed.tolist(), joint, strict=True):
                after = [oracles.moved(cell, action) for cell, action in zip(team, actions, strict=True)]
                assert oracles.faults(grid, team, after) == []
                order = range(n)
                moves = [wishes[cell, goal] for cell, goal in zip(team, goals, strict=True)]
                assert actions == oracles.pibt(grid, team, order, moves, goals)


def test_two_robots_change_places_in_a_corridor_with_one_branch() -> None:
    grid, generator = np.array([[0] * 9, [1, 0, *[1] * 7]], bool), np.random.default_rng(0)
    facing = Instance(grid, [(0, 3), (0, 8)], [(0, 8), (0, 3)])
    tables = [oracles.distances(grid, goal) for goal in oracles.cells(facing.goals)]
    arrived = {}
    for shield in ("pibt", "pibt_swap"):
        env = BatchedEnv(1, num_agents=2, height=2, width=9, density=0, shield=shield, max_cycles=60)
        env.reset(0, instances=[facing])
        arrived[shield] = False
        for _ in range(60):
            team = oracles.cells(env.positions[0])
            ways = [
                [table.get(oracles.moved(cell, action), 99) for action in range(5)]
                for cell, table in zip(team, tables, strict=True)
            ]
            ties = generator.random((1, 2, 5), np.float32) / 2
            step = env.step(ties - np.array(ways, np.float32))
            arrived[shield] |= bool(step.terminated[0])
            if arrived[shield]:
                break
    assert arrived == {"pibt": False, "pibt_swap": True}


@given(strategies.crowds(max_side=4, max_agents=3), st.data(), strategies.seeds)
@hypothesis_settings(max_examples=50)
def test_pibt_randomises_only_ties(
    crowd: tuple[oracles.Grid, list[oracles.Cell]], data: st.DataObject, seed: int
) -> None:
    grid, team = crowd
    robots = range(len(team))
    wanted = data.draw(strategies.joint_actions(len(team)))
    under_way = [data.draw(st.integers(0, 1)) for _ in team]
    orders = [each for each in permutations(robots) if all(under_way[a] >= under_way[b] for a, b in pairwise(each))]
    heads = [[action] if action == oracles.IDLE else [action, oracles.IDLE] for action in wanted]
    wishes = [[(*head, *tail) for tail in permutations(set(range(5)) - set(head))] for head in heads]
    possible = [oracles.pibt(grid, team, order, joint) for order in orders for joint in product(*wishes)]
    assert pibt_alone(grid, team, np.array([wanted]), under_way, seed) in possible


def test_pibts_lots_are_fair_and_its_priorities_keep_for_an_episode() -> None:
    open_field, centre = np.zeros((3, 3), bool), [(1, 0), (1, 1)]
    pushed = [pibt_alone(open_field, centre, np.array([[3, 4]]), [5, 0], seed=0, time=time)[1] for time in range(900)]
    assert {oracles.UP, oracles.DOWN, oracles.RIGHT} == set(pushed), "back would be a swap"
    assert all(240 < pushed.count(action) < 360 for action in set(pushed))  # 300 expected, standard deviation 14
    corridor, apart = np.zeros((1, 3), bool), [(0, 0), (0, 2)]

    def winner(seed: int, time: int) -> int:
        return pibt_alone(corridor, apart, np.array([[3, 1]]), [0, 0], seed, time).index(oracles.IDLE)

    assert 400 < sum(winner(seed, 0) for seed in range(1000)) < 600
    assert len({winner(7, time) for time in range(20)}) == 1


def pibt_alone(
    grid: oracles.Grid,
    team: list[oracles.Cell],
    wanted: npt.NDArray[Any],
    under_way: Sequence[int],
    seed: int,
    time: int = 0,
    goals: Sequence[oracles.Cell] | None = None,
) -> list[int]:
    """Return the actions that the PIBT shield executes for one team, with swaps if it has goals."""
    maps, positions = rules.bordered(grid[None], 2), np.array([team], np.int32)
    waits, seeds, times = np.array([under_way], np.int32), np.array([seed], np.uint64), np.array([time])
    if goals is None:
        return rules.pibt_shield(maps, 2, positions, wanted, waits, seeds, times)[0].tolist()
    targets = np.array([goals], np.int32)
    tables = rules.distance_tables(maps, 2, targets)
    executed = rules.pibt_shield(maps, 2, positions, wanted, waits, seeds, times, goals=targets, distances=tables)
    return executed[0].tolist()


@given(strategies.crowds(max_side=5), st.data(), strategies.seeds)
def test_pibt_lets_harmless_joint_actions_pass(
    crowd: tuple[oracles.Grid, list[oracles.Cell]], data: st.DataObject, seed: int
) -> None:
    grid, team = crowd
    wanted = oracles.harmless(grid, team, data.draw(strategies.joint_actions(len(team))))
    maps, positions = rules.bordered(grid[None], 1), np.array([team], np.int32)
    under_way = np.zeros((1, len(team)), np.int32)
    executed = rules.pibt_shield(
        maps, 1, positions, [wanted], under_way, np.array([seed], np.uint64), np.zeros(1, np.int64)
    )
    assert executed[0].tolist() == wanted


def test_pibt_pushes_an_idle_robot_aside() -> None:
    grid = np.zeros((2, 3), bool)
    maps, positions = rules.bordered(grid[None], 1), np.array([[(0, 0), (0, 1)]], np.int32)
    under_way = np.array([[5, 0]], np.int32)
    executed = rules.pibt_shield(maps, 1, positions, [[3, 4]], under_way, np.zeros(1, np.uint64), np.zeros(1, np.int64))
    assert executed[0, 0] == oracles.RIGHT
    assert executed[0, 1] != oracles.IDLE


@given(strategies.crowds(max_side=8), st.floats(0.5, 6))
def test_distance_weights_and_edges(crowd: tuple[oracles.Grid, list[oracles.Cell]], radius: float) -> None:
    team = np.array([crowd[1]], np.int32)
    graph = rules.communication_graph(team, radius, weights="distance")
    binary = rules.communication_graph(team, radius)
    assert ((graph > 0) == (binary > 0)).all()
    edges = communication_edges(graph, team)
    assert len(edges.team) == int(binary.sum())
    for b, i, j, weight, offset in zip(*edges, strict=True):
        assert math.isclose(weight, 1 / math.dist(team[b, i], team[b, j]), rel_tol=1e-6)
        assert (team[b, i] + offset == team[b, j]).all()


@given(strategies.crowds(max_side=8), st.floats(0.1, 6))
def test_the_connecting_radius_is_the_least_that_connects(
    crowd: tuple[oracles.Grid, list[oracles.Cell]], start: float
) -> None:
    def connected(radius: float) -> bool:
        hears, reached = oracles.communication_graph(crowd[1], radius), {0}
        while True:
            more = {j for i in reached for j in range(len(crowd[1])) if hears[i, j]} | reached
            if more == reached:
                return len(reached) == len(crowd[1])
            reached = more

    expected = start
    while not connected(expected):
        expected *= 1.1
    assert rules.connecting_radius(np.array(crowd[1], np.int32), start) == expected


@given(strategies.seeds, st.integers(2, 300), st.integers(1, 8), st.floats(1, 400), st.floats(0.1, 9))
def test_crowds_far_apart_are_connected_by_the_longest_link_of_the_shortest_tree(
    seed: int, robots: int, crowds: int, spread: float, start: float
) -> None:
    generator = np.random.default_rng(seed)
    centres = generator.integers(0, 3000, (crowds, 2))
    cells = centres[generator.integers(crowds, size=robots)] + generator.normal(0, spread, (robots, 2))
    positions = np.unique(cells.clip(0, 10_000).astype(np.int32), axis=0)
    generator.shuffle(positions)
    square = ((positions[:, None].astype(np.int64) - positions) ** 2).sum(axis=2)
    outside, gap, longest = np.ones(len(positions), np.bool_), square[0].copy(), 0
    outside[0] = False
    while outside.any():  # the tree grows by its nearest robot
        nearest = np.flatnonzero(outside)[gap[outside].argmin()]
        longest = max(longest, int(gap[nearest]))
        outside[nearest] = False
        gap = np.minimum(gap, square[nearest])
    expected = start
    while len(positions) > 1 and not math.sqrt(longest) < expected:
        expected *= 1.1
    assert rules.connecting_radius(positions, start) == expected


def test_the_smallest_radius_grows_too() -> None:
    assert 1 < rules.connecting_radius(np.array([[0, 0], [0, 1]], np.int32), 5e-324) < 1.1


def test_messages_are_lost_with_the_given_probability_in_each_step() -> None:
    graph = np.ones((1, 30, 30), np.float32)
    lost = [rules.lose_messages(graph, 0.3, np.zeros(1, np.uint64), np.array([time])) for time in range(20)]
    assert abs(1 - np.mean(lost) - 0.3) < 0.02  # five standard deviations of 18,000 draws
    assert any((a != b).any() for a, b in pairwise(lost))
    assert (lost[0] != lost[0].transpose(0, 2, 1)).any(), "each direction for itself"
    assert not rules.lose_messages(graph, 1.0, np.zeros(1, np.uint64), np.zeros(1, np.int64)).any()


def test_lifelong_goals_are_reachable_distinct_and_uniform() -> None:
    env = BatchedEnv(1, num_agents=3, height=3, width=4, density=0.0, task="lifelong", max_cycles=10**6)
    env.reset(seed=0)
    generator, counts, throughput = np.random.default_rng(0), np.zeros((3, 4)), 0
    for _ in range(6000):
        goals = env.goals
        step = env.step(generator.integers(0, 5, (1, 3)))
        assert not step.terminated.any()
        assert len(np.unique(env.goals[0], axis=0)) == 3
        throughput += int(step.arrived.sum())
        for i in np.flatnonzero(step.arrived[0]):
            assert (env.goals[0, i] != goals[0, i]).any()
            counts[tuple(env.goals[0, i])] += 1
    assert counts.sum() == throughput > 400
    assert counts.min() > 0.5 * counts.mean()


def test_lifelong_goals_stay_in_the_region_of_their_robot() -> None:
    parted = Instance([[0, 0, 0, 1, 0, 0, 0]], [[0, 0], [0, 4]], [[0, 1], [0, 5]])
    env = BatchedEnv(1, num_agents=2, height=1, width=7, density=0.0, task="lifelong", max_cycles=10**6)
    env.reset(seed=0, instances=[parted])
    generator, arrivals = np.random.default_rng(0), 0
    for _ in range(300):
        arrivals += int(env.step(generator.choice([1, 3], (1, 2))).arrived.sum())
        assert (env.goals[0, :, 1] // 4 == [0, 1]).all()
    assert arrivals > 20


@given(strategies.crowds(max_side=5), st.data(), strategies.seeds)
def test_new_goals_are_as_defined(
    crowd: tuple[oracles.Grid, list[oracles.Cell]], data: st.DataObject, seed: int
) -> None:
    """They are reachable, nobody's goal and not where the robot stands; without such a cell the goal stays."""
    grid, team = crowd
    arrived = np.array([data.draw(st.lists(st.booleans(), min_size=len(team), max_size=len(team)))])
    goals = [data.draw(st.permutations(sorted(oracles.free_cells(grid))))[: len(team)]]
    maps, positions = rules.bordered(grid[None], 1), np.array([team], np.int32)
    counts, seeds = np.ones((1, len(team)), np.int32), np.array([seed], np.uint64)
    drawn = rules.draw_goals(maps, 1, positions, np.array(goals, np.int32), arrived, counts, seeds)
    left = list(goals[0])
    for robot, new in enumerate(oracles.cells(drawn[0])):
        possible = set(oracles.distances(grid, team[robot])) - set(left) - {team[robot]}
        if arrived[0, robot] and possible:
            assert new in possible
        else:
            assert new == left[robot]
        left[robot] = new


def hits_of_new_goals(grid: npt.NDArray[np.bool_], draws: int) -> npt.NDArray[np.int_]:
    """Count the draws of each cell by a robot in the first corner, which is its goal too."""
    maps = rules.bordered(np.broadcast_to(grid, (draws, *grid.shape)), 1)
    start = np.zeros((draws, 1, 2), np.int32)
    arrived, counts = np.ones((draws, 1), np.bool_), np.ones((draws, 1), np.int32)
    drawn = rules.draw_goals(maps, 1, start, start, arrived, counts, np.arange(draws).astype(np.uint64))
    hits = np.zeros(grid.shape, int)
    np.add.at(hits, tuple(drawn[:, 0].T), 1)
    return hits


def test_new_goals_are_uniform_where_most_cells_are_blocked() -> None:
    grid = np.array([[0] * 8, [1] * 7 + [0]], bool)
    hits = hits_of_new_goals(grid, 4000)
    assert hits[0, 0] == hits[grid].sum() == 0
    assert all(400 < hit < 600 for hit in hits[hits > 0])  # 500 expected, standard deviation 21


def test_new_goals_are_uniform_where_cells_that_fit_are_very_rare() -> None:
    draws, grid = 3000, np.ones((40, 40), bool)
    free = [(0, 0), (0, 1), (1, 0), (1, 1), (39, 0)]
    grid[tuple(np.transpose(free))] = False
    hits = hits_of_new_goals(grid, draws)
    assert hits.sum() == sum(hits[cell] for cell in free[1:4]) == draws, "no way leads to the last cell"
    assert all(870 < hits[cell] < 1130 for cell in free[1:4])  # 1000 expected, standard deviation 26


def test_edges_of_a_batch_are_those_of_its_teams() -> None:
    env = BatchedEnv(3, num_agents=7, height=8, width=8, comm_weights="distance", message_loss=0.3)
    graph = env.reset(seed=2).graph
    edges, expected = env.edges(graph), []
    for b in range(3):
        for i in range(7):
            for j in range(7):
                if graph[b, i, j]:
                    expected.append((b, i, j, graph[b, i, j], *(env.positions[b, j] - env.positions[b, i]).tolist()))
    assert [(*row[:4], *row[4].tolist()) for row in zip(*edges, strict=True)] == expected
    assert len({row[0] for row in expected}) == 3


def test_a_lifelong_robot_without_a_free_cell_keeps_its_goal() -> None:
    full = Instance(np.zeros((1, 2), bool), [[0, 0], [0, 1]], [[0, 1], [0, 0]])
    env = BatchedEnv(1, num_agents=2, height=1, width=2, density=0.0, task="lifelong")
    env.reset(instances=[full.at(full.goals)])
    assert not env.step([[4, 4]]).arrived.any()
    assert (env.goals[0] == full.goals).all()


@pytest.mark.parametrize("shield", ["idle", "pibt"])
@pytest.mark.parametrize("task", ["one_shot", "lifelong"])
def test_a_robot_that_does_not_move_does_not_arrive(task: str, shield: str) -> None:
    """A full map, where no robot can get a new goal, idle, blocked by each other and by walls."""
    cells = [(0, 0), (0, 1), (1, 0), (1, 1)]
    full = Instance(np.zeros((2, 2), bool), cells, cells)
    settings: dict[str, Any] = {"num_agents": 4, "height": 2, "width": 2, "density": 0.0, "shield": shield}
    env, returned = BatchedEnv(1, task=task, reward="arrival", **settings), np.zeros(4)
    for actions in ([4, 4, 4, 4], [0, 0, 1, 3], [3, 1, 4, 4]):
        for _ in range(10):
            env.reset(seed=0, instances=[full])
            step = env.step([actions])
            returned += step.rewards[0]
            moved = (env.positions[0] != full.starts).any(axis=1)
            assert not (step.arrived[0] & ~moved).any()
    if shield == "idle":
        assert returned.tolist() == [0, 0, 0, 0]


def test_a_lifelong_robot_that_begins_on_its_goal_gets_a_new_one_without_an_arrival() -> None:
    instance = Instance(np.zeros((1, 5), bool), [[0, 0], [0, 4]], [[0, 0], [0, 3]])
    env = BatchedEnv(1, num_agents=2, height=1, width=5, density=0.0, task="lifelong", reward="arrival")
    env.reset(seed=0, instances=[instance])
    step = env.step([[4, 4]])
    assert not step.arrived.any()
    assert not step.rewards.any()
    assert env.goals[0, 0].tolist() in ([0, 1], [0, 2], [0, 4])
    assert env.goals[0, 1].tolist() == [0, 3]
    assert not env.on_goal().any()


@given(strategies.all_settings(), strategies.seeds)
@hypothesis_settings(max_examples=50)
def test_arrivals_are_moves_onto_goals(settings: dict[str, Any], seed: int) -> None:
    env, generator = BatchedEnv(3, **settings), np.random.default_rng(seed)
    env.reset(seed)
    for _ in range(env.config.max_cycles):
        before, goals = env.positions, env.goals
        step = env.step(generator.integers(0, 5, (3, env.num_agents)))
        moved = (env.positions != before).any(-1)
        assert (step.arrived == (moved & (env.positions == goals).all(-1))).all()
        if (step.terminated | step.truncated).any():
            return


def test_reward_schemes() -> None:
    corridor = Instance(np.zeros((1, 4), bool), [[0, 0], [0, 3]], [[0, 1], [0, 3]])

    def rewards(scheme: str | Rewards, *joint: list[int]) -> list[float]:
        env = BatchedEnv(1, num_agents=2, height=1, width=4, density=0, reward=scheme)
        env.reset(instances=[corridor])
        return [env.step([actions]).rewards[0].tolist() for actions in joint][-1]

    assert rewards("flowtime", [4, 4]) == [-1, 0]
    assert rewards("shaped", [3, 1]) == [1, -2]
    assert rewards("arrival", [3, 1]) == [1, 0]
    assert rewards("solved", [3, 4]) == [1, 1]
    assert rewards(Rewards(replaced=-0.5), [0, 4]) == [-0.5, 0]
    assert set(SCHEMES) == {"flowtime", "shaped", "arrival", "solved"}


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_autoreset_plays_the_episodes_that_a_manual_reset_plays(mode: AutoresetMode) -> None:
    settings: dict[str, Any] = {"num_agents": 3, "height": 4, "width": 4, "max_cycles": 9}
    auto, singles = BatchedEnv(5, autoreset=mode, **settings), [BatchedEnv(1, **settings) for _ in range(5)]
    auto.reset(seed=1)
    for b, single in enumerate(singles):
        single.reset(seed=1 + b)
    generator, due = np.random.default_rng(0), np.zeros(5, bool)
    for _ in range(100):
        actions = generator.integers(0, 5, (5, 3))
        step = auto.step(actions)
        ended = step.terminated | step.truncated
        final = 0
        for b, single in enumerate(singles):
            if mode is AutoresetMode.NEXT_STEP and due[b]:
                assert np.array_equal(step.observation.fov[b], single.reset().fov[0])
                assert not step.rewards[b].any()
                assert not ended[b]
                continue
            expected = single.step(actions[b : b + 1])
            for one, other in zip(step[1:6], expected[1:6], strict=True):
                assert np.array_equal(one[b], other[0])  # pyright: ignore[reportIndexIssue]
            seen = expected.observation.fov[0]
            if mode is AutoresetMode.SAME_STEP and ended[b]:
                assert step.final_observation is not None
                assert np.array_equal(step.final_observation.fov[final], seen)
                final += 1
                seen = single.reset().fov[0]
            assert np.array_equal(step.observation.fov[b], seen)
        assert (step.final_observation is None) == (final == 0)
        due = ended


def test_smaller_instances_play_in_a_batch_as_they_play_alone() -> None:
    sizes = ((3, 4, 5), (6, 7, 6), (2, 3, 7))
    instances = [random_instance(num_agents=n, height=h, width=w, seed=n) for n, h, w in sizes]
    options: dict[str, Any] = {"shield": "pibt", "message_loss": 0.2, "reward": "shaped"}
    options |= {"extra_channels": tuple(channels())[3:], "robot_features": tuple(robot_features())}
    options |= {"edge_features": tuple(edge_features())}
    batch = BatchedEnv(3, num_agents=6, height=7, width=7, fill=True, **options)
    seen, generator = batch.reset([7, 8, 9], instances=instances), np.random.default_rng(0)
    alone = [BatchedEnv(1, num_agents=n, height=h, width=w, density=0, **options) for n, h, w in sizes]
    apart = [env.reset(7 + b, instances=[instances[b]]) for b, env in enumerate(alone)]
    assert batch.present.sum(1).tolist() == [3, 6, 2]
    for _ in range(12):
        for b, (n, *_) in enumerate(sizes):
            assert np.array_equal(seen.fov[b, :n], apart[b].fov[0])
            assert np.array_equal(seen.graph[b, :n, :n], apart[b].graph[0])
            assert np.array_equal(seen.scalars[b, :n], apart[b].scalars[0])
            assert np.array_equal(seen.edge_attr[b, :n, :n], apart[b].edge_attr[0])
            assert not seen.fov[b, n:].any()
            assert not seen.scalars[b, n:].any()
            for of_pairs in (seen.graph[b], seen.edge_attr[b]):
                assert not of_pairs[n:].any()
                assert not of_pairs[:, n:].any()
            assert np.array_equal(batch.action_mask()[b, :n], alone[b].action_mask()[0])
            assert batch.action_mask()[b, n:].tolist() == [[0, 0, 0, 0, 1]] * (6 - n)
        actions = generator.integers(0, 5, (3, 6))
        step = batch.step(actions)
        steps = [env.step(actions[b : b + 1, :n]) for b, (env, (n, *_)) in enumerate(zip(alone, sizes, strict=True))]
        for b, (n, *_) in enumerate(sizes):
            assert np.array_equal(step.rewards[b, :n], steps[b].rewards[0])
            assert not step.rewards[b, n:].any()
            assert step.terminated[b] == steps[b].terminated[0]
        if (step.terminated | step.truncated).any():
            break
        seen, apart = step.observation, [one.observation for one in steps]


def test_robots_that_are_not_there_earn_and_do_nothing_wherever_one_stood_before() -> None:
    cases = [random_instance(num_agents=n, height=5, width=5, seed=n) for n in (1, 3, 9)]
    settings: dict[str, Any] = {"num_agents": 9, "height": 5, "width": 5, "max_cycles": 3, "fill": True}
    env = BatchedEnv(16, cases=cases, autoreset=AutoresetMode.SAME_STEP, **settings)
    env.reset(seed=0)
    generator, replaced = np.random.default_rng(0), 0
    for _ in range(40):
        missing = ~env.present
        assert not env.on_goal()[missing].any()
        step = env.step(generator.integers(0, 5, (16, 9)))
        for part in (step.rewards, step.replaced, step.arrived):
            assert not part[missing].any()
        replaced += int(step.replaced.sum())
    assert replaced > 0


def test_the_outcome_of_a_step_is_of_the_robots_present_before_it() -> None:
    cases = [random_instance(num_agents=n, height=5, width=5, seed=n) for n in (1, 3, 9)]
    settings: dict[str, Any] = {"num_agents": 9, "height": 5, "width": 5, "max_cycles": 3, "fill": True}
    wage = Rewards(on_goal=1.0, off_goal=1.0)
    env = BatchedEnv(16, cases=cases, autoreset=AutoresetMode.SAME_STEP, reward=wage, **settings)
    env.reset(seed=0)
    generator, changed = np.random.default_rng(0), 0
    for _ in range(12):
        before = env.present
        step = env.step(generator.integers(0, 5, (16, 9)))
        assert np.array_equal(step.rewards == 1, before)
        assert np.array_equal(step.observation.fov.any((2, 3, 4)), env.present)
        assert np.array_equal(env.action_mask()[..., :4].any(-1) | env.present, env.present)
        assert env.action_mask()[..., oracles.IDLE].all(), "there is always a choice"
        if step.final_observation is not None:
            ended = step.terminated | step.truncated
            assert np.array_equal(step.final_observation.fov.any((2, 3, 4)), before[ended])
        changed += int((env.present != before).any())
    assert changed > 0


def test_the_radius_grows_at_reset_until_the_robots_that_are_there_are_connected() -> None:
    instances = [random_instance(num_agents=n, height=9, width=9, seed=n) for n in (2, 3, 5, 8)]
    settings: dict[str, Any] = {"num_agents": 8, "height": 9, "width": 9, "comm_radius": 1.0, "fill": True}
    env = BatchedEnv(4, comm_range="connected", **settings)
    env.reset(seed=0, instances=instances)
    assert env.comm_radius.tolist() == [rules.connecting_radius(instance.starts, 1.0) for instance in instances]
    assert (env.comm_radius > 1.0).all()
    grown = env.comm_radius
    env.step(np.full((4, 8), oracles.IDLE))
    assert (env.comm_radius == grown).all(), "for the whole episode"


def test_cases_are_drawn_by_the_seed() -> None:
    cases = [random_instance(num_agents=n, height=5, width=5, seed=n) for n in (2, 3, 4)]
    env = BatchedEnv(64, num_agents=4, height=5, width=5, cases=cases, fill=True, autoreset=AutoresetMode.SAME_STEP)
    env.reset(seed=0)
    assert set(env.present.sum(1).tolist()) == {2, 3, 4}
    starts = env.positions
    env.reset(seed=0)
    assert (env.positions == starts).all()
    with pytest.raises(ValueError, match="there are no cases to play"):
        BatchedEnv(1, cases=[])
    with pytest.raises(ValueError, match="the instance has 2 agents, the environment 4"):
        BatchedEnv(1, num_agents=4, height=5, width=5, cases=cases)


def test_observations_are_written_into_the_callers_buffers() -> None:
    env, control = BatchedEnv(2, num_agents=3), BatchedEnv(2, num_agents=3)
    out = env.buffers()
    assert env.reset(seed=0, out=out) is out
    control.reset(seed=0)
    step, expected = env.step([[0, 1, 2]] * 2, out=out), control.step([[0, 1, 2]] * 2)
    assert step.observation is out
    assert np.array_equal(out.fov, expected.observation.fov)
    assert env.observe(out=out) is out
    wrong = out._replace(fov=np.empty((2, 3, 3, 11, 10), np.float32))
    with pytest.raises(ValueError, match="the buffer for views must have shape"):
        env.step([[4, 4, 4]] * 2, out=wrong)
    lists: list[dict[str, Any]] = [{"robot_features": ("on_goal",)}, {"edge_features": ("on_goal",)}]
    for features in lists:
        more = BatchedEnv(2, num_agents=3, **features)
        more.reset(seed=0, out=more.buffers())
        with pytest.raises(ValueError, match=r"the buffer for (scalars|edge_attr) must have shape \(2, 3, (3, )?1\)"):
            more.step([[4, 4, 4]] * 2, out=out)
    for wrong in (out._replace(fov=out.fov.astype(np.float64)), tuple(out)[:2], out.fov):
        with pytest.raises(TypeError, match="out must be an Observation of contiguous arrays as buffers"):
            env.step([[4, 4, 4]] * 2, out=wrong)  # pyright: ignore[reportCallIssue, reportArgumentType]
    with pytest.raises(ValueError, match="a step without observation needs no arrays"):
        env.step([[4, 4, 4]] * 2, out=out, observe=False)  # pyright: ignore[reportCallIssue, reportArgumentType]


def test_torch_tensors_are_written_too() -> None:
    torch = pytest.importorskip("torch")
    env = BatchedEnv(2, num_agents=3)
    fov, graph = torch.zeros(2, 3, 3, 11, 11), torch.zeros(2, 3, 3)
    env.reset(seed=0, out=Observation(fov, graph, torch.zeros(2, 3, 0), torch.zeros(2, 3, 3, 0)))  # pyright: ignore
    assert np.array_equal(fov.numpy(), env.observe().fov)


def test_threads_change_nothing() -> None:
    def record(threads: int) -> list[Any]:
        env, generator = BatchedEnv(7, threads=threads, num_agents=6, max_cycles=10**6), np.random.default_rng(0)
        env.reset(seed=0)
        return [env.step(generator.integers(0, 5, (7, 6))) for _ in range(30)]

    for one, other in zip(record(1), record(3), strict=True):
        assert np.array_equal(one.observation.fov, other.observation.fov)
        assert np.array_equal(one.rewards, other.rewards)


def test_nothing_is_observed_before_the_first_reset() -> None:
    with pytest.raises(RuntimeError, match="nothing to observe before the first reset"):
        BatchedEnv(1).observe()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"message_loss": 1.5}, r"message_loss must lie in \[0, 1\], got 1.5"),
        ({"comm_range": "far"}, "comm_range must be one of fixed, connected"),
        ({"comm_range": "connected", "comm_radius": 0.0}, "comm_radius must be positive to grow"),
        ({"comm_weights": "loud"}, "comm_weights must be one of binary, distance"),
        ({"task": "endless"}, "task must be one of one_shot, lifelong"),
        ({"reward": "gold"}, "reward must be Rewards or one of flowtime"),
        ({"extra_channels": ("smell",)}, "extra_channels must be some of cost_to_go"),
        ({"extra_channels": ("other_goals", "other_goals")}, "extra_channels must be some of"),
        (
            {"extra_channels": ("cost_to_go",), "dtype": "uint8", "fov_radius": 64},
            "cost_to_go takes 257 values with fov_radius=64",
        ),
    ],
)
def test_options_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BatchedEnv(1, **settings)


def test_wrong_scores_of_actions_are_refused() -> None:
    idle, pibt = BatchedEnv(1, num_agents=2), BatchedEnv(1, num_agents=2, shield="pibt")
    for env in (idle, pibt):
        env.reset(seed=0)
    with pytest.raises(ValueError, match='need a shield other than "idle"'):
        idle.step(np.zeros((1, 2, 5)))
    with pytest.raises(ValueError, match=r"scores of actions must have shape \(1, 2, 5\), got \(1, 2, 4\)"):
        pibt.step(np.zeros((1, 2, 4)))
    with pytest.raises(ValueError, match="a value of agent 1 in environment 0 is not a number"):
        pibt.step(np.array([[[0.0] * 5, [0.0, np.nan, 0, 0, 0]]]))
    with pytest.raises(ValueError, match="threads must be at least 1"):
        BatchedEnv(1, threads=0)
