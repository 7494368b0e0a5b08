import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import experts
import plan_oracles
import strategies
from experts import FoundBy, Status
from mapf_env import Instance, Maze, random_instance

seeds = st.integers(0, 2**64 - 1)
CORRIDOR = Instance(np.zeros((1, 4), bool), [(0, 0), (0, 3)], [(0, 3), (0, 0)])


def require_plan(instance: Instance, result: experts.Result) -> None:
    assert result.status is Status.SOLVED
    assert result.solution is not None
    assert plan_oracles.faults(instance.grid, instance.starts, instance.goals, result.solution.paths) == []
    assert result.cost == plan_oracles.sum_of_costs(result.solution.paths) >= result.lower_bound


@settings(deadline=None, max_examples=150)
@given(strategies.instances(max_side=3, max_agents=3), seeds)
def test_lacam_is_complete(instance: Instance, seed: int) -> None:
    result = experts.lacam(instance, seed=seed)
    if plan_oracles.optimal_cost(instance.grid, instance.starts, instance.goals) is None:
        assert result.status is Status.INFEASIBLE
    else:
        require_plan(instance, result)


@settings(deadline=None, max_examples=150)
@given(strategies.instances(max_side=6, max_agents=12), seeds)
def test_plans_have_no_conflicts(instance: Instance, seed: int) -> None:
    quick = experts.lacam(instance, seed=seed, node_limit=2_000)
    if quick.solved:
        require_plan(instance, quick)
    ordered = experts.prioritised(instance, seed=seed, max_orders=10)
    if ordered.solved:
        require_plan(instance, ordered)
        assert ordered.expansions <= 10
    else:
        assert ordered.status is Status.NODE_LIMIT
        assert ordered.expansions == 10


def test_lacam_with_many_robots_improves_its_plan() -> None:
    instance = random_instance(height=48, width=48, num_agents=150, seed=0)
    first = experts.lacam(instance)
    better = experts.lacam(instance, w=1.15)
    require_plan(instance, first)
    require_plan(instance, better)
    assert first.cost is not None
    assert better.cost is not None
    assert better.cost <= 1.15 * better.lower_bound < first.cost


@pytest.mark.parametrize(
    ("style", "density", "num_agents"),
    [(Maze(), 0.0, 32), (Maze(), 0.0, 64), (Maze(loops=0.3), 0.0, 64), ("cells", 0.3, 64)],
)
def test_lacam_solves_every_crowd(style: Maze | str, density: float, num_agents: int) -> None:
    for seed in range(8):
        crowd = random_instance(height=21, width=21, num_agents=num_agents, style=style, density=density, seed=seed)  # pyright: ignore[reportArgumentType]
        result = experts.lacam(crowd, node_limit=200_000, time_limit=math.inf)
        require_plan(crowd, result)
        assert result.found_by is FoundBy.LACAM


def test_a_long_plan_is_improved() -> None:
    crowd = random_instance(height=21, width=21, num_agents=48, style=Maze(), seed=0)
    first, better = experts.lacam(crowd), experts.lacam(crowd, w=1, time_limit=0.5)
    require_plan(crowd, first)
    require_plan(crowd, better)
    assert better.found_by is FoundBy.IMPROVEMENT
    assert first.solution is not None
    assert better.solution is not None
    assert better.solution.sum_of_costs < 0.9 * first.solution.sum_of_costs


def test_the_node_limit_also_bounds_the_tries() -> None:
    """Robots that fill a corridor have no move but many constraints on one."""
    full = Instance(np.zeros((1, 12), bool), [(0, col) for col in range(12)], [(0, 11 - col) for col in range(12)])
    result = experts.lacam(full, node_limit=500, time_limit=math.inf)
    assert result.status is Status.NODE_LIMIT
    assert result.generated < 500
    assert result.expansions == 2_000


def test_a_large_map() -> None:
    instance = random_instance(height=256, width=256, num_agents=200, seed=0)
    require_plan(instance, experts.lacam(instance))


def test_the_bound_of_a_very_long_way_is_its_length() -> None:
    long = Instance(np.zeros((1, 40_000), bool), [(0, 0)], [(0, 39_999)])
    result = experts.lacam(long)
    assert (result.cost, result.lower_bound) == (39_999, 39_999)
    require_plan(long, result)


def test_improvement_ends_with_the_time() -> None:
    instance = random_instance(height=32, width=32, density=0.2, num_agents=120, seed=0)
    begin = time.process_time()  # other processes on the core do not count
    result = experts.lacam(instance, w=1, time_limit=1)
    assert time.process_time() - begin < 1.5
    require_plan(instance, result)


def test_equal_seeds_give_equal_plans() -> None:
    instance = random_instance(num_agents=40, seed=2)
    for solver in (experts.lacam, experts.prioritised):
        one, same = solver(instance, seed=5).solution, solver(instance, seed=5).solution
        assert one is not None
        assert same is not None
        np.testing.assert_array_equal(one.paths, same.paths)


def test_corridors() -> None:
    assert experts.lacam(CORRIDOR).status is Status.INFEASIBLE
    assert experts.prioritised(CORRIDOR).status is Status.NODE_LIMIT
    assert experts.lacam(random_instance(num_agents=50, seed=0), node_limit=3).status is Status.NODE_LIMIT


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="w must be"):
        experts.lacam(CORRIDOR, w=0.5)
    with pytest.raises(ValueError, match="time_limit"):
        experts.lacam(CORRIDOR, time_limit=0)
    with pytest.raises(ValueError, match="max_orders"):
        experts.prioritised(CORRIDOR, max_orders=0)
    with pytest.raises(TypeError, match="instance must be"):
        experts.lacam("map")  # pyright: ignore[reportArgumentType]
    assert experts.prioritised(random_instance(seed=0), time_limit=math.inf).solved
