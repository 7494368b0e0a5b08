import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import experts
from experts import Result, Status, many
from mapf_env import Instance, Solution, random_instance

INSTANCES = [random_instance(num_agents=8, seed=seed) for seed in range(30)]
IMPOSSIBLE = Instance(np.zeros((1, 3), bool), [(0, 0), (0, 2)], [(0, 2), (0, 0)])


def stays(instance: Instance) -> Result:
    """A solver that moves nobody."""
    return Result.of(Solution(np.stack([instance.starts] * 3)))


class Jumper:
    """A solver that is an object and moves robots from start to goal in one step."""

    def __call__(self, instance: Instance) -> Result:
        return Result.of(Solution(np.stack([instance.starts, instance.goals])))


def elsewhere(instance: Instance, shift: int) -> Result:
    """A solver that begins in the wrong cells."""
    return Result.of(Solution(np.stack([np.roll(instance.starts, shift, axis=0), instance.goals])))


def through_walls(instance: Instance) -> Result:
    """A solver that does not see obstacles and lets robots pass through each other."""
    open_map = Instance(np.zeros_like(instance.grid), instance.starts, instance.goals)
    return Result.of(experts.pibt(open_map).solution or Solution(instance.starts[None]))


def costs(results: list[Result]) -> list[int | None]:
    return [result.cost for result in results]


def test_a_stream_is_the_list() -> None:
    expected = costs([experts.solve(instance) for instance in INSTANCES])
    assert costs(experts.solve_many(INSTANCES, threads=2)) == expected
    for threads in (1, 2):
        for backlog in (1, 7, 64):
            stream = experts.solve_stream(iter(INSTANCES), threads=threads, backlog=backlog)
            assert costs(list(stream)) == expected


@pytest.mark.parametrize("solver", ["ecbs", "lacam", partial(experts.lacam, seed=0)])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_slow_reader_holds_the_source_back(solver: experts.Solver | str, threads: int) -> None:
    taken = 0

    def endless() -> Iterator[Instance]:
        nonlocal taken
        while True:
            taken += 1
            yield INSTANCES[taken % len(INSTANCES)]

    stream = experts.solve_stream(endless(), solver=solver, threads=threads, backlog=4)
    for read in range(1, 12):
        assert next(stream).solved
        assert taken <= read + 4


@pytest.mark.parametrize("threads", [1, 2])
def test_solvers_of_all_kinds(threads: int) -> None:
    for name, alone in (("lacam", experts.lacam), ("prioritised", experts.prioritised), ("pibt", experts.pibt)):
        expected = costs([alone(instance) for instance in INSTANCES])
        assert costs(experts.solve_many(INSTANCES, solver=name, threads=threads)) == expected
        assert costs(experts.solve_many(INSTANCES, solver=alone, threads=threads)) == expected


@pytest.mark.parametrize("threads", [1, 2])
def test_w_reaches_the_solvers_that_have_one(threads: int) -> None:
    assert len({tuple(costs([experts.lacam(each, w=w) for each in INSTANCES])) for w in (1.05, math.inf)}) == 2
    for name, alone in (("ecbs", experts.solve), ("lacam", experts.lacam)):
        for w in (1.05, 1.3):
            expected = costs([alone(instance, w=w) for instance in INSTANCES])
            assert costs(experts.solve_many(INSTANCES, solver=name, w=w, threads=threads)) == expected
    first = costs([experts.lacam(instance) for instance in INSTANCES])
    assert costs(experts.solve_many(INSTANCES, solver="lacam", w=math.inf, threads=threads)) == first


def test_solvers_without_a_w_refuse_one() -> None:
    for name in ("prioritised", "pibt"):
        with pytest.raises(ValueError, match=f"the solver '{name}' has no w"):
            experts.solve_stream(INSTANCES, solver=name, w=1.05)
    with pytest.raises(ValueError, match=r"w is an option of named solvers: .* functools.partial"):
        experts.solve_stream(INSTANCES, solver=experts.lacam, w=1.05)
    for name in ("ecbs", "lacam"):
        with pytest.raises(ValueError, match="w must be"):
            experts.solve_stream(INSTANCES, solver=name, w=0.9)


def test_a_solver_of_your_own() -> None:
    def stay(instance: Instance) -> Result:
        return Result.of(Solution(instance.starts[None]), lower_bound=0)

    home = Instance(np.zeros((2, 2), bool), [(0, 0)], [(0, 0)])
    (result,) = experts.solve_many([home], solver=stay)
    assert (result.status, result.cost, result.solved) == (Status.SOLVED, 0, True)
    with pytest.raises(ValueError, match="lower_bound must be at most 0, got 1"):
        Result.of(Solution(home.starts[None]), lower_bound=1)
    for threads in (1, 2):
        with pytest.raises(TypeError, match=r"must return an experts.Result, got NoneType"):
            experts.solve_many([home], solver=lambda _: None, threads=threads)  # pyright: ignore[reportArgumentType]


def test_unsolved_cases_and_progress_are_reported() -> None:
    told: list[tuple[int, int]] = []
    mixed = [INSTANCES[0], IMPOSSIBLE, INSTANCES[1]]
    results = experts.solve_many(mixed, threads=2, progress=lambda done, solved: told.append((done, solved)))
    assert [result.status for result in results] == [Status.SOLVED, Status.INFEASIBLE, Status.SOLVED]
    assert told == [(1, 1), (2, 1), (3, 2)]


