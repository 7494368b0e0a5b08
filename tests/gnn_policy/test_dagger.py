"""Aggregation: states of the mixture, labels of the expert alone."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import bags
import experts
from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig
from gnn_policy.cases import Family, make_cases
from gnn_policy.config import TrainConfig
from gnn_policy.dagger import Demonstrator, Mixture
from gnn_policy.demonstrations import BatchMaker
from gnn_policy.labelling import Labeller
from gnn_policy.team_env import ACTION, CASE, POSITIONS, TeamEnv
from mapf_env import Action, Bag, Instance

STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]
CONFIG = TrainConfig(
    policy=PolicyConfig(encoder="lean", features=8, fov_radius=2, comm_radius=3.0),
    num_agents=4,
    rollout_teams=5,
    rollout_length=24,
    dagger_every=1,
    seed=3,
)
FAMILIES = {
    "alike": [Family(num_agents=(4, 4), height=(7, 7), width=(6, 6), density=(0.15, 0.15))],
    "mixed": [
        Family(num_agents=(2, 6), height=(5, 8), width=(5, 8)),
        Family(style="maze", num_agents=(1, 3), height=(7, 9), width=(7, 9)),
    ],
}


@pytest.fixture(scope="module")
def cases():
    return make_cases("train", seed=0, maps=6, cases_per_map=2, families=FAMILIES["alike"])


@pytest.fixture(scope="module")
def mixed():
    return make_cases("train", seed=0, maps=6, cases_per_map=2, families=FAMILIES["mixed"])


@pytest.fixture(scope="module")
def both_tasks():
    families = [replace(*FAMILIES["alike"], share=2.0), replace(*FAMILIES["alike"], task="lifelong", share=1.0)]
    return make_cases("train", seed=0, maps=6, cases_per_map=2, families=families)


@pytest.fixture
def policy(cases):
    torch.manual_seed(0)
    policy = DecentralizedPolicy(CONFIG.policy)
    bags.spread_preferences(policy, cases.instances)
    return policy


@pytest.fixture
def idle_policy(policy):
    """A policy whose robots always stay."""
    with torch.no_grad():
        policy.head.weight.zero_()
        policy.head.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 0.0, 9.0]))
    return policy


def labeller_for(cases, **settings):
    return Labeller(cases.grids, **{"w": 1.05, "node_limit": 2000, "threads": 1, **settings})


def demonstrating(config, policy, cases):
    labeller = labeller_for(cases, solver=config.expert, robot_order=config.robot_order)
    return Demonstrator(config, policy, labeller, cases)


def collected(config, policy, cases, number, steps):
    demonstrator = demonstrating(config, policy, cases)
    try:
        return demonstrator.collect(number, steps)
    finally:
        demonstrator.close()


def of_team(array, states, t):
    return array[states.offsets[t] : states.offsets[t + 1]]


def after(positions, moves):
    return positions + np.array(STEPS)[moves]


def visits(demonstrations, cases):
    """The case of each state, where its robots stand, and the moves that it is labelled with."""
    numbers = {
        (int(number), case.goals.tobytes()): i
        for i, (number, case) in enumerate(zip(cases.map_of, cases.instances, strict=True))
    }
    assert len(numbers) == len(cases), "the goals do not tell the cases of a map apart"
    states, found = demonstrations.states, []
    for t in range(len(states)):
        own = slice(states.offsets[t], states.offsets[t + 1])
        goals = states.goals[own].astype(np.int32)
        case = numbers[int(states.maps[t]), goals.tobytes()]
        found.append((case, states.positions[own].astype(np.int32), demonstrations.actions[own]))
    return found


def assert_labels_are_the_experts(cases, found, **limits):
    for case, positions, moves in found:
        result = experts.solve(cases.instances[case].at(positions), **limits)
        assert result.solution
        paths = result.solution.paths
        expected = paths[1] if len(paths) > 1 else paths[0]
        assert np.array_equal(after(positions, moves), expected)


@pytest.mark.parametrize("kind", FAMILIES)
def test_round_zero_is_the_expert_itself(kind, cases, mixed, policy):
    """Visited states are closed under the expert's moves, except where a team was cut off, and lead to the goals."""
    played = {"alike": cases, "mixed": mixed}[kind]
    demonstrations, unsolved = collected(CONFIG, policy, played, 0, 5 * 24 * 3)
    assert unsolved == 0
    found = visits(demonstrations, played)
    assert_labels_are_the_experts(played, found, w=CONFIG.w, node_limit=CONFIG.expert_nodes)
    known = {(case, positions.tobytes()) for case, positions, _ in found}
    assert len(known) < len(found) == 5 * 24 * 3
    assert {case for case, *_ in found} == set(range(len(played)))
    for case in range(len(played)):
        assert (case, played.instances[case].starts.tobytes()) in known
    ended = cut_off = 0
    for case, positions, moves in found:
        goals = played.instances[case].goals
        assert not (positions == goals).all()
        following = after(positions, moves).astype(np.int32)
        for i in range(len(moves)):
            for j in range(i):
                assert (following[i] != following[j]).any()
                assert (following[i] != positions[j]).any() or (following[j] != positions[i]).any()
        ended += (following == goals).all()
        cut_off += (case, following.tobytes()) not in known and not (following == goals).all()
    assert ended > 0
    assert cut_off <= 5 * 3, "more teams broke off than the ends of three batches explain"


