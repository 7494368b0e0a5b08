"""The expert as training asks it: first moves and plans of any solver, for teams and maps of any sizes."""

import sys
from dataclasses import fields, replace
from functools import partial
from itertools import pairwise, permutations
from types import ModuleType

import numpy as np
import pytest

import experts
import oracles
from gnn_policy.cases import Cases, Family, make_cases
from gnn_policy.labelling import Labeller
from mapf_env import BatchedEnv, Instance, Senses, States

STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]


@pytest.fixture(scope="module")
def cases():
    """Teams and maps of several sizes."""
    families = [
        Family(num_agents=(4, 4), height=(7, 7), width=(6, 6), density=(0.15, 0.15)),
        Family(num_agents=(1, 6), height=(5, 8), width=(5, 8)),
        Family(style="maze", num_agents=(2, 3), height=(7, 9), width=(7, 9)),
    ]
    return make_cases("train", seed=0, maps=6, cases_per_map=2, families=families)


@pytest.fixture(scope="module")
def crowded():
    family = Family(num_agents=(4, 4), height=(4, 4), width=(4, 4))
    return make_cases("train", seed=5, maps=4, cases_per_map=25, families=[family])


def labeller_for(cases, **settings):
    return Labeller(cases.grids, **{"w": 1.05, "node_limit": 2000, "threads": 1, **settings})


def states_of(cases, chosen, positions=None):
    """States of the chosen cases, at their starts or at given positions."""
    chosen = np.asarray(chosen)
    instances = [cases.instances[i] for i in chosen]
    states = States.start_of(instances, Senses(comm_radius=3.0), cases.map_of[chosen], seeds=np.arange(len(chosen)))
    return states if positions is None else replace(states, positions=np.concatenate(positions))


def of_team(array, states, t):
    return array[states.offsets[t] : states.offsets[t + 1]]


def first_moves(result, num_agents):
    assert result.solution
    steps = np.diff(result.solution.paths[:2], axis=0)
    return [STEPS.index(tuple(step)) for step in steps[0].tolist()] if len(steps) else [4] * num_agents


def plan_paths(case, **limits):
    solution = experts.solve(case, **limits).solution
    assert solution
    return solution.paths


SOLVERS = {
    "ecbs": partial(experts.solve, w=1.05, node_limit=2000),
    "lacam": partial(experts.lacam, node_limit=2000),
    "prioritised": experts.prioritised,
    "pibt": experts.pibt,
    "experts:lacam": experts.lacam,
}


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("threads", [1, 3])
def test_any_solver_can_label_states_with_the_first_move_of_its_plan(cases, name, threads):
    """States of different sizes in one call, each with the answer that it gets alone."""
    labeller = labeller_for(cases, solver=name, threads=threads)
    order = np.tile(np.arange(len(cases)), 2)
    halfway = [plan_paths(each) for each in cases.instances]
    positions = [each.starts for each in cases.instances]
    positions += [*(paths[len(paths) // 2] for paths in halfway[:-1]), cases.instances[-1].goals]
    states = states_of(cases, order, positions)
    assert len(set(np.diff(states.offsets).tolist())) > 3
    moves, solved = labeller.moves(states)
    assert moves.shape == (states.num_robots,)
    expected = [SOLVERS[name](cases.instances[i].at(here)) for i, here in zip(order, positions, strict=True)]
    assert solved.tolist() == [result.solved for result in expected]
    assert solved.mean() > 0.8
    for t, result in enumerate(expected):
        count = len(positions[t])
        assert of_team(moves, states, t).tolist() == (first_moves(result, count) if result.solved else [4] * count)
    assert set(of_team(moves, states, len(order) - 1).tolist()) == {4}
    by_ecbs, _ = labeller_for(cases).moves(states)
    assert (moves != by_ecbs).any() == (name != "ecbs"), "the cases do not tell this solver from ECBS"


def test_goals_are_those_of_the_state(cases):
    """In a lifelong task robots have other goals than at the start."""
    states = states_of(cases, np.arange(len(cases)))
    swapped = replace(states, positions=states.goals.copy(), goals=states.positions.copy())
    moves, solved = labeller_for(cases).moves(swapped)
    assert solved.all()
    for t, case in enumerate(cases.instances):
        back = Instance(case.grid, case.goals, case.starts)
        assert of_team(moves, states, t).tolist() == first_moves(experts.solve(back, w=1.05), case.num_agents)


def test_states_that_a_solver_does_not_solve_are_left_out():
    corridor = Instance(np.zeros((1, 4), bool), [(0, 0), (0, 3)], [(0, 3), (0, 0)])
    cases = Cases([corridor], [corridor.grid], np.zeros(1, np.int32), np.zeros(1, np.int32), np.zeros(1, bool))
    positions = [corridor.starts, corridor.goals, corridor.starts]
    for name in ("pibt", "prioritised", "lacam", "ecbs"):
        labeller = labeller_for(cases, solver=name, node_limit=50)
        found, unsolved = labeller.label(states_of(cases, [0] * 3, positions))
        assert (found.states.positions.tolist(), unsolved) == (corridor.goals.tolist(), 2)
        assert found.actions.tolist() == [4, 4]
        found, unsolved = labeller.demonstrate(states_of(cases, [0] * 2))
        assert (len(found), found.states.num_robots, len(found.actions), unsolved) == (0, 0, 0, 2)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("robot_order", ["index", "random", "nearest"])
def test_no_states_have_no_labels(cases, name, robot_order):
    labeller = labeller_for(cases, solver=name, robot_order=robot_order)
    none = states_of(cases, [0, 1]).take(np.empty(0, np.intp))
    moves, solved = labeller.moves(none)
    assert (len(moves), len(solved), labeller.plans(none)) == (0, 0, [])
    for ask in (labeller.label, labeller.demonstrate):
        found, unsolved = ask(none)
        assert (len(found), len(found.actions), unsolved) == (0, 0, 0)


def test_a_solver_that_answers_another_question_is_found_out(cases, monkeypatch):
    module = ModuleType("their_solvers")
    module.stubborn = lambda instance: experts.solve(cases.instances[0])  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "their_solvers", module)
    labeller = labeller_for(cases, solver="their_solvers:stubborn")
    assert labeller.moves(states_of(cases, [0]))[1].all()
    with pytest.raises(ValueError, match=r"do not solve the instance: "):
        labeller.moves(states_of(cases, [0, 1]))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"solver": "cbs"}, "one of ecbs, lacam, prioritised, pibt, or one of your own as .*; got 'cbs'"),
        ({"solver": "no.such.module:solve"}, "'no.such.module:solve' cannot be found: No module"),
        ({"solver": "experts:oracle"}, "'experts:oracle' cannot be found: .*oracle"),
        ({"solver": "experts:__all__"}, "'experts:__all__' is not a function or class but list"),
    ],
)
def test_an_unknown_expert_is_refused(cases, settings, message):
    with pytest.raises(ValueError, match=message):
        labeller_for(cases, **settings)


