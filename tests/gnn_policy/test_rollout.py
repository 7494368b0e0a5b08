"""Rollouts: executed paths never collide, and their metrics equal those of a slow reader of the paths."""

import sys
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import bags
import experts
import oracles
from gnn_policy import DecentralizedPolicy, PolicyConfig, rollout
from gnn_policy.baselines import GreedyActor, RandomActor
from gnn_policy.cases import Family, make_cases
from gnn_policy.execution import Actions, Execution
from gnn_policy.rollout import PolicyActor
from mapf_env import BatchedEnv, Instance, random_instance

few = settings(max_examples=25)

STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]
CONFIG = PolicyConfig(encoder="lean", features=8, fov_radius=2, comm_radius=3.0)
RICH = replace(
    CONFIG,
    graph_layer="attention",
    extra_channels=("cost_to_go", "previous_positions"),
    robot_features=("last_moves", "steps_left", "greedy_moves"),
    edge_features=("relative_position", "goal_direction"),
)
CHOICES: list[Actions] = ["argmax", "sampled", "stuck"]


def random_cases(seed=0, maps=6, num_agents=4, height=6, width=7, density=0.15, cases_per_map=2):
    family = Family(
        height=(height, height), width=(width, width), density=(density, density), num_agents=(num_agents, num_agents)
    )
    return make_cases("test", seed=seed, maps=maps, cases_per_map=cases_per_map, families=[family]).instances


def seeded_policy(config=CONFIG, execution=Execution()):
    torch.manual_seed(0)
    policy = DecentralizedPolicy(config, execution)
    bags.spread_preferences(policy, random_cases())
    return policy


@pytest.fixture(scope="module")
def cases():
    return random_cases()


@pytest.fixture(scope="module")
def mixed():
    """Teams and maps of many sizes, in no order."""
    sizes = [(4, 6, 7), (9, 5, 4), (1, 3, 3), (6, 12, 3), (2, 7, 7), (12, 8, 8), (3, 4, 9), (5, 3, 12)]
    return [
        random_instance(num_agents=agents, height=height, width=width, density=0.1, seed=seed)
        for seed, (agents, height, width) in enumerate(sizes)
    ]


@pytest.fixture(scope="module")
def policy():
    return seeded_policy()


class Blind:
    """An actor whose robots perceive nothing that costs time."""

    def env_settings(self):
        return {"fov_radius": 1, "comm_radius": 0.0}


class ErraticActor(Blind):
    """Moves at random, crowding included."""

    def __init__(self, seed):
        self.generator = np.random.default_rng(seed)

    def act(self, env):
        return self.generator.integers(5, size=(env.num_envs, env.num_agents))


def cases_of(env):
    """Return a key of each case of an environment: size and goals, which do not change."""
    sizes, goals = env.team_sizes, env.goals
    return [goals[b, : sizes[b]].astype(np.int32).tobytes() for b in range(env.num_envs)]


class ScriptedActor(Blind):
    """Follows given paths, then stays."""

    def __init__(self, instances, paths):
        self.paths = {each.goals.tobytes(): path for each, path in zip(instances, paths, strict=True)}
        assert len(self.paths) == len(paths)

    def act(self, env):
        moves = np.full((env.num_envs, env.num_agents), 4)
        for team, case in enumerate(cases_of(env)):
            path, time = self.paths[case], int(env.times[team])
            here = env.positions[team, : path.shape[1]]
            assert np.array_equal(here, path[min(time, len(path) - 1)]), "the team has left its path"
            if time + 1 < len(path):
                for robot, (before, after) in enumerate(zip(path[time], path[time + 1], strict=True)):
                    moves[team, robot] = STEPS.index(tuple((after - before).tolist()))
        return moves


def assert_legal(instance, paths):
    """No robot jumps, leaves the map, meets an obstacle, another robot or exchanges cells with one."""
    assert np.array_equal(paths[0], instance.starts)
    rows = [oracles.cells(row) for row in paths]
    for before, after in zip([rows[0], *rows], rows, strict=False):
        assert oracles.faults(instance.grid, before, after) == []


