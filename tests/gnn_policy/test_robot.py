"""Robots on their own against the network of the whole team, with messages on the links alone."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import mapf_env
from gnn_policy import DecentralizedPolicy, Execution, Message, PolicyConfig, Robot, load, rollout
from gnn_policy.cases import make_cases
from gnn_policy.execution import robot_seeds
from gnn_policy.rollout import Teams
from mapf_env import rules


def seeded_policy(seed=0, **config):
    """A policy whose batch statistics are not those of a fresh one."""
    torch.manual_seed(seed)
    policy = DecentralizedPolicy(PolicyConfig(**{"encoder": "lean", "features": 16, "fov_radius": 2, **config}))
    side = 2 * policy.config.fov_radius + 3
    with torch.no_grad():
        policy(torch.rand(3, 4, policy.config.channels, side, side), torch.zeros(3, 4, 4))
        policy.head.weight.mul_(10)
    return policy.eval()


def links_of(graph, i):
    return {j: float(graph[i, j]) for j in range(len(graph)) if graph[i, j] > 0}


def one_step(robots, views, graph, cells):
    """All robots begin, and a post office delivers bytes between neighbours alone; how many bytes a message has."""
    sizes = set()
    for i, robot in enumerate(robots):
        robot.begin(views[i], links_of(graph, i), tuple(cells[i].tolist()))
    for _ in range(robots[0].rounds):
        letters = [robot.message.to_bytes() for robot in robots]
        sizes |= {len(letter) for letter in letters}
        for i, robot in enumerate(robots):
            robot.hear({j: Message.from_bytes(letters[j]) for j in links_of(graph, i)})
    return sizes


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 8),
    taps=st.integers(1, 3),
    weighted=st.booleans(),
    share=st.floats(0, 1),
    encoder=st.sampled_from([("lean", 2), ("released", 4)]),
    cost_to_go=st.booleans(),
)
def test_robots_alone_do_what_the_network_does_for_the_team(seed, count, taps, weighted, share, encoder, cost_to_go):
    generator = np.random.default_rng(seed)
    policy = seeded_policy(seed, taps=taps, encoder=encoder[0], fov_radius=encoder[1], cost_to_go=cost_to_go)
    side = 2 * encoder[1] + 3
    views = generator.random((count, policy.config.channels, side, side), dtype=np.float32)
    graph = np.triu(generator.random((count, count)) < share, 1) * (generator.uniform(0.2, 1) if weighted else 1)
    graph = graph * generator.uniform(0.3, 1, graph.shape) if weighted else graph
    graph = (graph + graph.T).astype(np.float32)
    robots = [Robot(policy) for _ in range(count)]
    sizes = one_step(robots, views, graph, np.zeros((count, 2), int))
    assert sizes == ({4 * 16 + 1} if taps > 1 else set())
    with torch.no_grad():
        team = policy(torch.from_numpy(views)[None], torch.from_numpy(graph)[None])[0].numpy()
    alone = np.stack([robot.logits() for robot in robots])
    np.testing.assert_allclose(alone, team, rtol=1e-5, atol=1e-5)
    assert [robot.act() for robot in robots] == alone.argmax(1).tolist()


@pytest.mark.parametrize("weights", ["binary", "distance"])
@pytest.mark.parametrize("sample", [False, True, "stuck"])
@pytest.mark.parametrize("taps", [1, 3])
def test_a_team_of_robots_walks_the_paths_of_rollout(taps, sample, weights):
    """Views from the PettingZoo environment, actions to a slow world that shares only the shield."""
    policy = seeded_policy(1, taps=taps, comm_radius=3.0, comm_weights=weights)
    cases = make_cases(
        "test", seed=3, maps=4, cases_per_map=1, num_agents=5, height=6, width=6, density=0.1, styles=["cells"]
    )
    execution = Execution(sample=sample, temperature=0.7)
    seeds = []

    class Listening:
        border, memory = 1, 0

        def act(self, teams: Teams):
            seeds.append(teams.seeds[0])
            return np.full(teams.positions.shape[:2], 4)

    stuck_steps = 0
    for case in cases:
        rollout(Listening(), [case], max_steps=1, seed=5)
        expected = rollout(policy, [case], sample=sample, temperature=0.7, max_steps=25, seed=5).solutions[0].paths
        own = robot_seeds(np.array(seeds[-1:]), 5)[0]
        robots = [Robot(policy, execution, int(seed)) for seed in own]
        settings = {"num_agents": 5, "height": 6, "width": 6, "fov_radius": 2, "comm_radius": 3.0}
        for time, positions in enumerate(expected[:-1]):
            env = mapf_env.parallel_env(**settings, comm_weights=weights)
            seen, _ = env.reset(seed=0, options={"instance": case.at(positions)})
            views, graph = (np.stack([each[name] for each in seen.values()]) for name in ("fov", "graph"))
            one_step(robots, views, graph, positions)
            wanted = np.array([[robot.act() for robot in robots]])
            maps = rules.bordered(case.grid[None], 2)
            moves = rules.shield(maps, 2, positions[None], wanted, np.array(seeds[-1:]), np.array([time]))
            assert np.array_equal(rules.move(positions[None], moves)[0], expected[time + 1])
            stuck_steps += sum(robot._alarmed for robot in robots)
    assert stuck_steps > 10


def test_messages_survive_the_wire_and_nothing_else_is_taken_for_one():
    message = Message(np.array([1.5, -2.25, 3e-30], np.float32), True)
    data = message.to_bytes()
    assert len(data) == 13
    again = Message.from_bytes(data)
    assert again.stuck
    assert np.array_equal(again.features, message.features)
    for wrong in (b"", data[:-1], data + b"\0", b"\7" + data[1:]):
        with pytest.raises(ValueError, match="no message"):
            Message.from_bytes(wrong)
    with pytest.raises(ValueError, match="not finite"):
        Message.from_bytes(data[:1] + b"\xff" * 12)


def test_what_is_lost_adds_nothing():
    """Of two neighbours one is not heard: the sums have the other's share alone, over the degree of both."""
    policy = seeded_policy(taps=2)
    robot, heard = Robot(policy), Message(np.arange(16, dtype=np.float32), False)
    view = np.random.default_rng(0).random((3, 7, 7), dtype=np.float32)
    robot.begin(view, {"a": 1.0, "b": 1.0}, (0, 0))
    robot.hear({"a": heard})
    lost = Message(np.zeros(16, np.float32), False)
    other = Robot(policy)
    other.begin(view, {"a": 1.0, "b": 1.0}, (0, 0))
    other.hear({"a": heard, "b": lost})
    assert np.array_equal(robot.logits(), other.logits())
    other.begin(view, {"a": 1.0}, (0, 0))
    other.hear({"a": heard})
    assert not np.array_equal(robot.logits(), other.logits())


