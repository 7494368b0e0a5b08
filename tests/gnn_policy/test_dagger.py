"""Aggregation: states of the mixture, labels of the expert alone."""

import sys
from dataclasses import replace
from functools import partial
from itertools import permutations
from types import ModuleType

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import experts
from gnn_policy import DecentralizedPolicy, PolicyConfig
from gnn_policy.cases import make_cases
from gnn_policy.config import TrainConfig
from gnn_policy.dagger import Aggregator, Mixture, Teacher
from gnn_policy.demonstrations import BatchMaker
from gnn_policy.team_env import ACTION, CASE, FOV, GRAPH, POSITIONS, TeamEnv
from mapf_env import Action, Instance

STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]
CONFIG = TrainConfig(
    policy=PolicyConfig(encoder="lean", features=8, fov_radius=2, comm_radius=3.0),
    num_agents=4,
    rollout_teams=5,
    rollout_length=24,
    dagger_every=1,
    seed=3,
)


@pytest.fixture(scope="module")
def cases():
    return make_cases(
        "train", seed=0, maps=6, cases_per_map=2, num_agents=4, height=7, width=6, density=0.15, styles=["cells"]
    )


@pytest.fixture
def policy():
    torch.manual_seed(0)
    return DecentralizedPolicy(CONFIG.policy)


def taught_by(cases, **settings):
    return Teacher(cases, **{"w": 1.05, "node_limit": 2000, "threads": 1, **settings})


def aggregating(config, policy, cases):
    teacher = taught_by(cases, solver=config.teacher, robot_order=config.robot_order)
    return Aggregator(config, policy, teacher, cases)


def collected(config, policy, cases, number, steps):
    aggregator = aggregating(config, policy, cases)
    try:
        return aggregator.collect(number, steps)
    finally:
        aggregator.close()


def after(positions, moves):
    return positions + np.array(STEPS)[moves]


def assert_labels_are_the_experts(cases, states, **limits):
    for case, positions, moves in zip(states.cases, states.positions, states.actions, strict=True):
        result = experts.solve(cases[case].at(positions), **limits)
        assert result.solution
        paths = result.solution.paths
        expected = paths[1] if len(paths) > 1 else paths[0]
        assert np.array_equal(after(positions, moves), expected)


def test_round_zero_is_the_expert_itself(cases, policy):
    """Visited states are closed under the expert's moves, except where a team was cut off, and lead to the goals."""
    states, unsolved = collected(CONFIG, policy, cases, 0, 5 * 24 * 3)
    assert unsolved == 0
    assert_labels_are_the_experts(cases, states, w=CONFIG.w, node_limit=CONFIG.expert_nodes)
    known = {(int(c), p.tobytes()) for c, p in zip(states.cases, states.positions.astype(np.int32), strict=True)}
    assert len(known) < len(states) == 5 * 24 * 3
    assert set(states.cases.tolist()) == set(range(len(cases)))
    for case in set(states.cases.tolist()):
        assert (case, cases[case].starts.tobytes()) in known
    ended = cut_off = 0
    for case, positions, moves in zip(states.cases, states.positions.astype(np.int32), states.actions, strict=True):
        assert not (positions == cases[case].goals).all()
        following = after(positions, moves).astype(np.int32)
        for i in range(4):
            for j in range(i):
                assert (following[i] != following[j]).any()
                assert (following[i] != positions[j]).any() or (following[j] != positions[i]).any()
        ended += (following == cases[case].goals).all()
        cut_off += (int(case), following.tobytes()) not in known and not (following == cases[case].goals).all()
    assert ended > 0
    assert cut_off <= 5 * 3, "more teams broke off than the ends of three batches explain"


@pytest.mark.parametrize("shield", ["idle", "pibt"])
def test_every_team_reaches_its_goals_under_the_expert(cases, policy, shield):
    mixture = Mixture(policy, taught_by(cases), replace(CONFIG, shield=shield))
    env = TeamEnv(len(cases), cases, max_cycles=60, fov_radius=2, dtype="uint8", shield=shield)
    state, reached = env.reset(seed=0), set()
    for _ in range(60):
        both, state = env.step_and_maybe_reset(mixture(state))
        done = both["next", "terminated"].squeeze(-1)
        reached |= set(both[CASE][done].tolist())
        assert not both["next", "truncated"].any()
    assert reached == set(range(len(cases)))


