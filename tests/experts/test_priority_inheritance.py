import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import experts
import plan_oracles
import strategies
from experts import Status
from mapf_env import Instance, Maze, random_instance


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


@settings(deadline=None, max_examples=200)
@given(strategies.instances(max_side=5, max_agents=12), st.integers(0, 2**64 - 1))
def test_plans_with_swaps_have_no_conflicts(instance: Instance, seed: int) -> None:
    result = experts.pibt(instance, swap=True, max_steps=100, seed=seed)
    if result.solution is not None:
        assert plan_oracles.faults(instance.grid, instance.starts, instance.goals, result.solution.paths) == []


def test_robots_change_places_in_a_corridor_with_one_branch() -> None:
    grid = np.array([[0] * 9, [1, 0, *[1] * 7]], bool)
    facing = Instance(grid, [(0, 3), (0, 8)], [(0, 8), (0, 3)])
    for seed in range(10):
        assert experts.pibt(facing, seed=seed).status is Status.STEP_LIMIT
        assert experts.pibt(facing, swap=True, seed=seed).solved


def test_swaps_solve_crowds_that_are_stuck_without_them() -> None:
    crowds = [random_instance(height=21, width=21, num_agents=16, style=Maze(), seed=seed) for seed in range(20)]
    plain, swap = (sum(experts.pibt(crowd, swap=swap).solved for crowd in crowds) for swap in (False, True))
    assert plain <= 5
    assert swap >= 18


def test_without_swap_plans_are_those_of_earlier_versions() -> None:
    """The digest is that of the version before swaps were added."""
    digest = hashlib.sha256()
    for seed in range(10):
        for num_agents in (5, 20, 60):
            instance = random_instance(num_agents=num_agents, density=0.2, seed=seed)
            result = experts.pibt(instance, max_steps=100, seed=seed)
            digest.update(repr((str(result.status), result.cost, result.expansions)).encode())
            if result.solution is not None:
                digest.update(result.solution.paths.astype("<i4").tobytes())
    assert digest.hexdigest() == "26105728259db5c0d4c540062327d1aa19958327b1f22b47ac223e5bc6912df4"


def test_bad_arguments_are_named() -> None:
    instance = random_instance(seed=0)
    with pytest.raises(ValueError, match="max_steps"):
        experts.pibt(instance, max_steps=0)
    with pytest.raises(TypeError, match="swap"):
        experts.pibt(instance, swap=1)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="seed"):
        experts.pibt(instance, seed=-1)
    with pytest.raises(TypeError, match="instance must be"):
        experts.pibt([instance])  # pyright: ignore[reportArgumentType]