@pytest.mark.parametrize("kind", FAMILIES)
@pytest.mark.parametrize("shield", ["idle", "pibt", "pibt_swap"])
def test_every_team_reaches_its_goals_under_the_expert(kind, cases, mixed, policy, shield):
    played = {"alike": cases, "mixed": mixed}[kind]
    config = replace(CONFIG, execution=Execution(shield=shield))
    mixture = Mixture(policy, labeller_for(played), config, played)
    settings = config.rollout_execution.env_settings(config.policy)
    env = TeamEnv(len(played), played.instances, observation="state", max_cycles=60, dtype="uint8", **settings)
    state, reached = env.reset(seed=0), set()
    for _ in range(60):
        both, state = env.step_and_maybe_reset(mixture(state))
        done = both["next", "terminated"].squeeze(-1)
        reached |= set(both[CASE][done].tolist())
        assert not both["next", "truncated"].any()
    assert reached == set(range(len(played)))


@pytest.mark.parametrize("kind", FAMILIES)
def test_later_rounds_follow_the_policy_and_label_with_the_expert(kind, cases, mixed, policy):
    played = {"alike": cases, "mixed": mixed}[kind]
    demonstrations, unsolved = collected(CONFIG, policy, played, 1, 1)
    assert unsolved == 0
    found = visits(demonstrations, played)
    assert_labels_are_the_experts(played, found, w=CONFIG.w, node_limit=CONFIG.expert_nodes)
    expert_only = visits(collected(CONFIG, policy, played, 0, 1)[0], played)
    of_expert = {(case, positions.tobytes()) for case, positions, _ in expert_only}
    assert {(case, positions.tobytes()) for case, positions, _ in found} - of_expert


def test_collection_plays_the_weights_of_the_moment(cases, policy):
    """The collector must not keep a copy of the policy that training goes on to change."""
    demonstrator = demonstrating(CONFIG, policy, cases)
    before, _ = demonstrator.collect(1, 1)
    again, _ = demonstrator.collect(1, 1)
    assert np.array_equal(before.states.positions, again.states.positions)
    with torch.no_grad():
        policy.head.weight.zero_()
        policy.head.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 0.0, 9.0]))
    idle, _ = demonstrator.collect(1, 1)
    demonstrator.close()
    for case, positions, _ in visits(idle, cases):
        assert np.array_equal(positions, cases.instances[case].starts)
    assert len(idle) == len(before), "a state where a team stays counts once for each step"


def assert_equal(one, other):
    for name in ("maps", "positions", "goals", "moves", "times", "seeds"):
        assert np.array_equal(getattr(one.states, name), getattr(other.states, name)), name
    assert np.array_equal(one.actions, other.actions)


