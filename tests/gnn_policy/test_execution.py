"""Ways to execute a policy: names that round-trip, draws, and stuck robots, by a slow reader of the track."""

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import strategies
from gnn_policy import PolicyConfig
from gnn_policy.execution import Execution, alarmed, gumbel, robot_seeds, uniform
from mapf_env import HISTORY, BatchedEnv, EnvConfig, Instance, Senses

EXECUTIONS = st.builds(
    Execution,
    actions=st.sampled_from(["argmax", "sampled", "stuck", "fallback"]),
    temperature=st.sampled_from([0.3, 1.0, 2.5]),
    shield=st.sampled_from(["idle", "pibt", "pibt_swap"]),
    comm_range=st.sampled_from(["fixed", "connected", None]),
    comm_weights=st.sampled_from(["binary", "distance", None]),
)


@given(EXECUTIONS, st.randoms())
def test_names_round_trip_with_their_words_in_any_order(execution, random):
    words = execution.name.split(",")
    random.shuffle(words)
    again = Execution.parse(",".join(words))
    assert again.name == execution.name
    if execution.actions != "argmax":
        assert again == execution


def test_a_name_without_a_shield_has_the_one_that_is_given():
    assert Execution.parse("stuck", Execution(shield="pibt", temperature=0.5, actions="sampled")) == Execution(
        actions="stuck", shield="pibt", temperature=0.5
    )
    assert Execution.parse("stuck,idle", Execution(shield="pibt")) == Execution(actions="stuck")
    assert Execution.parse("stuck") == Execution(actions="stuck")


def test_different_executions_have_different_names():
    choices = itertools.product(
        *(["argmax", "sampled", "stuck", "fallback"], [0.5, 1.0], ["idle", "pibt", "pibt_swap"]),
        *(["fixed", "connected", None], ["binary", "distance", None]),
    )
    fields = ("actions", "temperature", "shield", "comm_range", "comm_weights")
    settings: list[dict[str, Any]] = [dict(zip(fields, each, strict=True)) for each in choices]
    executions = [Execution(**each) for each in settings]
    assert len({each.name for each in executions if each.actions != "argmax"}) == 3 * 2 * 3 * 9
    assert Execution().name == "argmax"
    assert Execution(actions="sampled", temperature=0.5, shield="pibt").name == "sampled,0.5,pibt"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "greedily",
            "'greedily'.*argmax, sampled, stuck, fallback, idle, pibt, pibt_swap, fixed, connected, binary, distance",
        ),
        ("", "unknown word ''"),
        ("sampled,stuck", "actions twice"),
        ("sampled,1,2", "temperature twice"),
        ("pibt,idle", "shield twice"),
        ("pibt,pibt_swap", "shield twice"),
        ("argmax,0.5", "samples nothing"),
        ("0.5", "samples nothing"),
        ("sampled,0", "temperature must be positive"),
        ("sampled,nan", "temperature must be positive"),
        ("sampled,inf", "temperature must be positive and finite"),
    ],
)
def test_names_that_say_nothing_clear_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        Execution.parse(text)


@pytest.mark.parametrize("field", ["actions", "shield", "comm_range", "comm_weights"])
def test_unknown_values_are_refused_by_name(field):
    with pytest.raises(ValueError, match=f"{field} must be one of"):
        Execution(**{field: "often"})  # pyright: ignore[reportArgumentType]


@settings(max_examples=40)
@given(strategies.instances(max_side=3, min_agents=2, max_agents=4), strategies.seeds, st.integers(0, HISTORY + 4))
def test_environments_of_an_execution_show_which_robots_are_stuck(instance: Instance, seed, steps):
    """Off its goal where it stood in one of its last steps: the last scalar, by the track of each robot."""
    height, width = instance.grid.shape
    chosen = Execution(actions="stuck").env_settings(PolicyConfig(fov_radius=2, robot_features=("last_moves",)))
    env = BatchedEnv(1, num_agents=instance.num_agents, height=height, width=width, density=0.0, **chosen)
    env.reset(seed, instances=[instance])
    generator, track, goals = np.random.default_rng(seed), [], instance.goals.tolist()
    while env.running.any() and len(track) < steps:
        track.append(env.positions[0].tolist())
        env.step(generator.integers(5, size=(1, instance.num_agents)))
    if not env.running.any():
        return
    here = env.positions[0].tolist()
    for robot, known in enumerate(env.bag().scalars[:, -1]):
        before = [then[robot] for then in track[-HISTORY:]]
        assert known == (here[robot] in before and here[robot] != goals[robot])


