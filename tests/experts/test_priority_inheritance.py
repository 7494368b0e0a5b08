import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import experts
import plan_oracles
import strategies
from experts import Status
from mapf_env import Instance, random_instance


@settings(deadline=None, max_examples=200)
@given(strategies.instances(max_side=5, max_agents=12), st.integers(0, 2**64 - 1))
def test_plans_have_no_conflicts(instance: Instance, seed: int) -> None:
    result = experts.pibt(instance, max_steps=100, seed=seed)
    assert result.lower_bound >= 0
    if result.solution is None:
        assert result.status is Status.STEP_LIMIT
        assert result.cost is None
        assert result.expansions == 100
        return
    assert result.status is Status.SOLVED
    assert plan_oracles.faults(instance.grid, instance.starts, instance.goals, result.solution.paths) == []
    assert result.cost == plan_oracles.sum_of_costs(result.solution.paths) >= result.lower_bound
    assert len(result.solution.paths) == result.expansions + 1


def test_almost_all_random_teams_arrive() -> None:
    results = [experts.pibt(random_instance(num_agents=14, seed=seed), seed=seed) for seed in range(100)]
    assert sum(result.solved for result in results) >= 97


def test_a_crowd() -> None:
    instance = random_instance(height=40, width=40, num_agents=200, seed=0)
    result = experts.pibt(instance, max_steps=5_000)
    assert result.solution is not None
    assert plan_oracles.faults(instance.grid, instance.starts, instance.goals, result.solution.paths) == []


def test_equal_seeds_give_equal_plans() -> None:
    instance = random_instance(num_agents=30, seed=2)
    plans = [experts.pibt(instance, seed=seed).solution for seed in (5, 5, 6)]
    assert all(plan is not None for plan in plans)
    one, same, other = (plan.paths for plan in plans if plan is not None)
    np.testing.assert_array_equal(one, same)
    assert one.shape != other.shape or (one != other).any()


def test_a_corridor_ends_at_the_step_limit() -> None:
    corridor = Instance(np.zeros((1, 4), bool), [(0, 0), (0, 3)], [(0, 3), (0, 0)])
    assert experts.pibt(corridor, max_steps=50).status is Status.STEP_LIMIT


def test_bad_arguments_are_named() -> None:
    instance = random_instance(seed=0)
    with pytest.raises(ValueError, match="max_steps"):
        experts.pibt(instance, max_steps=0)
    with pytest.raises(ValueError, match="seed"):
        experts.pibt(instance, seed=-1)
    with pytest.raises(TypeError, match="instance must be"):
        experts.pibt([instance])  # pyright: ignore[reportArgumentType]