def slowly_measured(instance, paths, limit):
    """Success, flowtime, makespan, share on goals and latched success, by walking along each path."""
    goals = [tuple(cell) for cell in instance.goals.tolist()]
    times, touched, at_home = [], [], 0
    for robot, goal in enumerate(goals):
        track = [tuple(cell) for cell in paths[:, robot].tolist()]
        touched.append(goal in track)
        at_home += track[-1] == goal
        times.append(oracles.arrival(track) if track[-1] == goal else limit)
    return at_home == len(goals), sum(times), max(times), at_home / len(goals), all(touched)


def assert_metrics_are_right(played, limits):
    for i, instance in enumerate(played.instances):
        paths = played.solutions[i].paths
        assert_legal(instance, paths)
        success, flowtime, makespan, share, latched = slowly_measured(instance, paths, limits[i])
        assert played.success[i] == success
        assert played.flowtime[i] == flowtime
        assert played.makespan[i] == makespan
        assert played.on_goal[i] == pytest.approx(share)
        assert played.latched[i] == latched
        assert np.array_equal(played.goals[i], instance.goals[None])
        joint_arrivals = [t for t, here in enumerate(paths) if np.array_equal(here, instance.goals)]
        assert len(paths) - 1 == (joint_arrivals[0] if joint_arrivals else limits[i])
        assert joint_arrivals[:-1] == []
        on_goal = (paths == instance.goals).all(-1)
        arrivals = (on_goal[1:] & ~on_goal[:-1]).sum()
        assert played.throughput[i] == pytest.approx(arrivals / max(len(paths) - 1, 1))


@few
@given(seed=st.integers(0, 2**32 - 1), num_agents=st.integers(1, 9))
def test_nothing_executed_collides_and_the_metrics_are_right(seed, num_agents):
    crowd = random_cases(seed, maps=3, num_agents=num_agents, height=3, width=4, density=0.1)
    limits = np.random.default_rng(seed).integers(1, 60, len(crowd))
    played = rollout(ErraticActor(seed), crowd, seed=seed, max_steps=limits)
    assert played.instances == crowd
    assert_metrics_are_right(played, limits)


class Plain(torch.nn.Module):
    """A network from elsewhere, here one that does what the package's does."""

    def __init__(self, policy):
        super().__init__()
        self.policy, self.config = policy, policy.config

    def forward(self, bag):
        return self.policy(bag)


@pytest.mark.parametrize(
    "execution", [Execution(), Execution(actions="stuck"), Execution(shield="pibt", comm_range="connected")]
)
def test_a_network_of_your_own_is_executed_like_a_policy(mixed, policy, execution):
    network = Plain(policy).train()
    played = rollout(network, mixed, execution=execution, max_steps=20)
    expected = rollout(policy, mixed, execution=execution, max_steps=20)
    assert all(same(played, expected, i, i) for i in range(len(mixed)))
    assert network.training
    if execution == Execution():
        plain = rollout(network, mixed, max_steps=20)
        assert all(same(played, plain, i, i) for i in range(len(mixed)))


def test_only_networks_and_actors_are_played(cases):
    with pytest.raises(TypeError, match=r"Linear does not say .*: give it a `config`, .*PolicyConfig"):
        rollout(torch.nn.Linear(3, 5), cases)
    with pytest.raises(TypeError, match=r"plays a network or an actor, got str: an actor has `env_settings` and `act`"):
        rollout("n12", cases)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="ErraticActor is an actor and brings its own settings"):
        rollout(ErraticActor(0), cases, execution=Execution())


@pytest.mark.parametrize(
    "own", [Execution(actions="stuck"), Execution(shield="pibt", actions="sampled"), Execution(comm_range="connected")]
)
def test_a_policy_has_its_own_execution_by_default(cases, own):
    policy = seeded_policy(execution=own)
    by_itself, told = (rollout(policy, cases, max_steps=25, **more) for more in ({}, {"execution": own}))
    plain = rollout(policy, cases, max_steps=25, execution=Execution())
    of_another = rollout(seeded_policy(), cases, max_steps=25)
    assert all(same(by_itself, told, i, i) for i in range(len(cases)))
    assert all(same(plain, of_another, i, i) for i in range(len(cases)))
    assert not all(same(by_itself, plain, i, i) for i in range(len(cases)))