@pytest.mark.parametrize("actions", ["argmax", "sampled", "stuck"])
def test_a_round_depends_on_seed_number_and_weights_alone(cases, policy, actions):
    config = replace(CONFIG, rollout_actions=actions, beta_decay=0.6)
    demonstrator = demonstrating(config, policy, cases)
    rounds = {number: demonstrator.collect(number, 100)[0] for number in (0, 1, 2)}
    demonstrator.close()
    for number in (2, 1):
        torch.manual_seed(number)  # the global generator plays no part
        assert_equal(collected(config, policy, cases, number, 100)[0], rounds[number])
    assert not np.array_equal(rounds[1].states.goals[:200], rounds[2].states.goals[:200])
    other, _ = collected(replace(config, seed=4), policy, cases, 1, 100)
    assert not np.array_equal(other.states.goals[:200], rounds[1].states.goals[:200])


def test_the_collected_views_are_those_that_training_rebuilds(mixed):
    """The mixture perceives what `BatchMaker` makes of the recorded states, whatever the policy's senses are."""
    seen = []

    class Watching(DecentralizedPolicy):
        def forward(self, bag):
            seen.append(Bag(*(part.clone() for part in bag)))
            return super().forward(bag)

    perceived = replace(
        CONFIG.policy,
        extra_channels=("cost_to_go", "previous_positions"),
        robot_features=("last_moves", "steps_left"),
        edge_features=("relative_position", "priority"),
        comm_range="connected",
        comm_weights="distance",
    )
    config = replace(CONFIG, policy=perceived, rollout_teams=3, rollout_length=6)
    demonstrations, _ = collected(config, Watching(perceived), mixed, 1, 18)
    maker = BatchMaker(mixed.grids, perceived, augment=False)
    batch = maker.batch(demonstrations, np.arange(len(demonstrations)), np.random.default_rng(0))
    rebuilt = fingerprints(Bag(*(batch[name] for name in Bag._fields)))
    assert len(rebuilt) > 9
    assert rebuilt == set().union(*map(fingerprints, seen))


def fingerprints(bag):
    """All that each team perceives; the padding of a batch sees nothing, not even a goal."""
    parts = [part for part in bags.split(bag) if part.fov[:, 1].any()]
    return {b"".join(each.numpy().tobytes() for each in part) for part in parts}


def states_at_starts(cases, teams, **settings):
    env = TeamEnv(teams, cases.instances, observation="state", fov_radius=2, comm_radius=3.0, **settings)
    return env.reset(seed=0)


@pytest.mark.parametrize("beta", [0.0, 0.3, 1.0])
def test_a_team_follows_the_expert_with_probability_beta(cases, idle_policy, beta):
    mixture = Mixture(idle_policy.eval(), labeller_for(cases), CONFIG, cases)
    mixture.begin(beta, seed=0)
    state = states_at_starts(cases, 2000)
    moves = mixture(state)[ACTION].numpy()
    labels, solved = experts.relabel([cases.instances[i] for i in state[CASE].tolist()], state[POSITIONS].numpy())
    assert solved.all()
    moving = (labels != 4).any(axis=1)
    by_expert = (moves == labels).all(axis=1)
    assert ((moves == 4).all(axis=1) | by_expert).all(), "a team mixes the moves of both"
    assert by_expert[moving].mean() == pytest.approx(beta, abs=0.04)


def one_case(cases):
    return replace(cases, instances=cases.instances[:1], map_of=cases.map_of[:1], family_of=cases.family_of[:1])


def test_sampled_moves_follow_the_softmax(cases, policy):
    single, config = one_case(cases), replace(CONFIG, rollout_actions="sampled", precision="float32")
    mixture = Mixture(policy.eval(), labeller_for(cases), config, single)
    mixture.begin(beta=0.0, seed=0)
    moves = mixture(states_at_starts(single, 4000))[ACTION].numpy()
    with torch.no_grad():
        shares = torch.softmax(policy(bags.at_start(single.instances, policy.config)), -1).numpy()
    counted = np.stack([(moves == action).mean(axis=0) for action in range(5)], -1)
    np.testing.assert_allclose(counted, shares, atol=0.04)


