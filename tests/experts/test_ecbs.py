import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import experts
import plan_oracles
import strategies
from experts import FoundBy, Result, Status
from mapf_env import Instance, Maze, random_instance

CORRIDOR = Instance(np.zeros((1, 5), bool), [(0, 0), (0, 4)], [(0, 4), (0, 0)])
MOST_OVERRUN = 0.2  # CPU seconds
FACTORS = st.sampled_from([1.0, 1.05, 1.2, 1.5, 3.0])
small = settings(deadline=None, max_examples=150)


def require_solution(instance: Instance, result: Result) -> None:
    assert result.status is Status.SOLVED
    assert result.solved
    assert result.solution is not None
    paths = result.solution.paths
    assert plan_oracles.faults(instance.grid, instance.starts, instance.goals, paths) == []
    assert result.cost == plan_oracles.sum_of_costs(paths) == result.solution.sum_of_costs
    assert result.lower_bound <= result.solution.sum_of_costs


def require_plan_without_proof(instance: Instance, result: Result, w: float, limit: Status) -> None:
    assert result.status is limit
    assert not result.solved
    assert result.solution is not None
    paths = result.solution.paths
    assert plan_oracles.faults(instance.grid, instance.starts, instance.goals, paths) == []
    assert result.cost == plan_oracles.sum_of_costs(paths) > w * result.lower_bound
    assert result.found_by is not None


def outcome(result: Result) -> tuple[object, ...]:
    paths = None if result.solution is None else result.solution.paths.tolist()
    return result.status, paths, result.cost, result.lower_bound, result.expansions, result.generated


@small
@given(strategies.instances(max_side=5, max_agents=3))
def test_w_1_is_optimal(instance: Instance) -> None:
    optimum = plan_oracles.optimal_cost(instance.grid, instance.starts, instance.goals)
    result = experts.solve(instance, w=1, node_limit=20_000)
    if optimum is None:
        assert not result.solved
    else:
        assert result.status is not Status.INFEASIBLE
        assert result.lower_bound <= optimum
    if result.solved:
        require_solution(instance, result)
        assert result.cost == optimum == result.lower_bound


@pytest.mark.parametrize("seed", range(12))
def test_w_1_is_optimal_with_four_robots(seed: int) -> None:
    instance = random_instance(height=4, width=4, density=0.15, num_agents=4, seed=seed)
    result = experts.solve(instance, w=1)
    require_solution(instance, result)
    assert result.cost == plan_oracles.optimal_cost(instance.grid, instance.starts, instance.goals)


@small
@given(strategies.instances(max_side=4, min_agents=2, max_agents=3), FACTORS, st.integers(0, 2**64 - 1))
def test_bounds_hold(instance: Instance, w: float, seed: int) -> None:
    optimum = plan_oracles.optimal_cost(instance.grid, instance.starts, instance.goals)
    result = experts.solve(instance, w=w, seed=seed, node_limit=5_000)
    if optimum is None:
        assert result.solution is None
        return
    assert result.lower_bound <= optimum
    if result.solved:
        require_solution(instance, result)
        assert result.cost is not None
        assert result.cost <= w * result.lower_bound
        assert optimum <= result.cost <= w * optimum


@pytest.mark.parametrize("num_agents", [10, 30, 40])
@pytest.mark.parametrize("w", [1.05, 1.3])
def test_larger_teams(num_agents: int, w: float) -> None:
    instances = [random_instance(num_agents=num_agents, seed=seed) for seed in range(20)]
    results = experts.solve_many(instances, w=w, node_limit=3_000)
    assert sum(result.solved for result in results) >= 16
    for instance, result in zip(instances, results, strict=True):
        if result.solved:
            require_solution(instance, result)
            assert result.cost is not None
            assert result.cost <= w * result.lower_bound


def test_a_large_map() -> None:
    instance = random_instance(height=256, width=256, num_agents=20, seed=1)
    require_solution(instance, experts.solve(instance, w=1.2))


def test_results_do_not_depend_on_threads_or_repetition() -> None:
    instances = [random_instance(num_agents=n, seed=seed) for n in (4, 25, 40) for seed in range(10)]
    once = [outcome(r) for r in experts.solve_many(instances, node_limit=500, seed=3)]
    assert once == [outcome(r) for r in experts.solve_many(instances, node_limit=500, seed=3)]
    assert once == [outcome(r) for r in experts.solve_many(instances, node_limit=500, seed=3, threads=2)]
    assert once == [outcome(experts.solve(i, node_limit=500, seed=3)) for i in instances]
    assert once != [outcome(r) for r in experts.solve_many(instances, node_limit=500, seed=4)]


def test_no_instances() -> None:
    assert experts.solve_many([], threads=2) == []


def test_robots_on_their_goals_cost_nothing() -> None:
    cells = [(0, 0), (1, 1), (2, 2)]
    result = experts.solve(Instance(np.zeros((3, 3), bool), cells, cells))
    assert (result.cost, result.lower_bound, result.expansions) == (0, 0, 0)
    assert result.solution is not None
    assert result.solution.paths.tolist() == [[list(cell) for cell in cells]]


