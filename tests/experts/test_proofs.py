"""Optimality, bounds and plans of the searches for hard instances, checked by plain Python."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import experts
import plan_oracles
import strategies
from experts import Status
from mapf_env import Instance, random_instance

# Narrow maps: every conflict is a corridor, a blocked goal or both.
narrow = st.sampled_from(
    ["...\n.@.\n...", ".....\n@.@.@", "....\n.@@.\n....", "..@..\n.....\n..@..", ".@.\n...\n.@.\n..."]
)


@st.composite
def narrow_instances(draw: st.DrawFn) -> Instance:
    grid = np.array([[cell == "@" for cell in row] for row in draw(narrow).split("\n")])
    free = np.argwhere(~grid).tolist()
    count = draw(st.integers(2, 4))
    return Instance(grid, draw(st.permutations(free))[:count], draw(st.permutations(free))[:count])


@settings(deadline=None, max_examples=120)
@given(st.one_of(narrow_instances(), strategies.instances(max_side=4, min_agents=3, max_agents=4)), st.booleans())
def test_hard_small_instances(instance: Instance, optimal: bool) -> None:
    optimum = plan_oracles.optimal_cost(instance.grid, instance.starts, instance.goals)
    w = 1.0 if optimal else 1.1
    result = experts.solve(instance, w=w, node_limit=2_000)
    if optimum is None:
        assert result.solution is None
        return
    assert result.status is not Status.INFEASIBLE
    assert result.lower_bound <= optimum
    if result.solution is None:
        assert not result.solved
        return
    assert plan_oracles.faults(instance.grid, instance.starts, instance.goals, result.solution.paths) == []
    assert result.cost is not None
    assert result.cost == plan_oracles.sum_of_costs(result.solution.paths)
    assert optimum <= result.cost
    assert result.solved == (result.cost <= w * result.lower_bound)


@pytest.mark.parametrize("w", [1.0, 1.02, 1.2])
def test_crowds_are_solved_within_their_bound(w: float) -> None:
    instances = [random_instance(num_agents=30, seed=seed) for seed in range(20)]
    results = experts.solve_many(instances, w=w, node_limit=20_000)
    assert sum(result.solved for result in results) >= 19
    for instance, result in zip(instances, results, strict=True):
        if result.solution is not None and result.cost is not None:
            assert plan_oracles.faults(instance.grid, instance.starts, instance.goals, result.solution.paths) == []
            assert result.solved == (result.cost <= w * result.lower_bound)


def test_factors_agree_about_the_optimum() -> None:
    for seed in range(20):
        instance = random_instance(num_agents=20, seed=seed)
        optimum = experts.solve(instance, w=1).cost
        near = experts.solve(instance, w=1.01)
        assert optimum is not None
        assert near.cost is not None
        assert near.lower_bound <= optimum <= near.cost <= 1.01 * near.lower_bound