@pytest.mark.parametrize("shield", ["pibt", "pibt_swap"])
@pytest.mark.parametrize("kind", FAMILIES)
def test_under_pibt_the_policys_scores_are_its_logits(kind, shield, cases, mixed, policy):
    played = {"alike": cases, "mixed": mixed}[kind]
    config = replace(CONFIG, execution=Execution(shield=shield), precision="float32")
    mixture = Mixture(policy.eval(), labeller_for(played), config, played)
    mixture.begin(beta=0.0, seed=0)
    state = states_at_starts(played, 8, shield=shield)
    scores = mixture(state)[ACTION]
    for team, case in enumerate(state[CASE].tolist()):
        with torch.no_grad():
            logits = policy(bags.at_start([played.instances[case]], policy.config))
        torch.testing.assert_close(scores[team, : len(logits)], logits, rtol=1e-4, atol=1e-4)


def test_hard_case_mining_labels_teams_that_did_not_arrive_first(cases, policy):
    config = replace(CONFIG, rollout_teams=8, rollout_length=12, beta_decay=0.6)
    everything, _ = collected(config, policy, cases, 1, 3 * 8 * 12)
    mined, _ = collected(replace(config, hard_case_mining=3), policy, cases, 1, 8 * 12)
    assert (len(everything), len(mined)) == (288, 96)
    number = np.array([case for case, *_ in visits(everything, cases)])
    arrived = (np.diff(number.reshape(24, 12), axis=1) != 0).any(axis=1)
    assert 0 < arrived.sum() <= 16
    paths, kept = everything.states.positions.reshape(24, 12, -1), mined.states.positions.reshape(8, 12, -1)
    chosen = [any(np.array_equal(path, other) for other in kept) for path in paths]
    assert sum(chosen) == 8
    assert not np.array(chosen)[arrived].any()
    demonstrated, _ = collected(replace(config, hard_case_mining=3), policy, cases, 0, 8 * 12)
    assert len(demonstrated) == 96


def plan_paths(case, **limits):
    solution = experts.solve(case, **limits).solution
    assert solution
    return solution.paths


def test_plans_from_where_teams_failed(cases, idle_policy):
    """Which teams those are is read from all states of the same rollouts: they never began another case."""
    teams, length, batches = CONFIG.rollout_teams, 10, 6
    config = replace(CONFIG, beta_decay=0.6, rollout_length=length, seed=3)
    steps = teams * length * batches
    visited = visits(collected(config, idle_policy, cases, 1, steps)[0], cases)
    demonstrations, unsolved = collected(replace(config, aggregation="failed"), idle_policy, cases, 1, steps)
    planned = visits(demonstrations, cases)
    assert unsolved == 0
    following, failed = 0, 0
    for team in range(teams * batches):
        own = visited[team * length : (team + 1) * length]
        case, last, _ = own[-1]
        if any(other != case for other, *_ in own):
            continue
        plan = plan_paths(cases.instances[case].at(last), w=config.w, node_limit=config.expert_nodes)
        block = planned[following : following + len(plan) - 1]
        if len(plan) == 2 and not (block and np.array_equal(block[0][1], plan[0])):
            continue  # it arrived with its last step
        assert {i for i, *_ in block} == {case}
        assert np.array_equal([positions for _, positions, _ in block], plan[:-1])
        assert np.array_equal([after(positions, moves) for _, positions, moves in block], plan[1:])
        following, failed = following + len(block), failed + 1
    assert following == len(planned)
    assert 3 < failed < teams * batches - 3, "too few teams failed, or too few did not"