@pytest.mark.parametrize("own", [(), ("stuck",), ("greedy_moves", "on_goal"), ("stuck", "greedy_moves", "jammed")])
def test_a_fallback_reads_the_greedy_moves_and_which_robots_are_stuck_or_jammed(own):
    known = Execution(actions="fallback").senses(PolicyConfig(robot_features=own)).robot_features
    assert known[: len(own)] == own
    assert sorted(known) == sorted({*own, "greedy_moves", "stuck", "jammed"})


def test_a_fallback_prefers_shorter_paths_then_staying_then_the_noise():
    fallback, rng = Execution(actions="fallback", temperature=0.5), np.random.default_rng(0)
    logits = rng.normal(0, 100, (400, 5)).astype(np.float32)
    alarm, greedy, jammed = rng.random(400) < 0.5, rng.random((400, 5)) < 0.4, np.zeros(400, bool)
    noise = gumbel(np.arange(400, dtype=np.uint64), np.zeros(400, int))
    scores = fallback.scores(logits, alarm, lambda drawn: noise[drawn], greedy, jammed)
    assert np.array_equal(scores[~alarm], logits[~alarm])
    drawn = (logits / 0.5 + noise).clip(-333, 333)
    for robot in np.flatnonzero(alarm):
        keys = [(2 * greedy[robot, a] or a == 4, drawn[robot, a]) for a in range(5)]
        ranks = [keys[a] for a in scores[robot].argsort(kind="stable")]
        assert all(one[0] <= two[0] for one, two in itertools.pairwise(ranks))
        assert all(one[1] <= two[1] + 1e-2 for one, two in itertools.pairwise(ranks) if one[0] == two[0])
    with pytest.raises(ValueError, match="needs each robot's greedy moves"):
        fallback.scores(logits, alarm, lambda drawn: noise[drawn])


def test_a_jammed_robot_samples_among_all_moves_and_prefers_shorter_paths():
    count = 20_000
    logits, greedy = (
        np.tile(np.log([0.3, 0.3, 0.2, 0.1, 0.1]).astype(np.float32), (count, 1)),
        np.zeros((count, 5), bool),
    )
    greedy[:, 3] = True
    noise = gumbel(np.arange(count, dtype=np.uint64), np.zeros(count, int))
    everyone = np.ones(count, bool)
    scores = Execution(actions="fallback").scores(logits, everyone, lambda drawn: noise[drawn], greedy, everyone)
    weights = np.array([0.3, 0.3, 0.2, 0.1 * np.exp(4), 0.1 * np.exp(2)])
    shares = np.bincount(scores.argmax(1), minlength=5) / count
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.015)


def test_an_environment_has_the_senses_of_the_policy_and_the_radio_and_shield_of_the_execution():
    policy = PolicyConfig(fov_radius=3, comm_weights="distance", robot_features=("on_goal",))
    own = Execution().senses(policy)
    assert own == Senses(fov_radius=3, comm_weights="distance", robot_features=("on_goal",))
    other = Execution(actions="stuck", comm_range="connected", comm_weights="binary", shield="pibt")
    assert other.senses(policy) == Senses(
        fov_radius=3, comm_weights="binary", comm_range="connected", robot_features=("on_goal", "stuck")
    )
    config = EnvConfig(**other.env_settings(policy))
    assert config.shield == "pibt"
    assert config.senses() == other.senses(policy).senses()
    knows = PolicyConfig(robot_features=("stuck", "on_goal"))
    assert other.senses(knows).robot_features == ("stuck", "on_goal"), "it is not asked for twice"


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_robots_that_are_stuck_or_hear_one_that_is_are_alarmed(seed, robots):
    generator = np.random.default_rng(seed)
    stuck = generator.random(robots) < 0.4
    links = [(j, i) for i in range(robots) for j in range(robots) if i != j and generator.random() < 0.3]
    heard = alarmed(stuck, np.array(links, np.int64).reshape(-1, 2).T)
    for i in range(robots):
        assert heard[i] == (stuck[i] or any(stuck[j] for j, receiver in links if receiver == i))