@pytest.mark.parametrize("actions", CHOICES)
def test_the_policy_is_measured_like_any_actor(cases, policy, actions):
    played = rollout(policy, cases, execution=Execution(actions=actions), max_steps=30, seed=2)
    assert_metrics_are_right(played, [30] * len(cases))
    assert 0 < played.replaced.mean() < 1


def same(one, two, i, j):
    arrays = ("success", "flowtime", "makespan", "on_goal", "latched", "replaced", "throughput")
    return (
        np.array_equal(one.solutions[i].paths, two.solutions[j].paths)
        and np.array_equal(one.goals[i], two.goals[j])
        and all(getattr(one, name)[i] == getattr(two, name)[j] for name in arrays)
    )


WAYS = [
    ("one_shot", Execution(), 0.0),
    ("one_shot", Execution(actions="stuck", shield="pibt", comm_range="connected"), 0.3),
    ("lifelong", Execution(actions="sampled", comm_weights="distance"), 0.5),
    ("lifelong", Execution(shield="pibt"), 0.0),
    ("one_shot", Execution(shield="pibt_swap"), 0.0),
    ("lifelong", Execution(actions="stuck", shield="pibt_swap"), 0.2),
]


@pytest.mark.parametrize("config", [CONFIG, RICH], ids=["paper", "rich"])
@pytest.mark.parametrize(("task", "execution", "loss"), WAYS)
def test_teams_and_maps_of_any_sizes_play_together_as_each_alone(mixed, config, task, execution, loss):
    policy = seeded_policy(config)
    settings = {"task": task, "execution": execution, "message_loss": loss, "seed": 5}
    limits = [12, 5, 30, 20, 25, 18, 9, 30]
    together = rollout(policy, mixed, max_steps=limits, **settings)
    assert together.instances == mixed
    for size in (1, 3):
        other = rollout(policy, mixed, max_steps=limits, batch_size=size, **settings)
        assert all(same(together, other, i, i) for i in range(len(mixed)))
    for i, instance in enumerate(mixed):
        assert same(together, rollout(policy, [instance], max_steps=limits[i], **settings), i, 0)
        assert together.solutions[i].paths.shape[1:] == instance.starts.shape
        assert_legal(instance, together.solutions[i].paths)
    if task == "one_shot":
        assert_metrics_are_right(together, limits)


@pytest.mark.parametrize("actions", CHOICES)
def test_the_size_of_batches_does_not_matter(cases, policy, actions):
    played = [
        rollout(policy, cases, execution=Execution(actions=actions), max_steps=25, batch_size=size)
        for size in (1, 3, 5, 256)
    ]
    for other in played[1:]:
        assert all(same(played[0], other, i, i) for i in range(len(cases)))


def test_neither_does_the_memory_that_teams_may_take(mixed, policy, monkeypatch):
    expected = rollout(policy, mixed, max_steps=15)
    counts = []

    class Counting(RandomActor):
        def act(self, env):
            counts.append(env.num_envs)
            return super().act(env)

    for most, batches in ((1, 8), (1500, None), (2**28, 1)):
        monkeypatch.setattr(sys.modules["gnn_policy.rollout"], "_MOST_BYTES", most)
        played = rollout(policy, mixed, max_steps=15)
        assert all(same(expected, played, i, i) for i in range(len(mixed)))
        counts.clear()
        rollout(Counting(), mixed, max_steps=1)
        assert sum(counts) == 8
        assert len(counts) == batches or (batches is None and 1 < len(counts) < 8)


@few
@given(
    seed=st.integers(0, 2**64 - 1),
    order=st.permutations(range(12)),
    kept=st.integers(1, 12),
    actions=st.sampled_from(CHOICES),
    shield=st.sampled_from(["idle", "pibt", "pibt_swap"]),
    comm_range=st.sampled_from(["fixed", "connected"]),
)
def test_a_case_depends_neither_on_its_place_nor_on_the_others(
    cases, policy, seed, order, kept, actions, shield, comm_range
):
    settings = {"execution": Execution(actions=actions, shield=shield, comm_range=comm_range), "max_steps": 12}
    whole = rollout(policy, cases, seed=seed, **settings)
    chosen = order[:kept]
    part = rollout(policy, [cases[i] for i in chosen], seed=seed, batch_size=5, **settings)
    assert all(same(whole, part, i, place) for place, i in enumerate(chosen))