def test_a_robot_leaves_its_goal_and_pays_for_coming_back() -> None:
    grid = np.array([[0, 0, 0, 0, 0], [1, 1, 0, 1, 1]], bool)
    instance = Instance(grid, [(0, 2), (0, 0)], [(0, 2), (0, 4)])
    result = experts.solve(instance, w=1)
    require_solution(instance, result)
    assert result.cost == plan_oracles.optimal_cost(grid, instance.starts, instance.goals) == 7
    assert result.solution is not None
    assert result.solution.arrival_times.tolist() == [3, 4]


def test_a_swap_in_a_corridor_is_proved_infeasible() -> None:
    result = experts.solve(CORRIDOR)
    assert result.status is Status.INFEASIBLE
    assert not result.solved
    assert result.cost is None


def test_only_a_wrong_order_in_a_corridor_is_a_proof() -> None:
    crowd = random_instance(height=6, width=8, num_agents=14, seed=1)
    grid = np.vstack([crowd.grid, np.ones((1, 8), bool), np.zeros((1, 8), bool)])
    starts, goals = [(7, 0), (7, 1), (7, 4)], [(7, 2), (7, 4), (7, 5)]
    instance = Instance(grid, [*crowd.starts.tolist(), *starts], [*crowd.goals.tolist(), *goals])
    result = experts.solve(instance, w=1, node_limit=300)
    assert result.expansions > 64
    assert result.status is not Status.INFEASIBLE
    instance = Instance(grid, [*crowd.starts.tolist(), *starts], [*crowd.goals.tolist(), *reversed(goals)])
    assert experts.solve(instance, w=1).status is Status.INFEASIBLE


def test_an_unprovable_infeasible_instance_ends_at_a_limit() -> None:
    cells = [(0, 0), (0, 1), (1, 1), (1, 0)]
    instance = Instance(np.zeros((2, 2), bool), cells, [cells[1], cells[0], *cells[2:]])
    assert plan_oracles.optimal_cost(instance.grid, instance.starts, instance.goals) is None
    assert experts.solve(instance, w=1, node_limit=1_000).status is Status.NODE_LIMIT
    assert experts.solve(instance, w=1, time_limit=0.05).status is Status.TIME_LIMIT
    assert experts.solve(instance).status is Status.INFEASIBLE, "LaCAM sees all joint states"


def test_a_hard_case_asks_the_complete_search() -> None:
    grid = np.array([[1, 0, 0], [0, 0, 0]], bool)
    instance = Instance(grid, [(1, 0), (1, 2), (0, 1), (0, 2)], [(1, 0), (1, 1), (1, 2), (0, 2)])
    assert plan_oracles.optimal_cost(grid, instance.starts, instance.goals) == 28
    result = experts.solve(instance, w=100)
    require_solution(instance, result)
    assert result.found_by in (FoundBy.LACAM, FoundBy.IMPROVEMENT)
    assert result.cost is not None
    assert 28 <= result.cost <= 100 * result.lower_bound
    assert result.seconds < 1


@small
@given(strategies.instances(max_side=5, min_agents=2, max_agents=10), st.sampled_from([1.05, 1.5, 3.0, 20.0]))
def test_instances_that_lacam_solves_within_the_bound_never_end_at_the_node_limit(instance: Instance, w: float) -> None:
    result, lacam = experts.solve(instance, w=w, node_limit=200), experts.lacam(instance, node_limit=200)
    if not result.solved and lacam.cost is not None:
        assert lacam.cost > w * result.lower_bound
    if lacam.solved:
        assert result.solution is not None
    assert (result.found_by is None) == (result.solution is None)


@small
@given(
    strategies.instances(max_side=5, min_agents=2, max_agents=8),
    FACTORS,
    st.integers(1, 40),
    st.integers(0, 2**64 - 1),
)
def test_a_plan_at_the_node_limit_has_no_conflicts_and_costs_more_than_the_bound(
    instance: Instance, w: float, node_limit: int, seed: int
) -> None:
    result = experts.solve(instance, w=w, node_limit=node_limit, seed=seed)
    if result.solved:
        require_solution(instance, result)
        assert result.cost is not None
        assert result.cost <= w * result.lower_bound
    elif result.solution is not None:
        require_plan_without_proof(instance, result, w, Status.NODE_LIMIT)
    else:
        assert (result.cost, result.found_by) == (None, None)
    assert outcome(result) == outcome(experts.solve(instance, w=w, node_limit=node_limit, seed=seed))


def test_every_search_can_find_the_plan_without_a_proof() -> None:
    instances = [
        random_instance(height=4 + seed % 3, width=4 + seed % 2, density=0.15, num_agents=3 + seed % 6, seed=seed)
        for seed in range(120)
    ]
    found = set()
    for w in (1.0, 1.05):
        for node_limit in (5, 30, 200):
            for instance, result in zip(
                instances, experts.solve_many(instances, w=w, node_limit=node_limit), strict=True
            ):
                if result.solution is not None and not result.solved:
                    require_plan_without_proof(instance, result, w, Status.NODE_LIMIT)
                    found.add(result.found_by)
    assert found == {FoundBy.ECBS, FoundBy.REPAIR, FoundBy.PROOF, FoundBy.IMPROVEMENT}


