"""A swarm over a radio in memory: equal to `rollout` where nothing is lost, and without collisions whatever is."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import bags
import oracles
from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig, rollout
from gnn_policy.robot.frame import Seal
from gnn_policy.robot.pilot import Pilot
from gnn_policy.robot.radio import Ether, Faults
from gnn_policy.robot.rehearsal import rehearse
from gnn_policy.robot.robot import Robot
from gnn_policy.robot.world import CollisionError, World
from mapf_env import Instance, random_instance

CONFIG = PolicyConfig(
    encoder="lean",
    features=16,
    fov_radius=2,
    comm_radius=4.0,
    taps=3,
    graph_layer="attention",
    extra_channels=("cost_to_go", "previous_positions"),
    robot_features=("on_goal", "greedy_moves"),
    edge_features=("relative_position", "goal_direction"),
)
CASES = [random_instance(height=7, width=7, density=0.1, num_agents=6, seed=seed) for seed in range(3)]


@pytest.fixture(scope="module")
def policy():
    torch.manual_seed(1)
    policy = DecentralizedPolicy(CONFIG)
    with torch.no_grad():
        policy(bags.random_bag(np.random.default_rng(0), [8, 8], CONFIG))
    bags.spread_preferences(policy.eval(), CASES)
    return policy


def require_legal(instance, solution):
    for before, after in zip(solution.paths[:-1], solution.paths[1:], strict=True):
        assert not oracles.faults(instance.grid, [*map(tuple, before.tolist())], [*map(tuple, after.tolist())])


@pytest.mark.parametrize("shield", ["idle", "pibt_swap"])
@pytest.mark.parametrize("actions", ["argmax", "sampled", "stuck", "fallback"])
def test_without_faults_a_swarm_walks_the_paths_of_rollout(policy, actions, shield):
    execution = Execution(actions=actions, temperature=0.7, shield=shield)
    for number, case in enumerate(CASES[:2]):
        alone = rehearse(policy, case, execution=execution, shielded_by="world", seed=number, max_steps=25)
        team = rollout(policy, [case], execution=execution, seed=number, max_steps=25)
        assert np.array_equal(alone.solution.paths, team.solutions[0].paths)
        assert alone.success == team.success[0]
        assert not alone.dropped


FAULTS = st.builds(
    Faults,
    loss=st.sampled_from([0.0, 0.3, 1.0]),
    delay=st.integers(0, 3),
    repeat=st.sampled_from([0.0, 0.5]),
    forge=st.sampled_from([0.0, 0.5, 1.0]),
)


@settings(max_examples=20)
@given(
    faults=FAULTS,
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(2, 10),
    side=st.integers(4, 6),
    gone=st.integers(0, 6),
    rounds=st.integers(1, 5),
)
def test_no_executed_step_collides_whatever_the_radio_does(policy, faults, seed, count, side, gone, rounds):
    instance = random_instance(height=side, width=side, density=0.1, num_agents=count, seed=seed)
    absent = {0: range(2, 2 + gone)} if gone else None
    execution = Execution(actions="fallback", temperature=0.7)
    played = rehearse(
        *(policy, instance),
        execution=execution,
        faults=faults,
        absent=absent,
        reservation_rounds=rounds,
        seed=seed,
        max_steps=10,
    )
    require_legal(instance, played.solution)
    still = played.solution.paths[2 : 2 + gone + 1, 0]
    assert (still == still[:1]).all(), "a robot without a process moved"


def test_forged_frames_are_dropped_and_counted_and_change_nothing(policy):
    case = CASES[0]
    plain = rehearse(policy, case, max_steps=12)
    forged = rehearse(policy, case, faults=Faults(forge=1.0), max_steps=12)
    assert np.array_equal(plain.solution.paths, forged.solution.paths)
    assert forged.dropped["damaged"] > 100
    assert forged.dropped["late"] > 10
    assert not plain.dropped


def test_a_message_of_the_policy_that_is_late_counts_as_lost(policy, monkeypatch):
    """With a delay of at least one round nothing of the policy comes in time: robots act as if they heard nobody."""

    class Slow(Ether):
        def put(self, data, receiver):
            self._due[receiver].append((self._now + 1, data))

    case = CASES[1]
    mute = rehearse(policy, case, execution=Execution(), shielded_by="world", faults=Faults(loss=1.0), max_steps=12)
    whole = rehearse(policy, case, execution=Execution(), shielded_by="world", max_steps=12)
    monkeypatch.setattr("gnn_policy.robot.rehearsal.Ether", Slow)
    slow = rehearse(policy, case, execution=Execution(), shielded_by="world", max_steps=12)
    assert np.array_equal(slow.solution.paths, mute.solution.paths)
    assert slow.dropped["late"] > 50
    assert not np.array_equal(whole.solution.paths, mute.solution.paths)


def test_no_robot_waits_for_a_deadline_where_nothing_is_lost(policy):
    """Robots go on in any order, some a round ahead of others; each is over at last by what it has heard."""
    random, case = np.random.default_rng(0), random_instance(height=5, width=5, density=0, num_agents=8, seed=3)
    world = World(case, policy.config, Execution(), max_steps=40)
    pilots = [
        Pilot(Robot(policy, seed=number), number, Seal(b"key", 1), reservation_rounds=2)
        for number in range(case.num_agents)
    ]
    ahead = 0
    while world.running:
        sensed, moves = world.sense(), {}
        came, rounds, speaks = [[] for _ in pilots], [0] * len(pilots), [True] * len(pilots)
        for number, pilot in enumerate(pilots):
            pilot.begin(sensed[number])
        for number in random.integers(0, len(pilots), 4000):
            pilot = pilots[number]
            if pilot.over:
                continue
            if speaks[number]:
                data, receivers = pilot.outgoing()
                for receiver in receivers:
                    came[receiver].append(data)
                speaks[number] = False
            while came[number]:
                pilot.receive(came[number].pop(0))
            if pilot.complete:
                pilot.close_round(lambda move, number=number, moves=moves: moves.setdefault(number, move) == move)
                rounds[number], speaks[number] = rounds[number] + 1, True
                ahead += max(rounds) - min(rounds) > 1
        assert all(pilot.over for pilot in pilots)
        world.execute(moves)
    assert ahead > 20
    assert not any(pilot.dropped["early"] for pilot in pilots)


@pytest.mark.parametrize("precision", ["float16", "int8"])
def test_fewer_bits_are_sent_and_the_swarm_still_moves(policy, precision):
    whole = rehearse(policy, CASES[0], execution=Execution(), max_steps=3)
    short = rehearse(policy, CASES[0], execution=Execution(), precision=precision, max_steps=3)
    assert short.sent < whole.sent
    assert not short.dropped
    require_legal(CASES[0], short.solution)


def test_a_robot_that_comes_back_takes_part_again(policy):
    execution = Execution(actions="fallback", temperature=0.7)
    played = rehearse(policy, CASES[2], execution=execution, absent={1: range(5)}, max_steps=40)
    assert (played.solution.paths[:6, 1] == CASES[2].starts[1]).all()
    assert (played.solution.paths[:, 1] != CASES[2].starts[1]).any()
    require_legal(CASES[2], played.solution)


def test_the_judge_of_the_world_stops_what_collides():
    corridor = Instance(np.zeros((1, 3), bool), np.array([[0, 0], [0, 1]]), np.array([[0, 2], [0, 0]]))
    UP, LEFT, RIGHT, IDLE = 0, 1, 3, 4
    for moves, complaint in (
        ({0: RIGHT, 1: LEFT}, "robots 0 and 1 would swap their cells in step 0"),
        ({0: RIGHT}, r"robots 0 and 1 would collide at \(0, 1\) in step 0"),
        ({0: UP}, r"robot 0 would enter \(-1, 0\), which is not free"),
    ):
        with pytest.raises(CollisionError, match=complaint):
            World(corridor, CONFIG, Execution()).execute(moves)
    world = World(corridor, CONFIG, Execution())
    world.execute({0: RIGHT, 1: RIGHT})
    world.execute({1: IDLE})
    assert world.solution.paths.tolist() == [[[0, 0], [0, 1]], [[0, 1], [0, 2]], [[0, 1], [0, 2]]]
    assert (world.step_number, world.running) == (2, True)


def test_the_worlds_shield_moves_no_silent_robot():
    world = World(CASES[0], CONFIG, Execution(shield="pibt"), shielded_by="world")
    with pytest.raises(ValueError, match="robot 0 is silent"):
        world.execute_shielded({})
    idle = World(CASES[0], CONFIG, Execution(), shielded_by="world")
    idle.execute_shielded({})
    assert np.array_equal(idle.paths[0], idle.paths[1])


def test_faults_are_checked():
    for name, wrong in (("loss", 1.5), ("repeat", -0.1), ("forge", float("nan")), ("delay", -1)):
        with pytest.raises(ValueError, match=name):
            Faults(**{name: wrong})  # pyright: ignore[reportArgumentType]