def test_equal_cases_end_equally_unless_their_seeds_differ(cases, policy):
    copies, settings = [cases[0]] * 6, {"execution": Execution(actions="sampled"), "max_steps": 25}
    equal = rollout(policy, copies, seed=3, **settings)
    assert all(same(equal, equal, 0, i) for i in range(6))
    seeds = [3, 4, 5, 3, 4, 5]
    own = rollout(policy, copies, seed=seeds, **settings)
    for i, seed in enumerate(seeds):
        assert same(own, rollout(policy, copies[:1], seed=seed, **settings), i, 0)
    assert len({own.solutions[i].paths.tobytes() for i in range(6)}) == 3


def test_draws_depend_on_goals_and_maps():
    """The noise of cases that differ in anything is independent."""
    grid = np.zeros((4, 4), bool)
    walled = grid.copy()
    walled[3, 3] = True
    alike = [
        Instance(grid, [[0, 0], [1, 1]], [[2, 2], [0, 1]]),
        Instance(grid, [[0, 0], [1, 1]], [[2, 1], [0, 1]]),
        Instance(grid, [[0, 0], [1, 2]], [[2, 2], [0, 1]]),
        Instance(walled, [[0, 0], [1, 1]], [[2, 2], [0, 1]]),
    ]
    seen = []

    class Listening(RandomActor):
        def act(self, env):
            seen.append(env.seeds)
            return super().act(env)

    rollout(Listening(), alike, max_steps=1)
    assert len(set(seen[0].tolist())) == 4


@pytest.mark.parametrize("training", [False, True])
def test_the_policy_is_left_in_the_mode_that_it_was_in(cases, policy, training):
    policy.train(training)
    try:
        played = rollout(policy, cases, max_steps=5)
        assert policy.training == training
        assert all(module.training == training for module in policy.modules())
        with pytest.raises(ValueError, match="max_steps"):
            rollout(policy, cases, max_steps=0)
        assert policy.training == training
    finally:
        policy.eval()
    assert all(same(played, rollout(policy, cases, max_steps=5), i, i) for i in range(len(cases)))


class CrowdingActor(Blind):
    """Random moves that depend on the case and the time alone, so that the shield has ties to break."""

    def act(self, env):
        moves = [
            np.random.default_rng([zlib.crc32(case), int(time)]).integers(5, size=env.num_agents)
            for case, time in zip(cases_of(env), env.times, strict=True)
        ]
        return np.stack(moves)


def test_neither_batches_nor_neighbours_that_end_early_change_how_ties_are_broken_or_when_time_is_up():
    crowd = random_cases(num_agents=9, maps=8, height=4, width=4, density=0.0)
    limits = np.arange(len(crowd)) % 5 + 8
    one = rollout(CrowdingActor(), crowd, max_steps=limits, seed=3)
    assert_metrics_are_right(one, limits)
    for size in (1, 5):
        other = rollout(CrowdingActor(), crowd, max_steps=limits, seed=3, batch_size=size)
        assert all(same(one, other, i, i) for i in range(len(crowd)))
    at_home = [case if i % 3 == 2 else case.at(case.goals) for i, case in enumerate(crowd)]
    some = rollout(CrowdingActor(), at_home, max_steps=limits, seed=3)
    assert all(same(one, some, i, i) for i in range(2, len(crowd), 3))


def test_equal_seeds_repeat_and_others_do_not(cases, policy):
    one, two, three = (
        rollout(policy, cases, execution=Execution(actions="sampled"), seed=seed, max_steps=25) for seed in (5, 5, 6)
    )
    assert all(same(one, two, i, i) for i in range(len(cases)))
    assert not all(same(one, three, i, i) for i in range(len(cases)))