def test_later_rounds_visit_what_the_policy_does_and_label_what_the_expert_would(cases, policy):
    states, unsolved = collected(CONFIG, policy, cases, 1, 1)
    assert unsolved == 0
    assert_labels_are_the_experts(cases, states, w=CONFIG.w, node_limit=CONFIG.expert_nodes)
    expert_only, _ = collected(CONFIG, policy, cases, 0, 1)
    expert_states = {(int(c), p.tobytes()) for c, p in zip(expert_only.cases, expert_only.positions, strict=True)}
    visited = {(int(c), p.tobytes()) for c, p in zip(states.cases, states.positions, strict=True)}
    assert visited - expert_states


def test_collection_plays_the_weights_of_the_moment(cases, policy):
    """The collector must not keep a copy of the policy that training goes on to change."""
    aggregator = aggregating(CONFIG, policy, cases)
    before, _ = aggregator.collect(1, 1)
    again, _ = aggregator.collect(1, 1)
    assert np.array_equal(before.positions, again.positions)
    with torch.no_grad():
        policy.head.weight.zero_()
        policy.head.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 0.0, 9.0]))
    idle, _ = aggregator.collect(1, 1)
    aggregator.close()
    assert {p.tobytes() for p in idle.positions} <= {each.starts.astype(np.int16).tobytes() for each in cases}
    assert len(idle) == len(before), "where a team is stuck counts once for each step"


@pytest.mark.parametrize("sample", [False, True])
def test_a_round_depends_on_seed_number_and_weights_alone(cases, policy, sample):
    config = replace(CONFIG, sample_rollouts=sample, beta_decay=0.6)
    aggregator = aggregating(config, policy, cases)
    rounds = {number: aggregator.collect(number, 100)[0] for number in (0, 1, 2)}
    aggregator.close()
    for number in (2, 1):
        torch.manual_seed(number)  # the global generator plays no part
        alone, _ = collected(config, policy, cases, number, 100)
        for name in ("cases", "positions", "actions"):
            assert np.array_equal(getattr(alone, name), getattr(rounds[number], name))
    assert not np.array_equal(rounds[1].cases[:50], rounds[2].cases[:50])
    other, _ = collected(replace(config, seed=4), policy, cases, 1, 100)
    assert not np.array_equal(other.cases[:50], rounds[1].cases[:50])


def test_the_collected_views_are_those_that_training_rebuilds(cases):
    """The environment shows the mixture what `BatchMaker` makes of positions, whatever the policy perceives."""
    seen = []

    class Watching(DecentralizedPolicy):
        def forward(self, fov, graph):
            seen.append((fov, graph))
            return super().forward(fov, graph)

    perceived = replace(CONFIG.policy, cost_to_go=True, comm_range="connected", comm_weights="distance")
    config = replace(CONFIG, policy=perceived, rollout_teams=3, rollout_length=4)
    states, _ = collected(config, Watching(perceived), cases, 1, 12)
    batch = BatchMaker(cases, perceived, augment=False).batch(states, np.arange(len(states)), np.random.default_rng(0))
    shown = {(fov[b].numpy().tobytes(), graph[b].numpy().tobytes()) for fov, graph in seen for b in range(3)}
    rebuilt = {
        (fov.numpy().tobytes(), graph.numpy().tobytes()) for fov, graph in zip(batch[FOV], batch[GRAPH], strict=True)
    }
    assert len(rebuilt) > 3
    assert rebuilt == shown


def states_at_starts(cases, teams):
    chosen = np.arange(teams) % len(cases)
    env = TeamEnv(teams, cases, fov_radius=2, comm_radius=3.0)
    state = env.reset(seed=0)
    state[CASE] = torch.from_numpy(chosen)
    state[POSITIONS] = torch.from_numpy(np.stack([cases[i].starts for i in chosen]))
    return state


@pytest.mark.parametrize("beta", [0.0, 0.3, 1.0])
def test_a_team_follows_the_expert_with_probability_beta(cases, policy, beta):
    with torch.no_grad():
        policy.head.weight.zero_()
        policy.head.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 0.0, 9.0]))  # this policy always stays
    mixture = Mixture(policy.eval(), taught_by(cases), CONFIG)
    mixture.begin(beta, seed=0)
    state = states_at_starts(cases, 2000)
    moves = mixture(state)[ACTION].numpy()
    labels, solved = experts.relabel([cases[i] for i in state[CASE].tolist()], state[POSITIONS].numpy())
    assert solved.all()
    moving = (labels != 4).any(axis=1)
    by_expert = (moves == labels).all(axis=1)
    assert ((moves == 4).all(axis=1) | by_expert).all(), "a team mixes the moves of both"
    assert by_expert[moving].mean() == pytest.approx(beta, abs=0.04)


