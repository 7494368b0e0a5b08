"""The metrics, by hand."""

import io
import json
import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from rich.console import Console

import experts
from gnn_policy import DecentralizedPolicy, PolicyConfig, evaluation_tables, metrics, rollout
from gnn_policy.baselines import GreedyActor, RandomActor
from gnn_policy.cases import Family, make_cases
from gnn_policy.execution import Execution
from gnn_policy.metrics import LIFELONG_BASELINES, Estimate, ReferenceSet
from mapf_env import Instance, random_instance


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 10, 0.0000, 0.2775),  # Newcombe 1998, table I, method 3 (and by inversion below)
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilsons_interval_as_tabulated(successes, trials, low, high):
    estimate = Estimate.proportion(np.arange(trials) < successes)
    assert estimate.mean == successes / trials
    assert estimate.low == pytest.approx(low, abs=6e-5)
    assert estimate.high == pytest.approx(high, abs=6e-5)


@pytest.mark.parametrize(("successes", "trials"), [(1, 7), (5, 10), (99, 100), (880, 900), (10, 10)])
def test_wilsons_interval_holds_the_shares_that_the_outcome_does_not_reject(successes, trials):
    """Its ends solve |p - x| = 1.96 sqrt(x (1 - x) / n)."""
    estimate = Estimate.proportion(np.arange(trials) < successes)
    share = successes / trials

    def rejected(x):
        return abs(share - x) > 1.96 * math.sqrt(x * (1 - x) / trials)

    def boundary(inside, outside):
        for _ in range(60):
            middle = (inside + outside) / 2
            inside, outside = (inside, middle) if rejected(middle) else (middle, outside)
        return inside

    assert estimate.low == pytest.approx(boundary(share, 0.0), abs=1e-9)
    assert estimate.high == pytest.approx(1.0 if successes == trials else boundary(share, 1.0), abs=1e-9)


def test_the_interval_of_a_mean():
    estimate = Estimate.average(np.array([1.0, 2.0, 3.0, 6.0]))
    deviation = math.sqrt((4 + 1 + 0 + 9) / 3)
    assert estimate.mean == 3
    assert estimate.high - 3 == pytest.approx(1.96 * deviation / 2)
    assert 3 - estimate.low == pytest.approx(1.96 * deviation / 2)
    assert math.isnan(Estimate.average(np.array([])).mean)
    alone = Estimate.average(np.array([4.0]))
    assert (alone.mean, alone.low, alone.high) == (4, -math.inf, math.inf)


def corridor(*cells):
    """One robot in a corridor of nine cells for each (start, goal)."""
    grid = np.zeros((1, 9), bool)
    return [Instance(grid, [[0, start]], [[0, goal]]) for start, goal in cells]


class Walker:
    """Goes right in every step."""

    def env_settings(self):
        return {"fov_radius": 1}

    def act(self, env):
        return np.full((env.num_envs, env.num_agents), 3)


class Dawdler(Walker):
    """Stays twice, then goes right."""

    def act(self, env):
        return np.where(env.times[:, None] < 2, 4, super().act(env))


def test_flowtime_increase_by_hand():
    reference = ReferenceSet.prepare(corridor((0, 4), (1, 2), (3, 0), (5, 5)), w=1.0, timeout=3.0, threads=1)
    assert reference.max_steps.tolist() == [12, 3, 9, 1]
    assert reference.flowtimes.tolist() == [4, 1, 3, 0]
    assert reference.lower_bounds.tolist() == [4, 1, 3, 0]
    walked = metrics.score("walker", reference, rollout(Walker(), reference.instances, max_steps=reference.max_steps))
    assert walked.success_rate.mean == 3 / 4
    assert walked.flowtime_increase.mean == pytest.approx((0 + 0 + 6 / 3 + 0) / 4)
    assert walked.flowtime_increase_solved.mean == 0
    assert walked.makespan.mean == pytest.approx((4 + 1 + 0) / 3)
    assert walked.latched == 3 / 4
    dawdled = metrics.score(
        "dawdler", reference, rollout(Dawdler(), reference.instances, max_steps=reference.max_steps)
    )
    assert dawdled.flowtime_increase.mean == pytest.approx((2 / 4 + 2 / 1 + 6 / 3 + 0) / 4)
    assert dawdled.flowtime_increase_solved.mean == pytest.approx((2 / 4 + 2 / 1 + 0) / 3)


def test_a_time_limit_is_rounded_up_and_never_zero():
    reference = ReferenceSet.prepare(corridor((0, 5), (2, 2)), w=1.0, timeout=1.5, threads=1)
    assert reference.max_steps.tolist() == [8, 1]


