"""Teams that learn nothing: what their robots may do, by breadth-first search."""

import numpy as np
import pytest

import oracles
from gnn_policy import rollout
from gnn_policy.baselines import GreedyActor, RandomActor
from gnn_policy.cases import Family, make_cases
from mapf_env import BatchedEnv


def random_cases(seed=0, maps=6, num_agents=(4, 4), density=0.15, size=(6, 7)):
    family = Family(
        height=(size[0], size[0]), width=(size[1], size[1]), num_agents=num_agents, density=(density, density)
    )
    return make_cases("test", seed=seed, maps=maps, cases_per_map=2, families=[family]).instances


def playing(actor, instances, **more):
    """An environment for `actor` in which the instances have begun."""
    sizes = {
        "num_agents": max(each.num_agents for each in instances),
        "height": max(each.grid.shape[0] for each in instances),
        "width": max(each.grid.shape[1] for each in instances),
    }
    env = BatchedEnv(len(instances), fill=True, style="empty", **sizes, **actor.env_settings(), **more)
    env.reset(0, instances=instances, observe=False)
    return env


@pytest.mark.parametrize("num_agents", [(1, 1), (1, 6)])
def test_a_greedy_robot_alone_follows_a_shortest_path(num_agents):
    cases = random_cases(num_agents=num_agents, maps=15, density=0.3)
    played = rollout(GreedyActor(), cases, max_steps=100)
    alone = [i for i, case in enumerate(cases) if case.num_agents == 1]
    for i in alone:
        case, (start,), (goal,) = cases[i], oracles.cells(cases[i].starts), oracles.cells(cases[i].goals)
        shortest = oracles.distances(case.grid, goal)[start]
        assert played.success[i]
        assert played.flowtime[i] == played.makespan[i] == shortest
        assert played.replaced[i] == 0
    assert alone


@pytest.mark.parametrize("shield", ["idle", "pibt", "pibt_swap"])
def test_every_greedy_move_approaches_the_goal_and_robots_on_goals_stay(shield):
    crowd = random_cases(num_agents=(2, 6), maps=10, density=0.2)
    actor = GreedyActor(shield=shield)
    for cases in (crowd, [case.at(case.goals) for case in crowd]):
        env = playing(actor, cases, task="lifelong")
        moves = actor.act(env)
        moves = moves if shield == "idle" else moves.argmax(-1)
        for case, own in zip(cases, moves, strict=True):
            for here, goal, move in zip(
                *(oracles.cells(case.starts), oracles.cells(case.goals), own[: case.num_agents].tolist()), strict=True
            ):
                steps = oracles.distances(case.grid, goal)
                assert steps[oracles.moved(here, move)] == max(steps[here] - 1, 0)


def test_under_pibt_a_greedy_robot_would_rather_stay_than_lose_ground():
    crowd = random_cases(num_agents=(3, 6), maps=10, density=0.2)
    actor = GreedyActor(shield="pibt")
    scores = actor.act(playing(actor, crowd))
    for case, own in zip(crowd, scores, strict=True):
        for i, (here, goal) in enumerate(zip(oracles.cells(case.starts), oracles.cells(case.goals), strict=True)):
            steps = oracles.distances(case.grid, goal)
            nearer = [a for a in range(4) if steps.get(oracles.moved(here, a), np.inf) < steps[here]]
            first = set(np.argsort(-own[i])[: len(nearer)].tolist())
            assert first == set(nearer)
            assert np.argsort(-own[i])[len(nearer)] == oracles.IDLE


def test_a_random_robot_takes_all_moves_equally_often():
    env = playing(RandomActor(), [random_cases()[0]] * 2000)
    moves = RandomActor().act(env)
    counts = np.stack([(moves == action).mean(axis=0) for action in range(5)])
    np.testing.assert_allclose(counts, 0.2, atol=0.04)
    again = RandomActor().act(env)
    assert np.array_equal(moves, again), "draws depend on the seed and the time alone"
    env.step(np.full((2000, 4), oracles.IDLE), observe=False)
    running = env.running
    assert (RandomActor().act(env)[running] != moves[running]).any()


def test_a_greedy_robot_moves_at_random_where_it_was_before_and_off_its_goal_and_only_there():
    """All robots stay for a step, so those off their goals are stuck; then they go to and fro."""
    case = random_cases(num_agents=(4, 4))[1]
    half_home = case.at(np.concatenate([case.goals[:2], case.starts[2:]]))
    assert len(set(oracles.cells(half_home.starts))) == 4
    plain, restless = GreedyActor(), GreedyActor(random_when_stuck=True)
    env = playing(plain, [half_home] * 300)
    assert np.array_equal(plain.act(env), restless.act(env)), "nobody is stuck at the start"
    env.step(np.full((300, 4), oracles.IDLE), observe=False)
    greedy, drawn = plain.act(env), restless.act(env)
    off_goal = (half_home.starts != half_home.goals).any(axis=1)
    assert 0 < off_goal.sum() < 4
    for robot in range(4):
        if off_goal[robot]:
            assert set(drawn[:, robot].tolist()) == set(range(5))
            assert len(set(greedy[:, robot].tolist())) < 5
        else:
            assert np.array_equal(greedy[:, robot], drawn[:, robot])


def test_a_greedy_team_arrives_more_often_under_the_pibt_shield_or_with_random_moves_when_stuck():
    many = random_cases(seed=1, maps=20, num_agents=(8, 8))
    idle, pibt, restless, lost = (
        rollout(actor, many, max_steps=60)
        for actor in (GreedyActor(), GreedyActor(shield="pibt"), GreedyActor(random_when_stuck=True), RandomActor())
    )
    assert min(pibt.success.mean(), restless.success.mean()) > idle.success.mean() > lost.success.mean()


@pytest.mark.parametrize(
    "actor", [RandomActor("pibt"), GreedyActor(shield="pibt_swap"), GreedyActor(random_when_stuck=True)]
)
def test_baselines_play_lifelong_tasks_and_teams_of_any_sizes(actor):
    mixed = [*random_cases(num_agents=(2, 8), maps=3), *random_cases(seed=2, num_agents=(1, 3), size=(4, 9), maps=3)]
    together = rollout(actor, mixed, task="lifelong", max_steps=80)
    assert together.throughput.sum() > 0
    for i, case in enumerate(mixed):
        alone = rollout(actor, [case], task="lifelong", max_steps=80)
        assert np.array_equal(together.solutions[i].paths, alone.solutions[0].paths)
        assert together.throughput[i] == alone.throughput[0]