def test_sampled_moves_follow_the_softmax(cases, policy):
    policy.eval()
    mixture = Mixture(policy, taught_by(cases), replace(CONFIG, sample_rollouts=True))
    mixture.begin(beta=0.0, seed=0)
    state = states_at_starts(cases, 1).expand(4000).contiguous()
    moves = mixture(state)[ACTION].numpy()
    with torch.no_grad():
        shares = torch.softmax(policy(state[FOV][:1], state[GRAPH][:1]), -1)[0].numpy()
    counted = np.stack([(moves == action).mean(axis=0) for action in range(5)], -1)
    np.testing.assert_allclose(counted, shares, atol=0.04)


def test_under_pibt_the_policys_values_are_its_logits(cases, policy):
    mixture = Mixture(policy.eval(), taught_by(cases), replace(CONFIG, shield="pibt", precision="float32"))
    mixture.begin(beta=0.0, seed=0)
    state = states_at_starts(cases, 8)
    values = mixture(state)[ACTION]
    with torch.no_grad():
        torch.testing.assert_close(values, policy(state[FOV], state[GRAPH]))


def test_states_that_the_expert_cannot_solve_are_counted_and_left_out():
    crowded = make_cases(
        "train", seed=1, maps=2, cases_per_map=4, num_agents=11, height=4, width=4, density=0.0, styles=["cells"]
    )
    teacher = Teacher(crowded, w=1.0, node_limit=3, threads=1)
    positions = np.stack([each.starts for each in crowded])
    solved = [experts.solve(each, w=1.0, node_limit=3).solved for each in crowded]
    assert not all(solved), "the cases are too easy for this test"
    states, unsolved = teacher.label(np.arange(8), positions)
    assert unsolved == solved.count(False)
    assert states.cases.tolist() == [i for i in range(8) if solved[i]]
    twice, counted = teacher.label(np.tile(np.arange(8), 2), np.tile(positions, (2, 1, 1)))
    assert (len(twice), counted) == (2 * len(states), 2 * unsolved)


def test_hard_case_mining_labels_teams_that_did_not_arrive_first(cases, policy):
    config = replace(CONFIG, rollout_teams=8, rollout_length=12, beta_decay=0.6)
    everything, _ = collected(config, policy, cases, 1, 3 * 8 * 12)
    mined, _ = collected(replace(config, hard_case_mining=3), policy, cases, 1, 8 * 12)
    assert (len(everything), len(mined)) == (288, 96)
    arrived = (np.diff(everything.cases.reshape(24, 12), axis=1) != 0).any(axis=1)
    assert 0 < arrived.sum() <= 16
    paths, kept = everything.positions.reshape(24, 12, -1), mined.positions.reshape(8, 12, -1)
    chosen = [any(np.array_equal(path, other) for other in kept) for path in paths]
    assert sum(chosen) == 8
    assert not np.array(chosen)[arrived].any()
    demonstrated, _ = collected(replace(config, hard_case_mining=3), policy, cases, 0, 8 * 12)
    assert len(demonstrated) == 96


def test_labels_keep_the_order_of_the_visits(cases):
    teacher = taught_by(cases)
    order = np.array([7, 2, 7, 9, 0, 2])
    states, _ = teacher.label(order, np.stack([cases[i].starts for i in order]))
    assert states.cases.tolist() == order.tolist()
    assert_labels_are_the_experts(cases, states, w=1.05, node_limit=2000)


def plan_paths(case, **limits):
    solution = experts.solve(case, **limits).solution
    assert solution
    return solution.paths


def first_moves(result, num_agents):
    assert result.solution
    steps = np.diff(result.solution.paths[:2], axis=0)
    return [STEPS.index(tuple(step)) for step in steps[0].tolist()] if len(steps) else [4] * num_agents