def label_in_order(case, order, **limits):
    """The label of an expert that is given the robots in this order."""
    result = experts.solve(Instance(case.grid, case.starts[order], case.goals[order]), **limits)
    moves = first_moves(result, len(order))
    return [moves[order.index(robot)] for robot in range(len(order))]


@pytest.mark.parametrize(("robot_order", "sign"), [("index", 0), ("farthest", -1), ("nearest", 1)])
def test_the_expert_gets_the_robots_in_the_chosen_order(crowded, robot_order, sign):
    states = states_of(crowded, np.arange(len(crowded)))
    labeller = labeller_for(crowded, robot_order=robot_order, node_limit=500)
    moves, solved = labeller.moves(states)
    assert solved.all()
    plans = labeller.plans(states)
    for t, (case, plan) in enumerate(zip(crowded.instances, plans, strict=True)):
        ways = [abs(r - y) + abs(c - x) for (r, c), (y, x) in zip(case.starts, case.goals, strict=True)]
        order = sorted(range(4), key=lambda robot: (sign * ways[robot], robot))
        taught = of_team(moves, states, t).tolist()
        assert taught == label_in_order(case, order, node_limit=500, w=1.05)
        assert plan
        assert not plan.violations(case)
        assert plan.actions[0].tolist() == taught
    by_number, _ = labeller_for(crowded, node_limit=500).moves(states)
    assert (moves != by_number).any() == (robot_order != "index"), "the cases do not tell the orders apart"


def test_a_random_order_is_a_function_of_the_state(crowded):
    count = len(crowded)
    labeller = labeller_for(crowded, robot_order="random", node_limit=500)
    moves, _ = labeller.moves(states_of(crowded, np.arange(count)))
    threaded = labeller_for(crowded, robot_order="random", node_limit=500, threads=2)
    again, _ = threaded.moves(states_of(crowded, np.arange(count)[::-1]))
    assert np.array_equal(again.reshape(count, 4)[::-1], moves.reshape(count, 4))
    orders = [list(each) for each in permutations(range(4))]
    told_apart = []
    for case, taught in zip(crowded.instances[:30], moves.reshape(count, 4), strict=False):
        labels = [label_in_order(case, order, node_limit=500, w=1.05) for order in orders]
        assert taught.tolist() in labels
        if labels[0] != labels[-1]:
            told_apart.append(taught.tolist() == labels[0])
    assert 0.1 < np.mean(told_apart) < 0.9


def test_the_labeller_measures_its_time(cases):
    times = iter(range(0, 1000, 5))
    labeller = labeller_for(cases, solver="pibt", clock=lambda: next(times))
    for asked in (1, 2, 3):
        labeller.moves(states_of(cases, [0]))
        assert labeller.seconds == 5 * asked