def test_draws_are_uniform_and_depend_on_each_argument():
    teams, robots = np.repeat(np.arange(100, dtype=np.uint64), 5), np.tile(np.arange(5), 100)
    seeds, at = robot_seeds(teams, robots), np.full(500, 7)
    draws = uniform(seeds, at, 20)
    assert draws.shape == (500, 20)
    assert ((draws >= 0) & (draws < 1)).all()
    counts, _ = np.histogram(draws, 10, (0, 1))
    assert abs(counts - 1000).max() < 150
    assert np.array_equal(uniform(seeds[88:89], at[:1], 20)[0], draws[88]), "the other robots play no part"
    assert not (uniform(seeds, at + 1, 20) == draws).any()
    assert not (uniform(seeds + np.uint64(1000), at, 20) == draws).any()
    assert len(np.unique(draws)) == draws.size
    moments = at + np.arange(500) % 3
    assert np.array_equal(uniform(seeds, moments, 20)[::3], uniform(seeds[::3], moments[::3], 20))


def test_scores_of_a_robot_that_samples_are_tempered_logits_plus_gumbel_noise():
    logits = np.array([2.0, -1.0, 0.0, 0.5, 1.0], np.float32)
    seeds = np.arange(20_000, dtype=np.uint64)
    many = np.tile(logits, (len(seeds), 1))

    def noise(drawn):
        return gumbel(seeds[drawn], np.full(int(drawn.sum()), 3))

    scores = Execution(actions="stuck", temperature=2.0).scores(many, seeds % 2 == 0, noise)
    assert np.array_equal(scores[1::2], many[1::2])
    added = scores[::2] - logits / 2
    assert added.mean() == pytest.approx(np.euler_gamma, abs=0.03)
    assert added.var() == pytest.approx(np.pi**2 / 6, abs=0.06)
    # Orders are drawn without replacement: after the first move, the second follows the softmax of the rest.
    second = np.argsort(-scores[::2], axis=1)
    rest = second[second[:, 0] == 0, 1]
    weights = np.exp(logits[1:] / 2)
    shares = [(rest == move).mean() for move in range(1, 5)]
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.03)


@pytest.mark.parametrize("actions", ["argmax", "sampled", "stuck"])
def test_all_robots_sample_or_none_or_the_alarmed_ones(actions):
    logits, alarm = np.zeros((6, 5), np.float32), np.arange(6) % 3 == 0
    asked = []

    def noise(drawn):
        asked.append(drawn)
        return np.ones((int(drawn.sum()), 5), np.float32)

    scores = Execution(actions=actions).scores(logits, alarm, noise)
    drawing = {"argmax": np.zeros(6, bool), "sampled": np.ones(6, bool), "stuck": alarm}[actions]
    assert (scores == drawing[:, None]).all()
    assert len(asked) == (actions != "argmax")
    assert (logits == 0).all(), "the logits are not written to"


def test_numbers_that_are_not_finite_are_refused():
    noise = lambda drawn: np.zeros((int(drawn.sum()), 5), np.float32)  # noqa: E731
    alarm = np.ones(2, bool)
    for wrong in (np.nan, np.inf):
        logits = np.array([[0, 0, 0, 0, 0], [0, wrong, 0, 0, 0]], np.float32)
        with pytest.raises(ValueError, match="logits are not finite: its weights or what it observes are damaged"):
            Execution().scores(logits, alarm, noise)
    with pytest.raises(ValueError, match="the logits over a temperature of 1e-38 are not finite: give a higher one"):
        Execution(actions="sampled", temperature=1e-38).scores(np.full((2, 5), 1e9, np.float32), alarm, noise)