SOLVERS = {
    "lacam": partial(experts.lacam, node_limit=2000),
    "prioritised": experts.prioritised,
    "pibt": experts.pibt,
    "experts:lacam": experts.lacam,
}


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("threads", [1, 3])
def test_any_solver_can_teach_the_first_move_of_its_plan(cases, name, threads):
    teacher = taught_by(cases, solver=name, threads=threads)
    order = np.tile(np.arange(len(cases)), 2)
    halfway = [plan_paths(each) for each in cases]
    positions = np.stack(
        [each.starts for each in cases] + [paths[len(paths) // 2] for paths in halfway[:-1]] + [cases[-1].goals]
    )
    moves, solved = teacher.moves(order, positions)
    assert solved.all()
    for case, state, taught in zip(order, positions, moves, strict=True):
        assert taught.tolist() == first_moves(SOLVERS[name](cases[case].at(state)), 4)
    assert moves[-1].tolist() == [4] * 4
    by_ecbs, _ = taught_by(cases).moves(order, positions)
    assert (moves != by_ecbs).any(), "the cases do not tell this solver from ECBS"


def test_a_solver_that_finds_nothing_teaches_nothing():
    corridor = Instance(np.zeros((1, 4), bool), [(0, 0), (0, 3)], [(0, 3), (0, 0)])
    for name in ("pibt", "prioritised", "lacam"):
        teacher = taught_by([corridor], solver=name)
        states, unsolved = teacher.label(np.zeros(3, int), np.stack([corridor.starts, corridor.goals, corridor.starts]))
        assert (states.positions.tolist(), unsolved) == ([corridor.goals.tolist()], 2)
        states, unsolved = teacher.demonstrate(np.zeros(2, int), np.stack([corridor.starts] * 2))
        assert (len(states), states.positions.shape, states.actions.shape, unsolved) == (0, (0, 2, 2), (0, 2), 2)


def test_a_solver_that_answers_another_question_is_found_out(cases, monkeypatch):
    module = ModuleType("their_solvers")
    module.stubborn = lambda instance: experts.solve(cases[0])  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "their_solvers", module)
    teacher = taught_by(cases, solver="their_solvers:stubborn")
    assert teacher.moves(np.array([0]), cases[0].starts[None])[1].all()
    with pytest.raises(ValueError, match=r"do not solve the instance: agent \d starts at"):
        teacher.moves(np.array([0, 1]), np.stack([cases[0].starts, cases[1].starts]))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"solver": "cbs"}, "one of ecbs, lacam, prioritised, pibt, or one of your own as .*; got 'cbs'"),
        ({"solver": "no.such.module:solve"}, "'no.such.module:solve' cannot be found: No module"),
        ({"solver": "experts:oracle"}, "'experts:oracle' cannot be found: .*oracle"),
        ({"solver": "experts:__all__"}, "'experts:__all__' is not a function or class but list"),
    ],
)
def test_a_teacher_that_cannot_teach_is_refused(cases, settings, message):
    with pytest.raises(ValueError, match=message):
        taught_by(cases, **settings)


def label_in_order(case, order, **limits):
    """The label that an expert gives who is told of the robots in this order."""
    result = experts.solve(Instance(case.grid, case.starts[order], case.goals[order]), **limits)
    moves = first_moves(result, len(order))
    return [moves[order.index(robot)] for robot in range(len(order))]


@pytest.fixture(scope="module")
def crowded():
    return make_cases(
        "train", seed=5, maps=4, cases_per_map=25, num_agents=4, height=4, width=4, density=0.1, styles=["cells"]
    )


@pytest.mark.parametrize(("robot_order", "sign"), [("index", 0), ("farthest", -1), ("nearest", 1)])
def test_the_expert_meets_the_robots_in_the_order_asked_for(crowded, robot_order, sign):
    which, positions = np.arange(len(crowded)), np.stack([each.starts for each in crowded])
    teacher = taught_by(crowded, robot_order=robot_order, node_limit=500)
    moves, solved = teacher.moves(which, positions)
    assert solved.all()
    orders = []
    for case, taught, plan in zip(crowded, moves, teacher.plans(which, positions), strict=True):
        ways = [abs(r - y) + abs(c - x) for (r, c), (y, x) in zip(case.starts, case.goals, strict=True)]
        orders.append(sorted(range(4), key=lambda robot: (sign * ways[robot], robot)))
        assert taught.tolist() == label_in_order(case, orders[-1], node_limit=500)
        assert plan
        assert not plan.violations(case)
        assert plan.actions[0].tolist() == taught.tolist()
    by_number, _ = taught_by(crowded, node_limit=500).moves(which, positions)
    assert (moves != by_number).any() == (robot_order != "index"), "the cases do not tell the orders apart"


def test_a_random_order_is_a_function_of_the_state(crowded):
    which, positions = np.arange(len(crowded)), np.stack([each.starts for each in crowded])
    moves, _ = taught_by(crowded, robot_order="random", node_limit=500).moves(which, positions)
    again, _ = taught_by(crowded, robot_order="random", node_limit=500, threads=2).moves(which[::-1], positions[::-1])
    assert np.array_equal(again[::-1], moves)
    orders = [list(each) for each in permutations(range(4))]
    told_apart = []
    for case, taught in zip(crowded[:30], moves, strict=False):
        labels = [label_in_order(case, order, node_limit=500) for order in orders]
        assert taught.tolist() in labels
        if labels[0] != labels[-1]:
            told_apart.append(taught.tolist() == labels[0])
    assert 0.1 < np.mean(told_apart) < 0.9