def test_states_that_the_expert_cannot_solve_are_counted_and_left_out():
    family = Family(num_agents=(6, 6), height=(4, 4), width=(4, 4), density=(0.0, 0.0))
    crowd = make_cases("train", seed=1, maps=2, cases_per_map=4, families=[family])
    labeller = labeller_for(crowd, w=1.0, node_limit=3)
    solved = [experts.solve(each, w=1.0, node_limit=3).solved for each in crowd.instances]
    assert not all(solved), "the cases are too easy for this test"
    assert any(solved), "the cases are too hard for this test"
    found, unsolved = labeller.label(states_of(crowd, np.arange(8)))
    assert unsolved == solved.count(False)
    assert found.states.seeds.tolist() == [i for i in range(8) if solved[i]]
    twice, counted = labeller.label(states_of(crowd, np.tile(np.arange(8), 2)))
    assert (len(twice), counted) == (2 * len(found), 2 * unsolved)


def test_plans_without_a_proof_give_no_labels():
    crowd = make_cases("train", seed=1, maps=1, cases_per_map=2, families=[Family(num_agents=(40, 40))])
    results = [experts.solve(case, w=1.02, node_limit=10) for case in crowd.instances]
    assert any(result.solution is not None and not result.solved for result in results), "the cases do not test this"
    labeller = labeller_for(crowd, w=1.02, node_limit=10)
    states = states_of(crowd, np.arange(2))
    expected = [result.solved for result in results]
    assert [plan is not None for plan in labeller.plans(states)] == expected
    assert labeller.moves(states)[1].tolist() == expected


def test_labels_keep_the_order_of_the_visits_and_each_state_its_history(cases):
    order = [7, 2, 7, 9, 0, 2]
    states = states_of(cases, order)
    history = np.random.default_rng(0).integers(-1, 5, states.moves.shape).astype(np.int8)
    states = replace(states, moves=history, times=np.arange(6, dtype=np.int32))
    found, unsolved = labeller_for(cases).label(states)
    assert unsolved == 0
    for each in fields(States):
        assert np.array_equal(getattr(found.states, each.name), getattr(states, each.name)), each.name
    for t, i in enumerate(order):
        case = cases.instances[i]
        expected = first_moves(experts.solve(case, w=1.05, node_limit=2000), case.num_agents)
        assert of_team(found.actions, states, t).tolist() == expected


@pytest.mark.parametrize("steps", [None, 1, 4])
@pytest.mark.parametrize("name", ["ecbs", "lacam"])
def test_demonstrated_states_are_those_of_an_environment_that_follows_the_plans(cases, name, steps):
    """Positions, histories, times and counters, from the start of each case to the step before its end."""
    states = replace(states_of(cases, np.arange(len(cases))), limits=np.full(len(cases), 77, np.int32))
    found, unsolved = labeller_for(cases, solver=name).demonstrate(states, steps)
    assert unsolved == 0
    count = 0
    for t, case in enumerate(cases.instances):
        height, width = case.grid.shape
        env = BatchedEnv(1, num_agents=case.num_agents, height=height, width=width, density=0.0, comm_radius=3.0)
        env.reset(0, instances=[case], max_cycles=77, observe=False)
        plan = SOLVERS[name](case).solution
        assert plan
        taught = list(plan.actions[: plan.makespan])
        if steps is not None and name == "ecbs":
            labels = experts.label_plans([case], steps=steps, w=1.05, node_limit=2000)
            taught = [labels.actions[first:last] for first, last in pairwise(labels.offsets)]
        own = found.take(np.flatnonzero(found.states.seeds == states.seeds[t]))
        assert len(own) == len(taught[:steps])
        for time, actions in enumerate(taught[:steps]):
            shown, now = env.states(), own.take(np.array([time]))
            assert now.states.maps == states.maps[t]
            for each in ("positions", "goals", "moves", "under_way", "times", "limits", "comm_radius"):
                assert np.array_equal(getattr(now.states, each), getattr(shown, each)), each
            assert np.array_equal(now.actions, actions)
            env.step(actions[None], observe=False)
        assert env.running.any() == (len(taught) > len(own) or len(own) < plan.makespan)
        count += len(own)
    assert count == len(found)


@pytest.mark.parametrize("robot_order", ["random", "farthest"])
def test_first_steps_of_plans_are_labelled_robot_by_robot_in_any_order(crowded, robot_order):
    """Whatever the order in which the expert is given the robots, labels lead through collision-free states."""
    states = states_of(crowded, np.arange(40))
    found, unsolved = labeller_for(crowded, robot_order=robot_order, node_limit=500).demonstrate(states, 5)
    assert unsolved == 0
    for t in range(40):
        own = found.take(np.flatnonzero(found.states.seeds == states.seeds[t]))
        instance = crowded.instances[t]
        assert np.array_equal(own.states.positions[:4], instance.starts)
        team = oracles.cells(instance.starts)
        for time in range(len(own)):
            rows = slice(4 * time, 4 * time + 4)
            assert oracles.cells(own.states.positions[rows]) == team
            after = [oracles.moved(here, move) for here, move in zip(team, own.actions[rows].tolist(), strict=True)]
            assert oracles.faults(instance.grid, team, after) == []
            team = after
        left = sum(
            oracles.distances(instance.grid, goal)[here]
            for here, goal in zip(team, oracles.cells(instance.goals), strict=True)
        )
        assert left == 0 or len(own) == 5