def test_crowds_that_cannot_be_proved_have_a_plan() -> None:
    crowds = [random_instance(height=21, width=21, num_agents=64, style=Maze(), seed=seed) for seed in (0, 5)]
    results = experts.solve_many(crowds, w=2, node_limit=300, time_limit=math.inf)
    for crowd, result in zip(crowds, results, strict=True):
        require_plan_without_proof(crowd, result, 2, Status.NODE_LIMIT)
    again = experts.solve_many(crowds, w=2, node_limit=300, time_limit=math.inf, threads=2)
    assert [outcome(result) for result in again] == [outcome(result) for result in results]


def test_the_plan_is_there_when_time_is_up() -> None:
    crowd = random_instance(num_agents=40, density=0.3, seed=0)
    result = experts.solve(crowd, w=1.01, time_limit=1)  # the first plan takes milliseconds, the proof minutes
    require_plan_without_proof(crowd, result, 1.01, Status.TIME_LIMIT)


@pytest.mark.parametrize("num_agents", [32, 64])
def test_crowds_in_mazes_are_solved_within_twice_the_bound(num_agents: int) -> None:
    for seed in range(6):
        crowd = random_instance(height=21, width=21, num_agents=num_agents, style=Maze(loops=0.3), seed=seed)
        result = experts.solve(crowd, w=2)
        require_solution(crowd, result)
        assert result.cost is not None
        assert result.cost <= 2 * result.lower_bound


def test_the_node_limit_bounds_the_nodes() -> None:
    instance = random_instance(num_agents=60, density=0.2, seed=4)
    result = experts.solve(instance, w=1, node_limit=100)
    assert result.status is Status.NODE_LIMIT
    assert result.generated <= 101
    assert result.lower_bound > 0


@pytest.mark.parametrize("side", [20, 256])
def test_the_time_limit_holds(side: int) -> None:
    instance = random_instance(height=side, width=side, density=0.2, num_agents=4 * side, seed=0)
    begin = time.process_time()  # other processes on the core do not count
    result = experts.solve(instance, w=1, time_limit=0.2, node_limit=10**9)
    assert result.status is Status.TIME_LIMIT
    assert time.process_time() - begin < 0.2 + MOST_OVERRUN


def test_the_time_limit_holds_where_one_robot_has_to_wait_very_long_for_another() -> None:
    half = 200
    grid = np.zeros((2 * half + 1, 2 * half + 1), bool)
    grid[:, half] = True
    grid[half, half] = False
    gate = Instance(grid, [(half, half - 1), (half, 0)], [(half, half), (half, 2 * half)])
    begin = time.process_time()
    result = experts.solve(gate, w=1, time_limit=0.1)
    assert result.status is Status.TIME_LIMIT
    assert time.process_time() - begin < 0.1 + MOST_OVERRUN


@pytest.mark.parametrize(
    ("argument", "value", "error"),
    [
        ("w", 0.99, ValueError),
        ("w", math.nan, ValueError),
        ("w", math.inf, ValueError),
        ("w", "1.2", TypeError),
        ("w", 10**400, ValueError),
        ("time_limit", 0, ValueError),
        ("time_limit", -1.0, ValueError),
        ("time_limit", math.nan, ValueError),
        ("time_limit", None, TypeError),
        ("node_limit", 0, ValueError),
        ("node_limit", 10.0, TypeError),
        ("node_limit", True, TypeError),
        ("threads", 0, ValueError),
        ("threads", 10**6, ValueError),
        ("threads", 1.5, TypeError),
        ("seed", -1, ValueError),
        ("seed", 2**64, ValueError),
        ("seed", "a", TypeError),
    ],
)
def test_bad_arguments_are_named(argument: str, value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match=argument):
        experts.solve_many([CORRIDOR], **{argument: value})  # pyright: ignore[reportArgumentType]


def test_other_types_are_not_instances() -> None:
    with pytest.raises(TypeError, match=r"instances\[1\] must be a mapf_env.Instance, got int"):
        experts.solve_many([CORRIDOR, 7])  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"instance must be a mapf_env.Instance, got str"):
        experts.solve("map")  # pyright: ignore[reportArgumentType]


def test_infinite_limits_are_allowed() -> None:
    assert experts.solve(random_instance(seed=0), time_limit=math.inf, w=1e300).solved
    crowd = random_instance(num_agents=60, density=0.2, seed=4)
    assert experts.solve(crowd, w=1e300).solved
    home = Instance(np.zeros((2, 2), bool), [(0, 0)], [(0, 0)])
    assert experts.lacam(home).cost == 0


def test_a_way_that_is_too_long_to_be_counted_is_refused() -> None:
    rows = np.zeros((365, 365), bool)
    rows[1::2] = True
    rows[1::4, -1] = rows[3::4, 0] = False  # one way through all rows, there and back
    near = Instance(rows, [(0, 0)], [(0, 1)])
    with pytest.raises(ValueError, match="a shortest path on this map is longer than 65533 steps"):
        experts.solve(near)
    assert experts.lacam(near).cost == 1