def test_sampled_moves_follow_the_tempered_softmax_and_argmax_its_mode(cases, policy):
    case = cases[0]
    with torch.no_grad():
        logits = policy(bags.at_start([case], policy.config))
    env = BatchedEnv(3000, num_agents=4, height=6, width=7, **policy.env_settings())
    env.reset(0, instances=[case] * 3000, observe=False)
    for temperature in (0.3, 1.0, 4.0):
        moves = PolicyActor(policy, Execution(actions="sampled", temperature=temperature)).act(env)
        counted = np.stack([(moves == action).mean(axis=0) for action in range(5)], -1)
        np.testing.assert_allclose(counted, torch.softmax(logits / temperature, -1).numpy(), atol=0.04)
    moves = PolicyActor(policy, Execution()).act(env)
    assert (moves == logits.argmax(-1).numpy()).all()


@pytest.mark.parametrize("taps", [1, 3])
def test_sampling_when_stuck_differs_from_argmax_only_for_robots_that_know_of_a_stuck_one(cases, taps):
    policy = seeded_policy(replace(CONFIG, comm_radius=2.5, taps=taps))
    actors = {actions: PolicyActor(policy, Execution(actions=actions, shield="pibt")) for actions in CHOICES}
    env = BatchedEnv(len(cases), num_agents=4, height=6, width=7, **actors["stuck"].env_settings(), max_cycles=99)
    env.reset(1, instances=cases)
    generator, tracks = np.random.default_rng(0), [env.positions.tolist()]
    drew = stayed = told = 0
    for _ in range(12):
        scores = {actions: actor.act(env) for actions, actor in actors.items()}
        for b, case in enumerate(cases):
            here, before = tracks[-1][b], [track[b] for track in tracks[:-1]]
            stuck = [here[i] in [then[i] for then in before] and here[i] != case.goals[i].tolist() for i in range(4)]
            hears = oracles.communication_graph(here, 2.5)
            draws = [stuck[i] or (taps > 1 and any(stuck[j] for j in range(4) if hears[i, j])) for i in range(4)]
            for i, draw in enumerate(draws):
                assert np.array_equal(scores["stuck"][b, i], scores["sampled" if draw else "argmax"][b, i])
                assert not np.array_equal(scores["sampled"][b, i], scores["argmax"][b, i])
            drew, stayed = drew + sum(draws), stayed + draws.count(False)
            told += sum(draws) - sum(stuck)
        env.step(generator.integers(5, size=(len(cases), 4)), observe=False)
        if not env.running.all():
            break
        tracks.append(env.positions.tolist())
    assert drew > 10
    assert stayed > 10
    assert (told > 0) == (taps > 1)


def test_an_actor_meets_the_teams_where_they_are_and_knows_their_last_moves(mixed):
    class Remembering(RandomActor):
        def __init__(self):
            super().__init__()
            object.__setattr__(self, "seen", [])

        __slots__ = ("seen",)

        def act(self, env):
            self.seen.append((cases_of(env), env.running, env.times, env.positions, env.moves, env.present))
            return super().act(env)

    actor = Remembering()
    limits = np.arange(len(mixed)) + 2
    played = rollout(actor, mixed, max_steps=limits)
    paths = {each.goals.tobytes(): solution.paths for each, solution in zip(mixed, played.solutions, strict=True)}
    for time, (teams, running, times, positions, moves, present) in enumerate(actor.seen):
        for b, case in enumerate(teams):
            path = paths[case]
            assert present[b].sum() == path.shape[1]
            assert running[b] == (time < len(path) - 1)
            if not running[b]:
                continue
            assert times[b] == time
            assert np.array_equal(positions[b][present[b]], path[time])
            for back in range(min(time, 16)):
                differences = path[time - back] - path[time - back - 1]
                known = moves[b, present[b], back]
                assert [STEPS.index(tuple(each)) for each in differences.tolist()] == known.tolist()
            assert (moves[b, present[b], time:] == -1).all()


def test_every_plan_of_the_expert_replays_exactly(mixed):
    crowd = [*random_cases(num_agents=7, maps=20), *mixed]
    paths = [each.solution.paths for each in experts.solve_many(crowd, w=1.2) if each.solution]
    assert len(paths) == len(crowd)
    played = rollout(ScriptedActor(crowd, paths), crowd, max_steps=[max(len(path) - 1, 1) for path in paths])
    assert played.success.all()
    assert not played.replaced.any()
    for executed, planned in zip(played.solutions, paths, strict=True):
        assert np.array_equal(executed.paths, planned)