def test_a_robot_that_is_reset_begins_another_case():
    policy = seeded_policy(taps=1)
    view, cell = np.zeros((3, 7, 7), np.float32), np.array([2, 3])
    robot = Robot(policy, Execution(sample="stuck"), seed=4)

    def step():
        robot.begin(view, {}, cell)
        return robot.values().tolist()

    first, second = step(), step()
    assert first != second  # it is stuck, so it draws
    assert robot.act() == int(np.argmax(second))
    robot.reset()
    assert [step(), step()] == [first, second]


@pytest.mark.parametrize("name", ["n12", "n12-informed"])
def test_robots_alone_do_what_the_policies_of_the_package_do(name):
    policy = load(name)
    env = mapf_env.parallel_env(num_agents=12, extra_channels=("cost_to_go",) if policy.config.cost_to_go else ())
    seen, _ = env.reset(seed=2)
    views, graph = (np.stack([each[key] for each in seen.values()]) for key in ("fov", "graph"))
    robots = [Robot(policy) for _ in range(12)]
    assert one_step(robots, views, graph, env.positions) == {513}
    with torch.no_grad():
        team = policy(torch.from_numpy(views)[None], torch.from_numpy(graph)[None])[0].numpy()
    np.testing.assert_allclose(np.stack([robot.logits() for robot in robots]), team, rtol=1e-5, atol=1e-5)


def test_a_robot_refuses_what_is_out_of_turn_or_does_not_fit():
    policy = seeded_policy(taps=2)
    robot, view = Robot(policy), np.zeros((3, 7, 7), np.float32)
    for out_of_turn in (robot.logits, robot.act, lambda: robot.message, lambda: robot.hear({})):
        with pytest.raises(RuntimeError, match="begin"):
            out_of_turn()
    with pytest.raises(ValueError, match="views are 3x9x9"):
        robot.begin(np.zeros((3, 9, 9), np.float32), {}, (0, 0))
    with pytest.raises(ValueError, match=r"positive weights, got 0\.0 to 'b'"):
        robot.begin(view, {"a": 1.0, "b": 0.0}, (0, 0))
    robot.begin(view, {"a": 1.0}, (0, 0))
    with pytest.raises(RuntimeError, match="0 of 1 rounds"):
        robot.act()
    fitting = robot.message
    for wrong in ({"b": fitting}, {"a": fitting, "b": fitting}):
        with pytest.raises(ValueError, match="a message of 'b', to whom"):
            robot.hear(wrong)
    with pytest.raises(ValueError, match=r"'a' sent \(3,\) features"):
        robot.hear({"a": Message(np.zeros(3, np.float32), False)})
    robot.hear({"a": fitting})
    with pytest.raises(RuntimeError, match="1 rounds"):
        robot.hear({"a": fitting})
    assert 0 <= robot.act() < 5
    with pytest.raises(ValueError, match="seed"):
        Robot(policy, seed=-1)
