"""PIBT: a rule-based planner, fast and without a bound; the baseline that knows the whole map."""

from __future__ import annotations

from experts import _native, arguments
from experts.result import Result, as_result
from mapf_env.instance import Instance


def pibt(
    instance: Instance, *, swap: bool = False, max_steps: int = arguments.DEFAULT_MAX_STEPS, seed: int = 0
) -> Result:
    """Move all robots step by step by priority inheritance with backtracking until all are on their goals at once.

    Okumura, Machida, Defago and Tamura 2022, "Priority inheritance with backtracking for iterative multi-agent path
    finding". In each step a robot takes the free neighbour cell closest to its goal, and pushes robots of lower
    priority out of its way; the robots that have been under way for longest come first. Plans have no conflicts. On
    graphs whose cells all lie on cycles every robot reaches its goal some time, but not all of them need to rest there
    at once.

    Plain PIBT never resolves two robots that face each other in a corridor. With `swap` (Okumura 2023, "Improving LaCAM
    for scalable eventually optimal multi-agent pathfinding") one of them backs out to where the corridor branches and
    pulls the other along, so that they change places.

    Args:
        instance: The problem.
        swap: Let robots change places in corridors.
        max_steps: Joint steps after which to give up with the status `step_limit`.
        seed: Random seed for the first order of priorities and for ties between cells.

    Returns:
        The result. Its lower bound is the sum of the distances, its expansions are the joint steps.

    Raises:
        ValueError: If an argument is out of its range.
        TypeError: If an argument has the wrong type.
        KeyboardInterrupt: On Ctrl-C.
    """
    arguments.instance_of(instance, Instance, "instance")
    parts = _native.pibt(
        instance.grid,
        instance.starts,
        instance.goals,
        arguments.flag(swap, "swap"),
        arguments.at_least_one(max_steps, "max_steps", maximum=arguments.MAX_STEPS),
        arguments.seed(seed),
    )
    return as_result(parts)