def test_progress_is_reported_during_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    solved: list[int] = []
    solve_batch = many.solve_batch
    monkeypatch.setattr(
        many, "solve_batch", lambda batch, **how: (solved.append(len(batch)), solve_batch(batch, **how))[1]
    )
    when: list[int] = []
    experts.solve_many([INSTANCES[0]] * 150, progress=lambda done, _: when.append(len(solved)))
    assert when == [1] * 64 + [2] * 64 + [3] * 22


def test_arguments_are_checked_before_the_first_result() -> None:
    with pytest.raises(ValueError, match="solver must be one of ecbs, lacam, prioritised, pibt"):
        experts.solve_stream(INSTANCES, solver="best")
    with pytest.raises(TypeError, match="solver must be one of"):
        experts.solve_stream(INSTANCES, solver=3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="backlog"):
        experts.solve_stream(INSTANCES, backlog=0)
    with pytest.raises(TypeError, match=r"instances\[1\] must be a mapf_env.Instance"):
        list(experts.solve_stream([INSTANCES[0], 7], solver="pibt"))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    ("solver", "said"),
    [
        (stays, r"solver \S*test_many\.stays .* agent 0 ends at \(\d+, \d+\), not .*, and \d+ more"),
        (Jumper(), r"solver \S*test_many\.Jumper .* agent 0 jumps in step 0, and \d+ more"),
        (partial(elsewhere, shift=1), r"solver \S*test_many\.elsewhere .* agent 0 starts at"),
        (through_walls, r"solver \S*test_many\.through_walls .* which is not a free cell"),
        (lambda _: Result.of(Solution(np.zeros((1, 1, 2), np.int32))), "1 paths for 8 agents"),
        (
            lambda instance: Result.of(Solution(np.stack([instance.starts, instance.starts[::-1], instance.goals]))),
            "jumps|conflict",
        ),
    ],
)
def test_plans_of_your_own_solver_are_audited(solver: experts.Solver, said: str, threads: int) -> None:
    instance = random_instance(num_agents=8, density=0.3, seed=3)
    for ask in (
        lambda: experts.audited(solver)(instance),
        lambda: experts.solve_many([instance], solver=solver, threads=threads),
        lambda: next(experts.solve_stream(iter([instance]), solver=solver, threads=threads)),
    ):
        with pytest.raises(ValueError, match=said):
            ask()


def test_a_sound_plan_passes_the_audit_and_so_does_the_lack_of_one() -> None:
    for instance in (INSTANCES[0], IMPOSSIBLE):
        expected, found = experts.lacam(instance), experts.audited(experts.lacam)(instance)
        assert (found.status, found.cost, found.lower_bound) == (expected.status, expected.cost, expected.lower_bound)


def test_a_conflict_alone_is_a_reason() -> None:
    swap = Instance(np.zeros((1, 2), bool), [(0, 0), (0, 1)], [(0, 1), (0, 0)])
    with pytest.raises(ValueError, match="do not solve the instance: swap conflict of agents 0 and 1"):
        experts.solve_many([swap], solver=Jumper())


def test_results_that_contradict_themselves_cannot_be_built() -> None:
    solution = Solution(np.array([[[0, 0]], [[0, 1]]], np.int32))
    sound = Result.of(solution, lower_bound=1)
    for changes, said in (
        ({"cost": 0}, "cost must be the solution's sum of costs, 1, got 0"),
        ({"cost": None}, "cost must be .* got None"),
        ({"solution": None}, "a solved result needs a solution, got none"),
        (
            {"status": Status.INFEASIBLE},
            "only if its status is solved, node_limit, time_limit, got infeasible with one",
        ),
        ({"status": Status.STEP_LIMIT}, "got step_limit with one"),
        ({"lower_bound": 2}, "lower_bound must be at most 1, got 2"),
        ({"lower_bound": -1}, "lower_bound must be at least 0"),
        ({"seconds": math.nan}, "seconds must not be negative"),
        ({"expansions": -1}, "expansions must be at least 0"),
    ):
        with pytest.raises(ValueError, match=said):
            replace(sound, **changes)
    with pytest.raises(TypeError, match=r"status must be a experts\.Status, got str"):
        replace(sound, status="solved")
    with pytest.raises(TypeError, match=r"solution must be a mapf_env\.Solution, got ndarray"):
        replace(sound, solution=solution.paths)


@pytest.mark.parametrize("status", [Status.NODE_LIMIT, Status.TIME_LIMIT])
def test_a_plan_without_a_proof_is_not_solved_but_audited(status: Status) -> None:
    def unproved(instance: Instance) -> Result:
        plan = experts.lacam(instance).solution
        return replace(Result.of(plan or Solution(instance.starts[None])), status=status)

    told = []
    (result,) = experts.solve_many(INSTANCES[:1], solver=unproved, progress=lambda *counts: told.append(counts))
    assert result.solution is not None
    assert not result.solved
    assert told == [(1, 0)]
    with pytest.raises(ValueError, match="jumps in step 0"):
        experts.audited(lambda instance: replace(Jumper()(instance), status=status))(INSTANCES[0])