def test_cases_that_the_expert_does_not_solve_are_counted_and_left_out():
    cases = corridor((0, 4), (1, 2), (3, 0))
    swap = Instance(np.zeros((1, 2), bool), [[0, 0], [0, 1]], [[0, 1], [0, 0]])
    with pytest.raises(ValueError, match="solved none of the 1 cases"):
        ReferenceSet.prepare([swap], w=1.0, timeout=3.0, threads=1)
    pairs = [swap, Instance(np.zeros((1, 2), bool), [[0, 0], [0, 1]], [[0, 0], [0, 1]])]
    reference = ReferenceSet.prepare(pairs, w=1.0, timeout=3.0, threads=1)
    assert reference.unsolved == 1
    assert reference.instances == pairs[1:]
    assert ReferenceSet.prepare(cases, w=1.0, timeout=3.0, threads=1).unsolved == 0


def test_lacam_plans_the_cases_where_ecbs_has_no_proof():
    crowd = random_instance(num_agents=30, density=0.3, seed=0)
    left = experts.solve(crowd, w=1.01, node_limit=500)
    assert left.solution is not None
    assert not left.solved
    reference = ReferenceSet.prepare([crowd], w=1.01, timeout=3.0, threads=1, nodes=500)
    plan = experts.lacam(crowd, node_limit=500).solution
    assert plan
    assert np.array_equal(reference.solutions[0].paths, plan.paths)


def test_the_solved_cases_do_not_depend_on_time(monkeypatch):
    asked = []
    solve = experts.solve_many
    monkeypatch.setattr(experts, "solve_many", lambda *cases, **how: (asked.append(how), solve(*cases, **how))[1])
    ReferenceSet.prepare(corridor((0, 4)), w=1.0, timeout=3.0, threads=1)
    assert asked[0]["time_limit"] == math.inf
    assert 0 < asked[0]["node_limit"] < math.inf


EXECUTIONS = [
    Execution(),
    Execution(actions="sampled", temperature=2.0),
    Execution(actions="stuck", shield="pibt", comm_range="connected", comm_weights="distance"),
]


@pytest.fixture(scope="module")
def compared():
    torch.manual_seed(0)
    policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2))
    family = Family(num_agents=(4, 4), height=(6, 6), width=(6, 6), density=(0.1, 0.1))
    cases = make_cases("test", seed=0, maps=5, cases_per_map=3, families=[family]).instances
    reference = ReferenceSet.prepare(cases, w=1.05, timeout=3.0, threads=1)
    phases = []
    rows, played = metrics.compare(reference, policy, EXECUTIONS, seed=3, progress=phases.append)
    return reference, policy, rows, played, phases


def test_the_comparison_has_a_row_for_each_variant_and_competitor(compared):
    reference, policy, rows, played, phases = compared
    competitors = ["random", "greedy*", "greedy,stuck*", "PIBT*", "expert*"]
    assert [row.name for row in rows] == [each.name for each in EXECUTIONS] + competitors
    assert list(metrics.BASELINES) == competitors
    assert phases == [row.name for row in rows[:-1]]  # the expert's row is there before
    assert phases == [row.name for row in rows[:-1]]  # the expert's row is there before
    settings = {"seed": 3, "max_steps": reference.max_steps}
    for execution, row, seen in zip(EXECUTIONS, rows, played, strict=False):
        again = rollout(policy, reference.instances, execution=execution, **settings)
        assert row == metrics.score(execution.name, reference, again)
        assert np.array_equal(seen.flowtime, again.flowtime)
    actors = [RandomActor(), GreedyActor(), GreedyActor(random_when_stuck=True)]
    for actor, row in zip(actors, rows[3:6], strict=True):
        assert row == metrics.score(row.name, reference, rollout(actor, reference.instances, **settings))


def test_a_policy_that_sees_the_cost_to_go_is_marked_as_one_that_knows_the_map(compared):
    reference = compared[0]
    policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2, extra_channels=("cost_to_go",)))
    rows, _ = metrics.compare(reference, policy, EXECUTIONS[:1])
    assert rows[0].name == "argmax*"


def test_pibt_is_measured_like_the_other_rows(compared):
    reference, _, rows, _, _ = compared
    increases, solved = [], 0
    for case, limit, base in zip(reference.instances, reference.max_steps, reference.flowtimes, strict=True):
        result = experts.pibt(case, max_steps=int(limit), seed=3)
        solved += result.solved
        flowtime = result.solution.sum_of_costs if result.solution else limit * case.num_agents
        increases.append(flowtime / base - 1)
    assert rows[6].success_rate.mean == solved / len(reference.instances)
    assert rows[6].flowtime_increase.mean == pytest.approx(np.mean(increases))