def test_the_teacher_says_how_long_it_took(cases):
    times = iter(range(0, 1000, 5))
    teacher = taught_by(cases, solver="pibt", clock=lambda: next(times))
    for asked in (1, 2, 3):
        teacher.moves(np.array([0]), cases[0].starts[None])
        assert teacher.seconds == 5 * asked


def test_plans_from_where_teams_are_stuck(cases, policy):
    """Which teams those are is read from all states of the same rollouts: they never began another case."""
    with torch.no_grad():
        policy.head.weight.zero_()
        policy.head.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 0.0, 9.0]))  # this policy always stays
    teams, length, batches = CONFIG.rollout_teams, 10, 6
    config = replace(CONFIG, beta_decay=0.6, rollout_length=length, seed=3)
    steps = teams * length * batches
    visited, _ = collected(config, policy, cases, 1, steps)
    stuck, unsolved = collected(replace(config, aggregation="stuck"), policy, cases, 1, steps)
    assert unsolved == 0
    following, failed = 0, 0
    for team in range(teams * batches):
        own = slice(team * length, (team + 1) * length)
        (case, *others), last = visited.cases[own], visited.positions[own][-1].astype(int)
        if any(other != case for other in others):
            continue
        plan = plan_paths(cases[case].at(last), w=config.w, node_limit=config.expert_nodes)
        block = slice(following, following + len(plan) - 1)
        if len(plan) == 2 and not np.array_equal(stuck.positions[block], plan[:1]):
            continue  # it arrived with its last step
        assert set(stuck.cases[block]) == {case}
        assert np.array_equal(stuck.positions[block], plan[:-1])
        assert np.array_equal(after(stuck.positions[block], stuck.actions[block]), plan[1:])
        following, failed = block.stop, failed + 1
    assert following == len(stuck)
    assert 3 < failed < teams * batches - 3, "too few teams are stuck, or too few are not"


def test_round_zero_imitates_whatever_is_aggregated_later(cases, policy):
    visited, stuck = (
        collected(replace(CONFIG, aggregation=each), policy, cases, 0, 100)[0] for each in ("visited", "stuck")
    )
    assert np.array_equal(visited.positions, stuck.positions)


def test_weights_seed_and_beta_of_a_round_reach_the_collectors_processes(cases, policy):
    settings = replace(CONFIG, rollout_teams=4, backend="process", sample_rollouts=True)

    def biased(action):
        with torch.no_grad():
            policy.head.bias.copy_(torch.eye(5)[action] * 100)

    rounds = []
    for _ in range(2):
        aggregator = aggregating(settings, policy, cases)
        try:
            biased(Action.IDLE)
            by_expert = aggregator.collect(0, 4 * 24)[0]
            waiting = aggregator.collect(1, 4 * 24)[0]
            biased(Action.UP)
            rounds.append([by_expert, waiting, aggregator.collect(2, 4 * 24)[0]])
        finally:
            aggregator.close()
    by_expert, waiting, climbing = rounds[0]
    assert (np.diff(by_expert.positions.astype(int), axis=0) != 0).any()
    starts = np.stack([case.starts for case in cases])
    assert np.array_equal(waiting.positions, starts[waiting.cases])
    rows = climbing.positions[..., 0].sum(axis=1)
    assert (rows < starts[climbing.cases, :, 0].sum(axis=1)).any()
    for once, again in zip(*rounds, strict=True):
        assert np.array_equal(once.positions, again.positions)


def test_collectors_side_by_side_play_other_episodes(cases, policy):
    settings = replace(CONFIG, rollout_teams=4, backend="process", collectors=2)
    aggregator = aggregating(settings, policy, cases)
    try:
        states, _ = aggregator.collect(1, 4 * 24)
    finally:
        aggregator.close()
    assert len(states) == 4 * 24
    one, other = states.positions.reshape(2, -1)
    assert not np.array_equal(one, other)


def test_teams_are_shared_evenly_by_collectors(cases, policy):
    with pytest.raises(ValueError, match="multiple of its 2 collectors, got 5"):
        aggregating(replace(CONFIG, backend="process", collectors=2), policy, cases)
    with pytest.raises(ValueError, match='backend "process"'):
        replace(CONFIG, collectors=2)


def test_the_mixture_reads_what_the_environment_writes(policy, cases):
    mixture = Mixture(policy, taught_by(cases), CONFIG)
    state = TeamEnv(2, cases).reset()
    assert isinstance(state, TensorDict)
    assert set(mixture.in_keys) <= set(state.keys(include_nested=True))
