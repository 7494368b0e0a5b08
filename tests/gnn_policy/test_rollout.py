"""Rollouts: what is executed never collides, and its judgement is that of a slow reader of the paths."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import experts
from gnn_policy import DecentralizedPolicy, PolicyConfig, load, rollout
from gnn_policy.baselines import RandomActor
from gnn_policy.cases import make_cases
from gnn_policy.execution import Execution
from gnn_policy.rollout import PolicyActor, Teams
from mapf_env import BatchedEnv, Instance, parallel_env, rules

few = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])

STEPS = [(-1, 0), (0, -1), (1, 0), (0, 1), (0, 0)]


def random_cases(seed=0, maps=6, num_agents=4, height=6, width=7, density=0.15, cases_per_map=2):
    return make_cases(
        "test",
        seed=seed,
        maps=maps,
        cases_per_map=cases_per_map,
        num_agents=num_agents,
        height=height,
        width=width,
        density=density,
        styles=["cells"],
    )


@pytest.fixture(scope="module")
def cases():
    return random_cases()


@pytest.fixture(scope="module")
def policy():
    torch.manual_seed(0)
    policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2, comm_radius=3.0))
    with torch.no_grad():
        policy.head.weight.mul_(20)  # preferences that differ from cell to cell
    return policy.eval()


class ErraticActor:
    border, memory = 1, 0

    """Moves at random, crowding included."""

    def __init__(self, seed):
        self.generator = np.random.default_rng(seed)

    def act(self, teams):
        return self.generator.integers(5, size=teams.positions.shape[:2])


class ScriptedActor:
    border, memory = 1, 0

    """Follows given paths, then stays."""

    def __init__(self, paths):
        self.paths = paths

    def act(self, teams):
        moves, time = np.full(teams.positions.shape[:2], 4), teams.time
        for team, case in enumerate(teams.cases):
            path = self.paths[case]
            assert np.array_equal(teams.positions[team], path[min(time, len(path) - 1)]), "the team has left its path"
            if time + 1 < len(path):
                for robot, (before, after) in enumerate(zip(path[time], path[time + 1], strict=True)):
                    moves[team, robot] = STEPS.index(tuple((after - before).tolist()))
        return moves


def assert_legal(instance, paths):
    """No robot jumps, leaves the map, meets an obstacle, another robot or exchanges cells with one."""
    assert np.array_equal(paths[0], instance.starts)
    height, width = instance.grid.shape
    cells = [[tuple(cell) for cell in row] for row in paths.tolist()]
    for time, here in enumerate(cells):
        assert len(set(here)) == len(here)
        for row, col in here:
            assert 0 <= row < height
            assert 0 <= col < width
            assert not instance.grid[row, col]
        if time:
            before = cells[time - 1]
            for i, cell in enumerate(here):
                assert (cell[0] - before[i][0], cell[1] - before[i][1]) in STEPS
                for j in range(i):
                    assert not (cell == before[j] and here[j] == before[i])


def slowly_judged(instance, paths, limit):
    """Success, flowtime, makespan and latched success, by walking along each path."""
    goals = [tuple(cell) for cell in instance.goals.tolist()]
    times, touched = [], []
    for robot, goal in enumerate(goals):
        track = [tuple(cell) for cell in paths[:, robot].tolist()]
        touched.append(goal in track)
        if track[-1] != goal:
            times.append(limit)
            continue
        time = len(track) - 1
        while time > 0 and track[time - 1] == goal:
            time -= 1
        times.append(time)
    success = all(tuple(cell) == goal for cell, goal in zip(paths[-1].tolist(), goals, strict=True))
    return success, sum(times), max(times), all(touched)


def assert_judged_rightly(played, limits):
    for i, instance in enumerate(played.instances):
        paths = played.solutions[i].paths
        assert_legal(instance, paths)
        success, flowtime, makespan, latched = slowly_judged(instance, paths, limits[i])
        assert played.success[i] == success
        assert played.flowtime[i] == flowtime
        assert played.makespan[i] == makespan
        assert played.latched[i] == latched
        joint_arrivals = [t for t, here in enumerate(paths) if np.array_equal(here, instance.goals)]
        assert len(paths) - 1 == (joint_arrivals[0] if joint_arrivals else limits[i])
        assert joint_arrivals[:-1] == []


@few
@given(seed=st.integers(0, 2**32 - 1), num_agents=st.integers(1, 9))
def test_nothing_executed_collides_and_the_judgement_is_right(seed, num_agents):
    crowd = random_cases(seed, maps=3, num_agents=num_agents, height=3, width=4, density=0.1)
    limits = np.random.default_rng(seed).integers(1, 60, len(crowd))
    played = rollout(ErraticActor(seed), crowd, seed=seed, max_steps=limits)
    assert played.instances == crowd
    assert_judged_rightly(played, limits)


SAMPLES = [False, True, "stuck"]


class Plain(torch.nn.Module):
    """A network of one's own, here one that does what the package's does."""

    def __init__(self, policy):
        super().__init__()
        self.policy, self.config = policy, policy.config

    def forward(self, fov, graph):
        return self.policy(fov, graph)


@pytest.mark.parametrize("settings", [{}, {"sample": "stuck"}, {"shield": "pibt", "comm_range": "connected"}])
def test_a_network_of_ones_own_is_executed_like_a_policy(cases, policy, settings):
    network = Plain(policy).train()
    played = rollout(network, cases, max_steps=20, **settings)
    expected = rollout(policy, cases, max_steps=20, **settings)
    for one, other in zip(played.solutions, expected.solutions, strict=True):
        assert np.array_equal(one.paths, other.paths)
    assert network.training


def test_what_is_neither_network_nor_actor_is_refused(cases):
    with pytest.raises(TypeError, match=r"Linear does not say .*: give it a `config`, .*PolicyConfig"):
        rollout(torch.nn.Linear(3, 5), cases)
    with pytest.raises(TypeError, match=r"plays a network or an actor, got str: an actor has `border`"):
        rollout("n12", cases)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("sample", SAMPLES)
def test_the_policy_is_judged_like_anyone(cases, policy, sample):
    played = rollout(policy, cases, sample=sample, max_steps=30, seed=2)
    assert_judged_rightly(played, [30] * len(cases))
    assert 0 < played.replaced.mean() < 1


def same(one, two, i, j):
    return (
        np.array_equal(one.solutions[i].paths, two.solutions[j].paths)
        and one.success[i] == two.success[j]
        and one.flowtime[i] == two.flowtime[j]
        and one.replaced[i] == two.replaced[j]
    )


@pytest.mark.parametrize("sample", SAMPLES)
def test_the_size_of_batches_does_not_matter(cases, policy, sample):
    played = [rollout(policy, cases, sample=sample, max_steps=25, batch_size=size) for size in (1, 3, 5, 256)]
    for other in played[1:]:
        assert all(same(played[0], other, i, i) for i in range(len(cases)))


def test_a_policy_that_knows_the_map_measures_the_ways_once_for_each_batch(monkeypatch):
    maps = random_cases(maps=4, cases_per_map=1) + random_cases(seed=1, maps=3, cases_per_map=1)
    policy = load("n12-informed")
    measured = []
    tables = rules.distance_tables
    monkeypatch.setattr(rules, "distance_tables", lambda *given: (measured.append(len(given[0])), tables(*given))[1])
    once = rollout(policy, maps, max_steps=25, batch_size=4)
    assert measured == [4, 3]
    assert once.makespan.max() > once.makespan.min(), "teams end at different times"
    alone = rollout(policy, maps, max_steps=25, batch_size=1)
    assert all(same(once, alone, i, i) for i in range(len(maps)))


@few
@given(
    seed=st.integers(0, 2**64 - 1),
    order=st.permutations(range(12)),
    kept=st.integers(1, 12),
    sample=st.sampled_from(SAMPLES),
    shield=st.sampled_from(["idle", "pibt"]),
    comm_range=st.sampled_from(["fixed", "connected"]),
)
def test_a_case_depends_neither_on_its_place_nor_on_the_others(
    cases, policy, seed, order, kept, sample, shield, comm_range
):
    settings = {"sample": sample, "shield": shield, "comm_range": comm_range, "max_steps": 12}
    whole = rollout(policy, cases, seed=seed, **settings)
    chosen = order[:kept]
    part = rollout(policy, [cases[i] for i in chosen], seed=seed, batch_size=5, **settings)
    assert all(same(whole, part, i, place) for place, i in enumerate(chosen))


def test_equal_cases_end_equally_unless_their_seeds_differ(cases, policy):
    copies = [cases[0]] * 6
    equal = rollout(policy, copies, sample=True, max_steps=25, seed=3)
    assert all(same(equal, equal, 0, i) for i in range(6))
    seeds = [3, 4, 5, 3, 4, 5]
    own = rollout(policy, copies, sample=True, max_steps=25, seed=seeds)
    for i, seed in enumerate(seeds):
        assert same(own, rollout(policy, copies[:1], sample=True, max_steps=25, seed=seed), i, 0)
    assert len({own.solutions[i].paths.tobytes() for i in range(6)}) == 3


def test_goals_and_maps_are_part_of_what_draws_depend_on(policy):
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
        def act(self, teams):
            seen.append(teams.seeds)
            return super().act(teams)

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


class CrowdingActor:
    border, memory = 1, 0

    """Random moves that depend on the case and the time alone, so that the shield has ties to break."""

    def act(self, teams):
        robots = teams.positions.shape[1]
        return np.stack([np.random.default_rng([case, teams.time]).integers(5, size=robots) for case in teams.cases])


def test_neither_batches_nor_neighbours_that_end_early_change_how_ties_are_broken_or_when_time_is_up():
    crowd = random_cases(num_agents=9, maps=8, height=4, width=4, density=0.0)
    limits = np.arange(len(crowd)) % 5 + 8
    one = rollout(CrowdingActor(), crowd, max_steps=limits, seed=3)
    assert_judged_rightly(one, limits)
    for size in (1, 5):
        other = rollout(CrowdingActor(), crowd, max_steps=limits, seed=3, batch_size=size)
        assert all(same(one, other, i, i) for i in range(len(crowd)))
    at_home = [case if i % 3 == 2 else case.at(case.goals) for i, case in enumerate(crowd)]
    mixed = rollout(CrowdingActor(), at_home, max_steps=limits, seed=3)
    assert all(same(one, mixed, i, i) for i in range(2, len(crowd), 3))


def test_equal_seeds_repeat_and_others_do_not(cases, policy):
    one, two, three = (rollout(policy, cases, sample=True, seed=seed, max_steps=25) for seed in (5, 5, 6))
    assert all(same(one, two, i, i) for i in range(len(cases)))
    assert not all(same(one, three, i, i) for i in range(len(cases)))


def observed(case, config):
    height, width = case.grid.shape
    env = parallel_env(
        num_agents=case.num_agents,
        height=height,
        width=width,
        fov_radius=config.fov_radius,
        comm_radius=config.comm_radius,
    )
    seen, _ = env.reset(seed=0, options={"instance": case})
    return [torch.from_numpy(np.stack([each[name] for each in seen.values()]))[None] for name in ("fov", "graph")]


def test_sampled_moves_follow_the_tempered_softmax_and_argmax_its_mode(cases, policy):
    case = cases[0]
    with torch.no_grad():
        logits = policy(*observed(case, policy.config))[0]
    pad = policy.config.fov_radius
    obstacles = np.pad(case.grid.astype(np.float32), pad, constant_values=1)
    maps, starts, goals = (np.repeat(each[None], 3000, 0) for each in (obstacles, case.starts, case.goals))
    past = np.empty((0, *starts.shape), np.int32)
    teams = Teams(np.zeros(3000, np.intp), np.arange(3000, dtype=np.uint64), maps, starts, goals, past, time=0)
    for temperature in (0.3, 1.0, 4.0):
        actor = PolicyActor(policy, [case], Execution(sample=True, temperature=temperature))
        moves = actor.act(teams).argmax(-1)
        counted = np.stack([(moves == action).mean(axis=0) for action in range(5)], -1)
        np.testing.assert_allclose(counted, torch.softmax(logits / temperature, -1).numpy(), atol=0.04)
    assert np.array_equal(PolicyActor(policy, [case], Execution()).act(teams)[0].argmax(-1), logits.argmax(-1).numpy())


def reached(stuck, graph):
    return [bool(stuck[i] or any(stuck[j] for j in range(len(stuck)) if graph[i][j] > 0)) for i in range(len(stuck))]


@pytest.mark.parametrize("taps", [1, 3])
def test_sampling_when_stuck_differs_from_argmax_only_for_robots_that_know_of_a_stuck_one(cases, taps):
    torch.manual_seed(1)
    config = PolicyConfig(encoder="lean", features=8, fov_radius=2, comm_radius=2.5, taps=taps)
    policy = DecentralizedPolicy(config).eval()
    generator = np.random.default_rng(0)
    drew = stayed = told = 0
    for case in cases:
        came_back = np.array([case.goals, case.starts[[0, 2, 1, 3]]])[:, None]
        for positions, past in ((case.starts, came_back), (case.goals, came_back), (case.starts, came_back[:1])):
            obstacles = np.pad(case.grid.astype(np.float32), 2, constant_values=1)[None]
            stuck = [
                any(np.array_equal(then, here) for then in past[:, 0, i]) and not np.array_equal(here, case.goals[i])
                for i, here in enumerate(positions)
            ]
            distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
            graph = (distances < 2.5) & (distances > 0)
            draws = reached(stuck, graph) if taps > 1 else stuck
            seeds = generator.integers(2**63, size=1, dtype=np.uint64)
            teams = Teams(np.zeros(1, np.intp), seeds, obstacles, positions[None], case.goals[None], past, 5)
            always, never, when_stuck = (
                PolicyActor(policy, [case], Execution(sample=sample)).act(teams)[0] for sample in (True, False, "stuck")
            )
            for i, draw in enumerate(draws):
                assert np.array_equal(when_stuck[i], (always if draw else never)[i])
                assert not np.array_equal(always[i], never[i])
            drew, stayed = drew + sum(draws), stayed + draws.count(False)
            told += sum(draws) - sum(stuck)
    assert drew
    assert stayed
    assert (told > 0) == (taps > 1)


def test_the_memory_of_a_team_is_its_last_positions(cases):
    class Remembering(RandomActor):
        memory = 3

        def __init__(self):
            self.seen = []

        def act(self, teams):
            self.seen.append((teams.cases, teams.past))
            return super().act(teams)

    actor = Remembering()
    played = rollout(actor, cases, max_steps=np.arange(len(cases)) + 2)
    for time, (active, past) in enumerate(actor.seen):
        assert len(past) == min(time, 3)
        for team, case in enumerate(active):
            expected = played.solutions[case].paths[max(time - 3, 0) : time]
            assert np.array_equal(past[:, team], expected)


def test_every_plan_of_the_expert_replays_exactly():
    crowd = random_cases(num_agents=7, maps=20)
    paths = [each.solution.paths for each in experts.solve_many(crowd, w=1.2) if each.solution]
    assert len(paths) == len(crowd)
    played = rollout(ScriptedActor(paths), crowd, max_steps=[max(len(path) - 1, 1) for path in paths])
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
    played = rollout(policy, [there, away], max_steps=[5, 3])
    assert played.success[0]
    assert played.flowtime[0] == played.makespan[0] == played.replaced[0] == 0
    assert len(played.solutions[0].paths) == 1
    assert len(played.solutions[1].paths) == 4
    assert rollout(policy, [there]).success.all()


def test_the_share_of_replaced_actions():
    """Two robots that push against each other: each step both are stopped, and a third idles."""
    grid = np.zeros((1, 5), bool)
    face_to_face = Instance(grid, [[0, 1], [0, 2], [0, 4]], [[0, 2], [0, 1], [0, 3]])

    class Pushing:
        border, memory = 1, 0

        def act(self, teams):
            return np.array([[3, 1, 4]])

    played = rollout(Pushing(), [face_to_face], max_steps=6)
    assert not played.success[0]
    assert played.replaced[0] == pytest.approx(2 / 3)
    assert played.flowtime[0] == 18


def test_goals_that_are_left_again_do_not_count():
    grid = np.zeros((1, 4), bool)
    instance = Instance(grid, [[0, 0]], [[0, 1]])
    there_and_away = ScriptedActor([np.array([[[0, 0]], [[0, 1]], [[0, 2]]])])
    played = rollout(there_and_away, [instance], max_steps=2)
    assert played.success[0]  # at time 1 the whole team is on its goals: the episode ends there
    assert played.makespan[0] == 1
    pair = Instance(grid, [[0, 0], [0, 3]], [[0, 1], [0, 2]])
    leaving = ScriptedActor([np.array([[[0, 0], [0, 3]], [[0, 1], [0, 3]], [[0, 0], [0, 2]], [[0, 0], [0, 2]]])])
    played = rollout(leaving, [pair], max_steps=3)
    assert not played.success[0]
    assert played.latched[0]
    assert played.flowtime[0] == 3 + 2
    assert played.makespan[0] == 3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"max_steps": 0}, "max_steps"),
        ({"max_steps": [5, 5]}, "max_steps"),
        ({"batch_size": 0}, "batch_size"),
        ({"shield": "none"}, "shield"),
        ({"sample": True, "temperature": 0.0}, "temperature"),
    ],
)
def test_bad_arguments_are_refused_by_name(cases, policy, wrong, message):
    with pytest.raises(ValueError, match=message):
        rollout(policy, cases, **wrong)


def test_instances_of_different_sizes_are_refused(cases, policy):
    with pytest.raises(ValueError, match="no instances"):
        rollout(policy, [])
    with pytest.raises(ValueError, match="one team size and map size"):
        rollout(policy, [*cases, *random_cases(num_agents=2)])


@pytest.mark.parametrize("sample", SAMPLES)
def test_under_the_pibt_shield_nothing_collides_and_batches_do_not_matter(cases, policy, sample):
    settings = {"shield": "pibt", "sample": sample, "max_steps": 25, "seed": 3}
    out = rollout(policy, cases, **settings)
    again = rollout(policy, cases, **settings, batch_size=5)
    for instance, solution, twin in zip(cases, out.solutions, again.solutions, strict=True):
        assert_legal(instance, solution.paths)
        assert np.array_equal(solution.paths, twin.paths)
    assert np.array_equal(out.replaced, again.replaced)
