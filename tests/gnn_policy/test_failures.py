"""Kinds of failure: drawn examples of each, and a slow reader of the definition."""

import re

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

import oracles
import strategies
from gnn_policy import Rollouts
from gnn_policy.failures import LAST_STEPS, count_failures, failure, worst
from mapf_env import Instance, Solution, parse_instance


def walked(instance: Instance, *moves: str) -> Solution:
    """Paths of robots that repeat their moves, U L D R or I, for three times the last steps."""
    paths = [instance.starts]
    for time in range(3 * LAST_STEPS):
        step = [oracles.STEP["ULDRI".index(each[time % len(each)])] for each in moves]
        paths.append(paths[-1] + np.array(step))
    return Solution(np.stack(paths))


@pytest.mark.parametrize(
    ("kind", "drawing", "moves"),
    [
        (None, "A", ["I"]),
        ("deadlock", "bAB.a", ["I", "I"]),
        ("deadlock", "A.a", ["I"]),
        ("oscillation", "#.#/#B#/bAa", ["RL", "UD"]),
        ("oscillation", "A.a", ["RL"]),
        ("livelock", "A.../...a", ["RRLL"]),
        ("goal blocked", "A.B.a", ["I", "I"]),
        ("goal blocked", "..A.B.a", ["LR", "I"]),
        ("goal blocked", "A.#/#B#/#a#", ["RL", "I"]),
    ],
)
def test_one_of_each(kind, drawing, moves):
    instance = parse_instance(drawing.replace("/", "\n"))
    assert failure(instance, walked(instance, *moves)) == kind


def test_a_blocker_that_leaves_its_goal_now_and_then_blocks_nothing():
    instance = parse_instance("A.B.a\n##.##")
    assert failure(instance, walked(instance, "I", "I")) == "goal blocked"
    assert failure(instance, walked(instance, "I", "DU")) == "deadlock"


def test_a_robot_that_comes_nearer_at_the_end_is_only_late():
    instance = parse_instance("A" + "." * 100 + "a")
    slow = np.zeros((2 * LAST_STEPS, 1, 2), int)
    slow[-1] = (0, 1)
    assert failure(instance, Solution(slow)) == "out of time"
    assert failure(instance, Solution(slow[:-1])) == "deadlock"
    assert failure(instance, Solution(slow[-1:])) == "deadlock"


def test_paths_of_another_team_are_refused():
    with pytest.raises(ValueError, match=re.escape("2 paths for 1 agents")):
        failure(parse_instance("Aa"), Solution(np.zeros((1, 2, 2), int)))


def read(instance: Instance, paths: list[list[oracles.Cell]]) -> str | None:
    """The definition, robot after robot."""
    goals, end = oracles.cells(instance.goals), paths[-1]
    recent = paths[-1 - LAST_STEPS :] if len(paths) > LAST_STEPS else paths
    earlier = paths[: len(paths) - len(recent) + 1]
    late = [i for i, goal in enumerate(goals) if end[i] != goal]
    if not late:
        return None
    stalled = []
    for i in late:
        steps = oracles.distances(instance.grid, goals[i])
        if not any(all(steps[now[i]] < steps[before[i]] for before in earlier) for now in recent):
            stalled.append(i)
    if not stalled:
        return "out of time"
    walls = instance.grid.copy()
    for i, goal in enumerate(goals):
        if all(now[i] == goal for now in recent):
            walls[goal] = True
    if any(end[i] not in oracles.distances(walls, goals[i]) for i in stalled):
        return "goal blocked"
    if all(len({now[i] for now in recent}) == 1 for i in stalled):
        return "deadlock"
    return "oscillation" if all(len({now[i] for now in recent}) <= 2 for i in stalled) else "livelock"


@st.composite
def teams_that_repeat_themselves(draw):
    """Problems and collision-free walks: some random steps, then a few joint actions over and over."""
    instance = draw(strategies.instances())
    joint = strategies.joint_actions(instance.num_agents)
    begin, cycle = draw(st.lists(joint, max_size=12)), draw(st.lists(joint, min_size=1, max_size=3))
    actions = begin + (cycle * 2 * LAST_STEPS)[: draw(st.integers(0, 2 * LAST_STEPS))]
    free, paths = oracles.free_cells(instance.grid), [oracles.cells(instance.starts)]
    for joint_action in actions:
        now = list(paths[-1])
        for i, action in enumerate(joint_action):
            there = oracles.moved(now[i], action)
            if there in free and there not in now:
                now[i] = there
        paths.append(now)
    return instance, paths


@given(teams_that_repeat_themselves(), st.randoms(use_true_random=False))
def test_it_is_the_definition_whatever_the_order_of_robots_and_the_side_of_the_map(case, random):
    instance, paths = case
    kind = failure(instance, Solution(np.array(paths)))
    event(str(kind))
    assert kind == read(instance, paths)
    order = random.sample(range(instance.num_agents), instance.num_agents)
    turned = Instance(instance.grid.T, instance.starts[order][:, ::-1], instance.goals[order][:, ::-1])
    assert failure(turned, Solution(np.array(paths)[:, order, ::-1])) == kind


def played_as(instances, solutions):
    """Return the `Rollouts` of these paths, with T_max 40."""
    on_goal = [(each.paths[-1] == case.goals).all(axis=1) for case, each in zip(instances, solutions, strict=True)]
    times = [np.where(there, each.arrival_times, 40) for there, each in zip(on_goal, solutions, strict=True)]
    nothing = np.zeros(len(instances))
    return Rollouts(
        instances=instances,
        solutions=solutions,
        goals=[case.goals[None] for case in instances],
        success=np.array([there.all() for there in on_goal]),
        flowtime=np.array([each.sum() for each in times]),
        makespan=np.array([each.max() for each in times]),
        on_goal=np.array([there.mean() for there in on_goal]),
        latched=np.array([there.all() for there in on_goal]),
        replaced=nothing,
        throughput=nothing,
    )


def test_the_worst_of_each_kind_come_first_next_to_the_experts_solutions():
    plain = parse_instance("A.a\n...\nB.b")
    between = plain.starts + np.array([0, 1])
    straight = Solution(np.array([plain.starts, between, plain.goals]))
    slow = Solution(np.array([plain.starts, *4 * [between], plain.goals]))
    one_fails = walked(plain, "RR" + 46 * "I", "I")
    both_fail = walked(plain, "I", "I")
    one_swings = walked(plain, "RR" + 46 * "I", "RL")
    played = played_as([plain] * 5, [straight, one_fails, slow, both_fail, one_swings])
    scenes = worst(played, [straight] * 5, 4)
    assert [scene.title for scene in scenes] == [
        "2 robots, case 3: deadlock, 2 not on goal, flowtime +1900%",
        "2 robots, case 4: oscillation, 1 not on goal, flowtime +950%",
        "2 robots, case 1: deadlock, 1 not on goal, flowtime +950%",
        "2 robots, case 2: solved, flowtime +150%",
    ]
    assert [dict(scene.solutions) for scene in scenes] == [
        {"policy": each, "expert": straight} for each in (both_fail, one_swings, one_fails, slow)
    ]
    assert worst(played, [straight] * 5, 0) == []
    assert count_failures(played) == {"deadlock": 2, "oscillation": 1}