def test_every_plan_of_the_expert_replays_exactly_in_the_batched_environment():
    crowd = random_cases(num_agents=7, maps=20)
    paths = [each.solution.paths for each in experts.solve_many(crowd, w=1.2) if each.solution]
    assert len(paths) == len(crowd)
    longest = max(len(path) for path in paths)
    held = np.stack([np.concatenate([path, np.repeat(path[-1:], longest - len(path), 0)]) for path in paths])
    for first in range(0, len(crowd), 8):
        part = slice(first, first + 8)
        env = BatchedEnv(len(crowd[part]), num_agents=7, height=6, width=7, max_cycles=longest)
        env.reset(0, instances=crowd[part])
        for time in range(min(len(path) for path in paths[part]) - 1):
            differences = held[part, time + 1] - held[part, time]
            actions = [[STEPS.index(tuple(step)) for step in team] for team in differences.tolist()]
            outcome = env.step(actions)
            assert not outcome.replaced.any()
            assert np.array_equal(env.positions, held[part, time + 1])
            assert np.array_equal(outcome.terminated, [len(path) == time + 2 for path in paths[part]])


def test_teams_that_start_on_their_goals_are_done_at_once(policy):
    grid = np.zeros((4, 4), bool)
    there = Instance(grid, [[0, 0], [1, 1]], [[0, 0], [1, 1]])
    away = Instance(grid, [[0, 0], [1, 1]], [[3, 3], [1, 1]])
    stay = ScriptedActor([away], [away.starts[None]])
    played = rollout(stay, [there, away], max_steps=[5, 3])
    assert played.success.tolist() == [True, False]
    assert played.flowtime[0] == played.makespan[0] == played.replaced[0] == played.throughput[0] == 0
    assert played.on_goal.tolist() == [1, 0.5]
    assert len(played.solutions[0].paths) == 1
    assert len(played.solutions[1].paths) == 4
    assert rollout(policy, [there]).success.all()
    assert not rollout(policy, [there], task="lifelong", max_steps=4).success.any()


def test_the_share_of_replaced_actions():
    """Two robots that push against each other: each step both are stopped, and a third idles."""
    grid = np.zeros((1, 5), bool)
    face_to_face = Instance(grid, [[0, 1], [0, 2], [0, 4]], [[0, 2], [0, 1], [0, 3]])

    class Pushing(Blind):
        def act(self, env):
            return np.tile([3, 1, 4, 4], (env.num_envs, 1))[:, : env.num_agents]

    played = rollout(Pushing(), [face_to_face], max_steps=6)
    assert not played.success[0]
    assert played.replaced[0] == pytest.approx(2 / 3)
    assert played.flowtime[0] == 18
    larger = Instance(np.zeros((1, 9), bool), [[0, 0], [0, 2], [0, 4], [0, 6]], [[0, 8], [0, 7], [0, 5], [0, 6]])
    together = rollout(Pushing(), [face_to_face, larger], max_steps=6)
    assert together.replaced[0] == played.replaced[0], "robots that are not there are not counted"


def test_goals_that_are_left_again_do_not_count():
    grid = np.zeros((1, 4), bool)
    instance = Instance(grid, [[0, 0]], [[0, 1]])
    there_and_away = ScriptedActor([instance], [np.array([[[0, 0]], [[0, 1]], [[0, 2]]])])
    played = rollout(there_and_away, [instance], max_steps=2)
    assert played.success[0]  # at time 1 the whole team is on its goals: the episode ends there
    assert played.makespan[0] == 1
    pair = Instance(grid, [[0, 0], [0, 3]], [[0, 1], [0, 2]])
    path = np.array([[[0, 0], [0, 3]], [[0, 1], [0, 3]], [[0, 0], [0, 2]], [[0, 0], [0, 2]]])
    played = rollout(ScriptedActor([pair], [path]), [pair], max_steps=3)
    assert not played.success[0]
    assert played.latched[0]
    assert played.flowtime[0] == 3 + 2
    assert played.makespan[0] == 3
    assert played.throughput[0] == pytest.approx(2 / 3)


