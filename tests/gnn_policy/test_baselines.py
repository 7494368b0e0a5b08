"""Teams that learn nothing: what their robots may do, by breadth-first search."""

import numpy as np

from gnn_policy import rollout
from gnn_policy.baselines import GreedyActor, RandomActor
from gnn_policy.cases import make_cases
from gnn_policy.rollout import Teams

STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]


def random_cases(seed=0, maps=6, num_agents=4, density=0.15):
    return make_cases(
        "test",
        seed=seed,
        maps=maps,
        cases_per_map=2,
        num_agents=num_agents,
        height=6,
        width=7,
        density=density,
        styles=["cells"],
    )


def bfs(grid, goal):
    distance, queue = {goal: 0}, [goal]
    for here in queue:
        for down, right in STEPS[:4]:
            there = here[0] + down, here[1] + right
            inside = 0 <= there[0] < grid.shape[0] and 0 <= there[1] < grid.shape[1]
            if inside and not grid[there] and there not in distance:
                distance[there] = distance[here] + 1
                queue.append(there)
    return distance


def test_a_greedy_robot_alone_follows_a_shortest_path():
    alone = random_cases(num_agents=1, maps=15, density=0.3)
    played = rollout(GreedyActor(alone), alone, max_steps=100)
    for i, case in enumerate(alone):
        shortest = bfs(case.grid, tuple(case.goals[0].tolist()))[tuple(case.starts[0].tolist())]
        assert played.success[i]
        assert played.flowtime[i] == played.makespan[i] == shortest
        assert played.replaced[i] == 0


def moment(case, positions, goals, past=(), seed=0):
    """One team as a baseline meets it."""
    before = np.array(past, np.int32).reshape(len(past), 1, *positions.shape)
    seeds = np.array([seed], np.uint64)
    return Teams(np.array([case]), seeds, np.empty(0), positions[None], goals[None], before, len(before))


def test_every_greedy_move_approaches_the_goal_and_robots_on_goals_stay():
    crowd = random_cases(num_agents=6, maps=10, density=0.2)
    actor = GreedyActor(crowd)
    for i, case in enumerate(crowd):
        for positions in (case.starts, case.goals):
            moves = actor.act(moment(i, positions, case.goals))[0]
            for robot, move in enumerate(moves):
                distance = bfs(case.grid, tuple(case.goals[robot].tolist()))
                here = tuple(positions[robot].tolist())
                there = here[0] + STEPS[move][0], here[1] + STEPS[move][1]
                assert distance[there] == max(distance[here] - 1, 0)


def test_a_random_robot_takes_every_move_alike():
    case = random_cases()[0]
    moves = [RandomActor().act(moment(0, case.starts, case.goals, seed=seed))[0] for seed in range(2000)]
    counts = np.stack([(np.array(moves) == action).mean(axis=0) for action in range(5)])
    np.testing.assert_allclose(counts, 0.2, atol=0.04)


def test_a_greedy_robot_moves_at_random_where_it_was_before_and_off_its_goal_and_only_there():
    case = random_cases(num_agents=4)[1]
    plain, restless = GreedyActor([case]), GreedyActor([case], random_when_stuck=True)
    elsewhere = case.starts[[1, 0, 3, 2]]
    here = np.array([case.starts[0], case.starts[1], case.goals[2], case.starts[3]])
    past = [elsewhere, np.array([case.starts[0], elsewhere[1], case.goals[2], elsewhere[3]]), elsewhere]
    moves = {actor: [] for actor in (plain, restless)}
    for seed in range(300):
        for actor, taken in moves.items():
            taken.append(actor.act(moment(0, here, case.goals, past, seed))[0])
    greedy, drawn = (np.array(taken) for taken in moves.values())
    assert np.array_equal(greedy[:, 1:], drawn[:, 1:])
    assert set(drawn[:, 0]) == set(range(5))
    assert len(set(greedy[:, 0])) < 5


def test_a_greedy_team_arrives_more_often_under_the_pibt_shield_or_with_random_moves_when_stuck():
    many = random_cases(seed=1, maps=20, num_agents=8)
    idle, pibt = (rollout(GreedyActor(many), many, shield=shield, max_steps=60) for shield in ("idle", "pibt"))
    restless = rollout(GreedyActor(many, random_when_stuck=True), many, max_steps=60)
    lost = rollout(RandomActor(), many, max_steps=60)
    assert min(pibt.success.mean(), restless.success.mean()) > idle.success.mean() > lost.success.mean()
