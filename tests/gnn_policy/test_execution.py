"""Ways to execute a policy: names that round-trip, draws, and who is stuck, by a slow reader of the track."""

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnn_policy.execution import Execution, hears_of, is_stuck, robot_seeds, uniform

VARIANTS = st.builds(
    Execution,
    sample=st.sampled_from([False, True, "stuck"]),
    temperature=st.sampled_from([0.3, 1.0, 2.5]),
    shield=st.sampled_from(["idle", "pibt"]),
    comm_range=st.sampled_from(["fixed", "connected", None]),
    comm_weights=st.sampled_from(["binary", "distance", None]),
)


@given(VARIANTS, st.randoms())
def test_names_round_trip_with_their_words_in_any_order(variant, random):
    words = variant.name.split(",")
    random.shuffle(words)
    again = Execution.parse(",".join(words))
    assert again.name == variant.name
    if variant.sample:
        assert again == variant


def test_a_name_without_a_shield_has_the_one_that_is_given():
    assert Execution.parse("stuck", "pibt") == Execution(sample="stuck", shield="pibt")
    assert Execution.parse("stuck,idle", "pibt") == Execution(sample="stuck")
    assert Execution.parse("stuck") == Execution(sample="stuck")


def test_different_variants_have_different_names():
    choices = itertools.product(
        [False, True, "stuck"], [0.5, 1.0], ["idle", "pibt"], ["fixed", "connected", None], ["binary", "distance", None]
    )
    fields = ("sample", "temperature", "shield", "comm_range", "comm_weights")
    settings: list[dict[str, Any]] = [dict(zip(fields, each, strict=True)) for each in choices]
    variants = [Execution(**each) for each in settings]
    assert len({each.name for each in variants if each.sample}) == 2 * 2 * 2 * 9
    assert Execution().name == "argmax"
    assert Execution(sample=True, temperature=0.5, shield="pibt").name == "sampled,0.5,pibt"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("greedily", "'greedily'.*argmax, sampled, stuck, idle, pibt, fixed, connected, binary, distance or a temp"),
        ("", "unknown word ''"),
        ("sampled,stuck", "sample twice"),
        ("sampled,1,2", "temperature twice"),
        ("pibt,idle", "shield twice"),
        ("argmax,0.5", "draws nothing"),
        ("0.5", "draws nothing"),
        ("sampled,0", "temperature must be positive"),
        ("sampled,nan", "temperature must be positive"),
        ("sampled,inf", "temperature must be positive and finite"),
    ],
)
def test_names_that_say_nothing_clear_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        Execution.parse(text)


@pytest.mark.parametrize("field", ["sample", "shield", "comm_range", "comm_weights"])
def test_unknown_values_are_refused_by_name(field):
    with pytest.raises(ValueError, match=f"{field} must be one of"):
        Execution(**{field: "often"})  # pyright: ignore[reportArgumentType]


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 5), st.integers(0, 6))
def test_stuck_is_who_stands_off_its_goal_where_it_stood_before(seed, teams, robots, steps):
    generator = np.random.default_rng(seed)
    track = generator.integers(0, 2, (steps + 1, teams, robots, 2)).astype(np.int32)
    goals = generator.integers(0, 2, (teams, robots, 2)).astype(np.int32)
    stuck = is_stuck(track[-1], goals, track[:-1])
    assert stuck.shape == (teams, robots)
    for b, i in itertools.product(range(teams), range(robots)):
        cells = [tuple(cell) for cell in track[:, b, i].tolist()]
        assert stuck[b, i] == (cells[-1] in cells[:-1] and cells[-1] != tuple(goals[b, i].tolist()))


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_who_hears_of_a_stuck_robot(seed, robots):
    generator = np.random.default_rng(seed)
    stuck = generator.random((3, robots)) < 0.4
    graph = (generator.random((3, robots, robots)) * (generator.random((3, robots, robots)) < 0.4)).astype(np.float32)
    heard = hears_of(stuck, graph)
    for b, i in itertools.product(range(3), range(robots)):
        assert heard[b, i] == any(stuck[b, j] for j in range(robots) if graph[b, i, j] > 0)


def test_draws_are_uniform_and_depend_on_each_argument():
    seeds = robot_seeds(np.arange(100, dtype=np.uint64), 5)
    draws = uniform(seeds, 7, 20)
    assert draws.shape == (100, 5, 20)
    assert ((draws >= 0) & (draws < 1)).all()
    counts, _ = np.histogram(draws, 10, (0, 1))
    assert abs(counts - 1000).max() < 150
    assert np.array_equal(uniform(seeds[17:18, 3], 7, 20)[0], draws[17, 3])
    assert not (uniform(seeds, 8, 20) == draws).any()
    assert not (uniform(seeds + np.uint64(1000), 7, 20) == draws).any()
    assert len(np.unique(draws)) == draws.size
    assert np.array_equal(robot_seeds(np.arange(100, dtype=np.uint64), 3), seeds[:, :3]), "robots join, none changes"


def test_the_values_of_a_robot_that_draws_are_its_tempered_logits_and_standard_gumbel_noise():
    logits = np.array([2.0, -1.0, 0.0, 0.5, 1.0], np.float32)
    seeds = np.arange(20_000, dtype=np.uint64)
    many = np.tile(logits, (len(seeds), 1))
    values = Execution(sample="stuck", temperature=2.0).values(many, seeds % 2 == 0, seeds, 3)
    assert np.array_equal(values[1::2], many[1::2])
    noise = values[::2] - logits / 2
    assert noise.mean() == pytest.approx(np.euler_gamma, abs=0.03)
    assert noise.var() == pytest.approx(np.pi**2 / 6, abs=0.06)
    # Orders are drawn without replacement: after the first move, the second follows the softmax of the rest.
    second = np.argsort(-values[::2], axis=1)
    rest = second[second[:, 0] == 0, 1]
    weights = np.exp(logits[1:] / 2)
    shares = [(rest == move).mean() for move in range(1, 5)]
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.03)