def test_the_expert_is_its_own_measure(compared):
    reference, _, rows, _, _ = compared
    expert = rows[7]
    assert (expert.success_rate.mean, expert.flowtime_increase.mean, expert.latched) == (1.0, 0.0, 1.0)
    assert expert.makespan.mean == pytest.approx(np.mean([each.makespan for each in reference.solutions]))
    assert all(base >= bound for base, bound in zip(reference.flowtimes, reference.lower_bounds, strict=True))
    assert (reference.flowtimes <= 1.05 * reference.lower_bounds + 1e-9).all()


def test_the_numbers_are_strict_json_also_where_nothing_was_solved(compared):
    reference, _, rows, _, _ = compared
    nothing = ReferenceSet.prepare(corridor((3, 0)), w=1.0, timeout=1.0, threads=1)
    lost = metrics.score("lost", nothing, rollout(Walker(), nothing.instances, max_steps=nothing.max_steps))
    for data in (metrics.as_json(rows, reference), metrics.as_json([lost], nothing)):
        assert json.loads(json.dumps(data, allow_nan=False)) == data
        assert "makespan" in json.dumps(data)
    (row,) = json.loads(json.dumps(metrics.as_json([lost], nothing)))["rows"]
    assert row["makespan"]["mean"] is None


def test_the_table_shows_every_figure_within_eighty_columns(compared):
    reference, _, rows, _, _ = compared
    shown = io.StringIO()
    Console(file=shown, width=80).print(evaluation_tables.success_table("teams", metrics.as_json(rows, reference)))
    text = shown.getvalue()
    assert "…" not in text
    for row in rows:
        assert row.name in text or row.name == EXECUTIONS[2].name
        assert f"{row.success_rate.mean:.3f}" in text
        assert f"[{row.success_rate.low:.3f}, {row.success_rate.high:.3f}]" in text
        assert f"{row.flowtime_increase.mean:+.1%}" in text
        assert f"{row.makespan.mean:.1f}" in text or math.isnan(row.makespan.mean)


def test_wilson_narrows_with_more_cases():
    widths = [(e.high - e.low) for n in (10, 100, 1000) for e in [Estimate.proportion(np.arange(n) % 10 != 0)]]
    assert all(one > two for one, two in pairwise(widths))


def test_a_lifelong_comparison_is_the_throughput_of_every_row(compared):
    reference, policy, _, _, _ = compared
    phases = []
    table, played = metrics.compare_lifelong(
        reference.instances, policy, EXECUTIONS, steps=30, seed=3, progress=phases.append
    )
    names = [*(each.name for each in EXECUTIONS), "random", "greedy*", "PIBT*"]
    assert [row["name"] for row in table["rows"]] == phases == names
    assert (table["cases"], table["steps"]) == (len(reference.instances), 30)
    players = [*((policy, each) for each in EXECUTIONS), *((each, None) for each in LIFELONG_BASELINES.values())]
    for row, (player, execution) in zip(table["rows"], players, strict=True):
        again = rollout(player, reference.instances, task="lifelong", execution=execution, seed=3, max_steps=30)
        assert row["throughput"]["mean"] == again.throughput.mean()
        assert all(len(each.paths) == 31 for each in again.solutions), "a lifelong team never ends before"
    for execution, seen in zip(EXECUTIONS, played, strict=True):
        again = rollout(policy, reference.instances, task="lifelong", execution=execution, seed=3, max_steps=30)
        assert np.array_equal(seen.throughput, again.throughput)
    assert json.loads(json.dumps(table, allow_nan=False)) == table
    shown = io.StringIO()
    Console(file=shown, width=80).print(evaluation_tables.lifelong_table("teams", table))
    for row in table["rows"]:
        assert f"{row['throughput']['mean']:.3f}" in shown.getvalue()


def test_throughput_by_hand():
    """An arrival is a step that ends on the goal that the robot had when it began."""
    table, _ = metrics.compare_lifelong(corridor((0, 4)), compared_policy(), [Execution()], steps=40, seed=0)
    greedy = rollout(GreedyActor(), corridor((0, 4)), task="lifelong", max_steps=40, seed=0)
    arrivals = sum(
        bool((cells == goals).all())
        for cells, goals in zip(greedy.solutions[0].paths[1:], greedy.goals[0][:-1], strict=True)
    )
    row = next(row for row in table["rows"] if row["name"] == "greedy*")
    assert row["throughput"]["mean"] == pytest.approx(arrivals / 40)
    assert arrivals > 3


def compared_policy():
    torch.manual_seed(0)
    return DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2))