@pytest.mark.parametrize("shield", ["idle", "pibt", "pibt_swap"])
def test_throughput_is_the_number_of_arrivals_a_step(mixed, shield):
    """Robots get goals whenever they arrive, until the time is up."""
    actor = GreedyActor(random_when_stuck=True, shield=shield)
    limits = [5 if i % 3 else 150 + i for i in range(len(mixed))]
    played = rollout(actor, mixed, task="lifelong", max_steps=limits, seed=2)
    assert not played.success.any()
    total = 0
    for i, instance in enumerate(mixed):
        paths, goals = played.solutions[i].paths, played.goals[i]
        assert len(paths) == len(goals) == limits[i] + 1
        assert np.array_equal(goals[0], instance.goals)
        assert_legal(instance, paths)
        arrivals, touched = 0, set()
        for time in range(1, len(paths)):
            for robot, goal in enumerate(goals[time - 1].tolist()):
                here, before = paths[time, robot].tolist(), paths[time - 1, robot].tolist()
                arrivals += here == goal != before
                touched |= {robot} if goal in (here, before) else set()
                if goal != here:
                    assert goals[time, robot].tolist() == goal, "a goal that is not reached stays"
        assert played.throughput[i] == pytest.approx(arrivals / limits[i])
        assert played.latched[i] == (len(touched) == instance.num_agents)
        assert played.flowtime[i] == limits[i] * instance.num_agents
        assert played.on_goal[i] == pytest.approx((paths[-1] == goals[-1]).all(-1).mean())
        total += arrivals
    assert total > 30
    assert 0 < played.latched.sum() < len(mixed)


def test_losing_all_messages_equals_sending_none(cases, policy):
    deaf = DecentralizedPolicy(replace(CONFIG, comm_radius=0.0))
    deaf.load_state_dict(policy.state_dict())
    whole, half, nothing, again = (
        rollout(policy, cases, max_steps=25, message_loss=loss, seed=1) for loss in (0.0, 0.5, 1.0, 0.5)
    )
    silent = rollout(deaf, cases, max_steps=25, seed=1)
    everything = range(len(cases))
    assert all(same(nothing, silent, i, i) for i in everything)
    assert all(same(half, again, i, i) for i in everything)
    for one, other in ((whole, half), (half, nothing), (whole, nothing)):
        assert not all(same(one, other, i, i) for i in everything)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ({"max_steps": [5, 5]}, "2 values of max_steps for 12 instances"),
        ({"seed": [5, 5]}, "2 values of seed for 12 instances"),
        ({"seed": -1}, "seed must lie in"),
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
        ({"task": "forever"}, "task must be one of one_shot, lifelong"),
        ({"message_loss": 1.5}, r"message_loss must lie in \[0, 1\]"),
    ],
)
def test_bad_arguments_are_refused_by_name(cases, policy, wrong, message):
    with pytest.raises(ValueError, match=message):
        rollout(policy, cases, **wrong)


def test_no_instances_are_refused(policy):
    with pytest.raises(ValueError, match="no instances"):
        rollout(policy, [])


def test_actions_that_are_not_numbers_are_refused(cases):
    class Broken(Blind):
        def act(self, env):
            return np.full((env.num_envs, env.num_agents, 5), np.nan, np.float32)

    with pytest.raises(ValueError, match=r"Broken\.act returned values that are not finite numbers"):
        rollout(Broken(), cases)


@pytest.mark.parametrize("actions", CHOICES)
@pytest.mark.parametrize("shield", ["pibt", "pibt_swap"])
def test_under_the_pibt_shields_nothing_collides_and_batches_do_not_matter(cases, policy, shield, actions):
    settings = {"execution": Execution(shield=shield, actions=actions), "max_steps": 25, "seed": 3}
    out = rollout(policy, cases, **settings)
    again = rollout(policy, cases, **settings, batch_size=5)
    for i, instance in enumerate(cases):
        assert_legal(instance, out.solutions[i].paths)
        assert same(out, again, i, i)