@pytest.mark.parametrize("kind", FAMILIES)
def test_plans_that_are_aggregated_begin_in_states_that_are_visited(kind, cases, mixed, policy):
    """One plan for each six steps that are played, of which the first six steps are labelled."""
    played = {"alike": cases, "mixed": mixed}[kind]
    config, steps = replace(CONFIG, aggregation="plans", plan_steps=6, beta_decay=0.5), 5 * 24 * 2
    everything = visits(collected(replace(config, aggregation="visited"), policy, played, 1, steps)[0], played)
    visited = {(case, positions.tobytes()) for case, positions, _ in everything}
    demonstrations, unsolved = collected(config, policy, played, 1, steps)
    found, expected = visits(demonstrations, played), Counter()
    assert unsolved == 0
    for case, positions, _ in found[: steps // 6]:  # the states come time by time
        assert (case, positions.tobytes()) in visited
        labels = experts.label_plans(
            [played.instances[case].at(positions)], steps=6, w=config.w, node_limit=config.expert_nodes
        )
        for first, last in pairwise(labels.offsets):
            here = labels.positions[first:last].astype(np.int32)
            expected[case, here.tobytes(), labels.actions[first:last].tobytes()] += 1
    assert expected == Counter((case, here.tobytes(), moves.tobytes()) for case, here, moves in found)


@pytest.mark.parametrize("kind", FAMILIES)
def test_where_plans_are_aggregated_round_zero_has_the_first_steps_of_plans_from_starts(kind, cases, mixed, policy):
    played = {"alike": cases, "mixed": mixed}[kind]
    config, steps = replace(CONFIG, aggregation="plans", plan_steps=6), 5 * 24 * 2
    demonstrations, unsolved = collected(config, policy, played, 0, steps)
    assert unsolved == 0
    found, expected = visits(demonstrations, played), Counter()
    begun = [case for case, *_ in found[: steps // 6]]  # the states come time by time
    assert demonstrations.states.times.tolist() == sorted(demonstrations.states.times)
    assert (demonstrations.states.times == 0).sum() == steps // 6
    assert len(set(begun)) > len(played) / 2
    for case in begun:
        labels = experts.label_plans([played.instances[case]], steps=6, w=config.w, node_limit=config.expert_nodes)
        for first, last in pairwise(labels.offsets):
            here = labels.positions[first:last].astype(np.int32)
            expected[case, here.tobytes(), labels.actions[first:last].tobytes()] += 1
    assert expected == Counter((case, here.tobytes(), moves.tobytes()) for case, here, moves in found)
    again, _ = collected(config, policy, played, 0, steps)
    assert_equal(demonstrations, again)


def test_plans_begin_more_often_where_a_robot_is_stuck(cases, idle_policy):
    """In a team that never moves every robot is stuck from the second step on."""
    shares = {}
    for weight in (1e-9, 1.0, 1e9):
        config = replace(CONFIG, aggregation="plans", plan_steps=1, stuck_weight=weight)
        states = collected(replace(config, plan_steps=config.rollout_length), idle_policy, cases, 1, 240)[0].states
        begun = states.take(np.arange(240 // config.rollout_length))
        shares[weight] = np.logical_or.reduceat(begun.stuck(), begun.offsets[:-1]).mean()
    assert shares[1e-9] < shares[1.0] <= shares[1e9] == 1.0


def test_where_no_team_failed_nothing_is_demonstrated(policy):
    near = Instance(np.zeros((2, 3), bool), [[0, 0], [1, 0]], [[0, 1], [1, 0]])
    single = make_cases("train", seed=0, maps=1, cases_per_map=1, families=FAMILIES["alike"])
    single = replace(single, instances=[near], grids=[near.grid])
    config = replace(CONFIG, aggregation="failed", beta_decay=1.0, rollout_length=5)
    found, unsolved = collected(config, policy, single, 1, 1)
    assert (len(found), unsolved) == (0, 0)


def test_round_zero_imitates_whatever_is_aggregated_later(cases, policy):
    visited, failed = (
        collected(replace(CONFIG, aggregation=each), policy, cases, 0, 100)[0] for each in ("visited", "failed")
    )
    assert_equal(visited, failed)


def test_weights_seed_and_beta_of_a_round_reach_the_collectors_processes(cases, policy):
    settings = replace(CONFIG, rollout_teams=4, backend="process", rollout_actions="sampled")

    def biased(action):
        with torch.no_grad():
            policy.head.bias.copy_(torch.eye(5)[action] * 100)

    rounds = []
    for _ in range(2):
        demonstrator = demonstrating(settings, policy, cases)
        try:
            biased(Action.IDLE)
            by_expert = demonstrator.collect(0, 4 * 24)[0]
            waiting = demonstrator.collect(1, 4 * 24)[0]
            biased(Action.UP)
            rounds.append([by_expert, waiting, demonstrator.collect(2, 4 * 24)[0]])
        finally:
            demonstrator.close()
    by_expert, waiting, climbing = (visits(each, cases) for each in rounds[0])
    assert any((later[1] != now[1]).any() for now, later in pairwise(by_expert))
    for case, positions, _ in waiting:
        assert np.array_equal(positions, cases.instances[case].starts)
    heights = [(positions[:, 0].sum(), cases.instances[case].starts[:, 0].sum()) for case, positions, _ in climbing]
    assert any(now < then for now, then in heights)
    for once, again in zip(*rounds, strict=True):
        assert_equal(once, again)


def test_collectors_side_by_side_play_other_episodes(mixed, policy):
    settings = replace(CONFIG, rollout_teams=4, backend="process", collectors=2)
    demonstrator = demonstrating(settings, policy, mixed)
    try:
        demonstrations, _ = demonstrator.collect(1, 4 * 24)
    finally:
        demonstrator.close()
    found = visits(demonstrations, mixed)
    assert len(found) == 4 * 24
    one, other = ([(case, positions.tobytes()) for case, positions, _ in half] for half in (found[:48], found[48:]))
    assert one != other


def test_teams_are_shared_evenly_by_collectors(cases, policy):
    with pytest.raises(ValueError, match="multiple of its 2 collectors, got 5"):
        demonstrating(replace(CONFIG, backend="process", collectors=2), policy, cases)
    with pytest.raises(ValueError, match='backend "process"'):
        replace(CONFIG, collectors=2)


def test_the_mixture_reads_what_the_environment_writes(policy, cases):
    mixture = Mixture(policy, labeller_for(cases), CONFIG, cases)
    state = TeamEnv(2, cases.instances, observation="state").reset()
    assert isinstance(state, TensorDict)
    assert set(mixture.in_keys) <= set(state.keys(include_nested=True))


def test_teams_of_both_tasks_play_side_by_side(policy, both_tasks):
    """A team of a one-shot task keeps its goals; one of a lifelong task gets others."""
    config = replace(CONFIG, rollout_teams=6, rollout_length=40, expert="lacam")
    found = collected(config, policy, both_tasks, 0, 240)[0].states
    assert len(found) >= 240
    given = {
        (int(number), task): {case.goals.tobytes() for case in own.instances}
        for task, own in both_tasks.by_task().items()
        for number in own.map_of
    }
    assert {task for _, task in given} == {"one_shot", "lifelong"}
    kinds = Counter()
    for t in range(len(found)):
        goals = found.goals[found.offsets[t] : found.offsets[t + 1]].astype(np.int32).tobytes()
        task = next(task for number, task in given if number == found.maps[t])
        kinds[task, goals in given[int(found.maps[t]), task]] += 1
    assert kinds["one_shot", False] == 0
    assert kinds["lifelong", False] > 0
    played = {task: sum(count for (own, _), count in kinds.items() if own == task) for task in ("one_shot", "lifelong")}
    assert played["lifelong"] == 2 * 40, "two of six teams, as a third of the maps is theirs"
    assert played["one_shot"] > 0


@pytest.mark.parametrize("aggregation", ["visited", "plans"])
@pytest.mark.parametrize("number", [0, 1])
def test_every_visited_state_of_a_lifelong_task_has_a_rolling_horizon_label(number, aggregation, policy, both_tasks):
    config = replace(CONFIG, rollout_teams=6, rollout_length=20, plan_steps=4, aggregation=aggregation)
    demonstrations, unsolved = collected(config, policy, both_tasks, number, 120)
    found = demonstrations.states
    lifelong = {int(each) for each in both_tasks.map_of[both_tasks.lifelong]}
    labelled = 0
    for t, grid in enumerate(found.maps.tolist()):
        if grid in lifelong:
            here, goals, moves = (
                of_team(each, found, t) for each in (found.positions, found.goals, demonstrations.actions)
            )
            planner = experts.RollingHorizon(both_tasks.grids[grid])
            assert planner.act(here.astype(np.int32), goals.astype(np.int32)).tolist() == moves.tolist()
            labelled += 1
    assert labelled == 2 * 20, "two of six teams, as a third of the maps is theirs"
    assert len(found) > labelled
    assert unsolved == 0


def test_each_collector_has_a_team_for_each_task(policy, both_tasks):
    with pytest.raises(
        ValueError, match="rollout_teams must be at least 2 for each collector, one for each task, got 1"
    ):
        demonstrating(replace(CONFIG, rollout_teams=1), policy, both_tasks)
