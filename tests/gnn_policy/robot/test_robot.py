"""Robots on their own against the network of the whole team, with messages on the links alone."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import bags
import mapf_env
from gnn_policy import DecentralizedPolicy, Execution, Message, PolicyConfig, Robot, load, rollout
from gnn_policy.baselines import RandomActor
from gnn_policy.cases import Family, make_cases
from gnn_policy.execution import robot_seeds
from mapf_env import rules

PLAIN = Execution()
RICH = {
    "extra_channels": ("cost_to_go",),
    "robot_features": ("on_goal", "steps_to_go"),
    "edge_features": ("goal_direction", "relative_position"),
}


def seeded_policy(seed=0, execution=PLAIN, **config):
    """A policy whose batch statistics are not those of a fresh one."""
    torch.manual_seed(seed)
    chosen = PolicyConfig(**{"encoder": "lean", "features": 16, "fov_radius": 2, **config})
    policy = DecentralizedPolicy(chosen, execution)
    with torch.no_grad():
        policy(bags.random_bag(np.random.default_rng(seed), [8, 8], policy.config))
        policy.head.weight.mul_(10)
    return policy.eval()


def links_of(bag, i):
    """The weights of the links on which robot i hears, and their features, by the senders."""
    own = [link for link, receiver in enumerate(bag.edge_index[1].tolist()) if receiver == i]
    senders = bag.edge_index[0].tolist()
    return (
        {senders[link]: float(bag.edge_weight[link]) for link in own},
        {senders[link]: bag.edge_attr[link].tolist() for link in own},
    )


def one_step(robots, bag, cells=None, heard=lambda number, sender, receiver: True):
    """All robots begin, and a post office delivers bytes between neighbours; return the sizes of messages."""
    sizes = set()
    for i, robot in enumerate(robots):
        weights, attr = links_of(bag, i)
        cell = (0, 0) if cells is None else tuple(cells[i].tolist())
        robot.begin(bag.fov[i].numpy(), weights, cell, scalars=bag.scalars[i].numpy(), edge_attr=attr)
    for number in range(robots[0].rounds):
        letters = [robot.message.to_bytes() for robot in robots]
        sizes |= {len(letter) for letter in letters}
        for i, robot in enumerate(robots):
            robot.hear({j: Message.from_bytes(letters[j]) for j in robot.links if heard(number, j, i)})
    return sizes


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    sizes=st.lists(st.integers(1, 6), min_size=1, max_size=2),
    taps=st.integers(1, 3),
    weighted=st.booleans(),
    directed=st.booleans(),
    share=st.floats(0, 1),
    encoder=st.sampled_from([("lean", 2), ("released", 4)]),
    graph_layer=st.sampled_from(["filter", "attention"]),
    rich=st.booleans(),
)
def test_robots_alone_do_what_the_network_does_for_the_team(
    seed, sizes, taps, weighted, directed, share, encoder, graph_layer, rich
):
    generator = np.random.default_rng(seed)
    config = {"taps": taps, "encoder": encoder[0], "fov_radius": encoder[1], "graph_layer": graph_layer}
    policy = seeded_policy(seed, **config, **(RICH if rich else {}))
    bag = bags.random_bag(generator, sizes, policy.config, share=share, weighted=weighted, directed=directed)
    robots = [Robot(policy) for _ in range(sum(sizes))]
    assert one_step(robots, bag) == ({4 * 16 + 1} if taps > 1 else set())
    with torch.no_grad():
        team = policy(bag).numpy()
    alone = np.stack([robot.logits() for robot in robots])
    np.testing.assert_allclose(alone, team, rtol=1e-5, atol=1e-5)
    assert [robot.act() for robot in robots] == alone.argmax(1).tolist()


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 7), taps=st.integers(2, 4), loss=st.floats(0, 1))
def test_a_message_that_is_lost_is_missing_from_the_filters_sum_in_that_round_alone(seed, count, taps, loss):
    """Rounds of S X by a dense matrix, with zeros where a message was lost and the degrees of all links."""
    generator = np.random.default_rng(seed)
    policy = seeded_policy(seed, taps=taps, **RICH)
    bag = bags.random_bag(generator, [count], policy.config, share=0.7, weighted=True)
    came = generator.random((taps - 1, count, count)) >= loss  # round, receiver, sender
    robots = [Robot(policy) for _ in range(count)]
    one_step(robots, bag, heard=lambda number, sender, receiver: came[number, receiver, sender])
    dense = bags.adjacency(bag)
    degree = dense.sum(axis=1)
    root = np.divide(1, np.sqrt(degree), where=degree > 0, out=np.zeros(count))
    with torch.no_grad():
        shifted = policy.extract(bag.fov, bag.scalars).double().numpy()
        hops = [shifted]
        for arrived in came:
            shifted = np.diag(root) @ (dense * arrived) @ np.diag(root) @ shifted
            hops.append(shifted)
        mixed = policy.graph_layer.mix(torch.from_numpy(np.concatenate(hops, axis=1)).float())  # pyright: ignore[reportCallIssue]
        expected = policy.head(torch.relu(mixed)).numpy()
    np.testing.assert_allclose(np.stack([robot.logits() for robot in robots]), expected, rtol=1e-5, atol=1e-5)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 7), loss=st.floats(0, 1))
def test_attention_takes_its_softmax_over_the_messages_that_came(seed, count, loss):
    generator = np.random.default_rng(seed)
    policy = seeded_policy(seed, taps=2, graph_layer="attention", **RICH)
    bag = bags.random_bag(generator, [count], policy.config, share=0.7)
    came = generator.random(len(bag.edge_weight)) >= loss
    links = {tuple(link) for link, there in zip(bag.edge_index.T.tolist(), came, strict=True) if there}
    robots = [Robot(policy) for _ in range(count)]
    one_step(robots, bag, heard=lambda number, sender, receiver: (sender, receiver) in links)
    heard = bag._replace(
        edge_index=bag.edge_index[:, came], edge_weight=bag.edge_weight[came], edge_attr=bag.edge_attr[came]
    )
    with torch.no_grad():
        expected = policy(heard).numpy()
    np.testing.assert_allclose(np.stack([robot.logits() for robot in robots]), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("weights", ["binary", "distance"])
@pytest.mark.parametrize("actions", ["argmax", "sampled", "stuck", "fallback"])
@pytest.mark.parametrize(("taps", "graph_layer"), [(1, "filter"), (3, "filter"), (3, "attention")])
def test_a_team_of_robots_walks_the_paths_of_rollout(taps, graph_layer, actions, weights):
    """Views from the PettingZoo environment, actions to a slow environment that shares only the shield."""
    execution = Execution(actions=actions, temperature=0.7)
    config = {"taps": taps, "graph_layer": graph_layer, "comm_radius": 3.0, "comm_weights": weights, **RICH}
    policy = seeded_policy(1, execution, **config)
    cases = make_cases(
        "test", seed=3, maps=4, cases_per_map=1, families=[Family(num_agents=(5, 5), height=(6, 6), width=(6, 6))]
    ).instances
    bags.spread_preferences(policy, cases)
    seeds = []

    class Listening(RandomActor):
        def act(self, env):
            seeds.append(env.seeds)
            return super().act(env)

    stuck_steps = 0
    for case in cases:
        rollout(Listening(), [case], max_steps=1, seed=5)
        expected = rollout(policy, [case], max_steps=25, seed=5).solutions[0].paths
        robots = [Robot(policy, seed=int(seed)) for seed in robot_seeds(np.repeat(seeds[-1], 5), np.arange(5))]
        for time, positions in enumerate(expected[:-1]):
            env = mapf_env.parallel_env(num_agents=5, height=6, width=6, **execution.senses(policy.config).senses())
            seen, _ = env.reset(seed=0, options={"instance": case.at(positions)})
            one_step(robots, bag_seen(seen), positions)
            wanted = np.array([[robot.act() for robot in robots]])
            maps = rules.bordered(case.grid[None], 2)
            moves = rules.shield(maps, 2, positions[None], wanted, seeds[-1], np.array([time]))
            assert np.array_equal(rules.move(positions[None], moves)[0], expected[time + 1])
            stuck_steps += sum(robot._alarmed for robot in robots)
    assert stuck_steps > 10


def bag_seen(seen):
    """A bag of what the agents of a PettingZoo environment observe."""
    rows = {name: np.stack([each[name] for each in seen.values()]) for name in next(iter(seen.values()))}
    count = len(seen)
    receiver, sender = np.nonzero(rows["graph"])
    attr = rows.get("edge_attr", np.zeros((count, count, 0), np.float32))
    scalars = rows.get("scalars", np.zeros((count, 0), np.float32))
    parts = (
        *(rows["fov"], scalars, np.stack([sender, receiver])),
        *(rows["graph"][receiver, sender], attr[receiver, sender], np.zeros(count, np.int64)),
    )
    return mapf_env.Bag(*(torch.from_numpy(part) for part in parts))


@pytest.mark.parametrize("name", ["n12", "n12-informed"])
def test_robots_alone_do_what_the_policies_of_the_package_do(name):
    policy = load(name)
    env = mapf_env.parallel_env(num_agents=12, **policy.env_settings())
    seen, _ = env.reset(seed=2)
    bag = bag_seen(seen)
    robots = [Robot(policy) for _ in range(12)]
    assert one_step(robots, bag, env.positions) == {513}
    with torch.no_grad():
        team = policy(bag).numpy()
    np.testing.assert_allclose(np.stack([robot.logits() for robot in robots]), team, rtol=1e-5, atol=1e-5)


def test_messages_survive_the_wire_and_nothing_else_is_taken_for_one():
    message = Message(np.array([1.5, -2.25, 3e-30], np.float32), True)
    data = message.to_bytes()
    assert len(data) == 13
    again = Message.from_bytes(data)
    assert again.stuck
    assert np.array_equal(again.features, message.features)
    for wrong in (b"", data[:-1], data + b"\0", b"\7" + data[1:]):
        with pytest.raises(ValueError, match="are not a message"):
            Message.from_bytes(wrong)
    with pytest.raises(ValueError, match="not finite"):
        Message.from_bytes(data[:1] + b"\xff" * 12)


def test_a_lost_message_adds_nothing():
    """One of two neighbours is not heard: the sums have the other's share alone, over the degree of both."""
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


def test_the_news_that_a_robot_is_stuck_comes_with_its_message():
    policy = seeded_policy(taps=2, execution=Execution(actions="stuck", temperature=1e6))
    view = np.random.default_rng(0).random((3, 7, 7), dtype=np.float32)
    for stuck, came in ((True, True), (True, False), (False, True)):
        moves = set()
        for seed in range(40):
            robot = Robot(policy, seed=seed)
            robot.begin(view, {"a": 1.0}, (0, 0))
            robot.hear({"a": Message(np.zeros(16, np.float32), stuck)} if came else {})
            moves.add(robot.act())
        assert (len(moves) == 5) == (stuck and came)


@pytest.mark.parametrize("own", [False, True])
def test_a_robot_that_is_reset_begins_another_case(own):
    stuck = Execution(actions="stuck")
    policy = seeded_policy(taps=1, execution=stuck if own else Execution())
    view, cell = np.zeros((3, 7, 7), np.float32), np.array([2, 3])
    robot = Robot(policy, seed=4) if own else Robot(policy, stuck, seed=4)

    def step():
        robot.begin(view, {}, cell)
        return robot.scores().tolist()

    first, second = step(), step()
    assert first != second  # it is stuck, so it draws
    assert robot.act() == int(np.argmax(second))
    robot.reset()
    assert [step(), step()] == [first, second]


def test_a_robot_refuses_calls_out_of_turn_and_wrong_inputs():
    policy = seeded_policy(taps=2)
    robot, view = Robot(policy), np.zeros((3, 7, 7), np.float32)
    for out_of_turn in (robot.logits, robot.act, lambda: robot.message, lambda: robot.hear({})):
        with pytest.raises(RuntimeError, match="begin"):
            out_of_turn()
    with pytest.raises(ValueError, match=r"views are \(3, 9, 9\)"):
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
    with pytest.raises(ValueError, match="'a' sent features that are not finite"):
        robot.hear({"a": Message(np.full(16, np.nan, np.float32), False)})
    robot.hear({"a": fitting})
    with pytest.raises(RuntimeError, match="1 rounds"):
        robot.hear({"a": fitting})
    assert 0 <= robot.act() < 5
    with pytest.raises(ValueError, match="seed"):
        Robot(policy, seed=-1)


def test_facts_about_itself_and_its_neighbours_that_are_missing_are_named():
    robot, view = Robot(seeded_policy(**RICH)), np.zeros((4, 7, 7), np.float32)
    facts = {"scalars": [1, 0], "edge_attr": {"a": [0, 1, 0, 1]}}
    robot.begin(view, {"a": 1.0}, (0, 0), **facts)
    with pytest.raises(ValueError, match=r"robots have 0 scalars, this policy reads 2: .*\('on_goal', 'steps_to_go'\)"):
        robot.begin(view, {"a": 1.0}, (0, 0), edge_attr=facts["edge_attr"])
    with pytest.raises(ValueError, match="scalars must be a row of finite numbers"):
        robot.begin(view, {"a": 1.0}, (0, 0), **{**facts, "scalars": [0, np.nan]})
    for wrong in (None, {"b": [0, 1, 0, 1]}, {"a": [0, 1]}, {"a": [0, 1, 0, np.inf]}):
        with pytest.raises(ValueError, match=r"4 finite edge features \(goal_direction, relative_pos.*\) .* of 'a'"):
            robot.begin(view, {"a": 1.0}, (0, 0), **{**facts, "edge_attr": wrong})


def test_a_layer_that_does_not_work_by_messages_cannot_run_on_one_robot():
    policy = DecentralizedPolicy(PolicyConfig(graph_layer="own_layers:Sums"))
    with pytest.raises(ValueError, match="'own_layers:Sums' has no start, send, receive, combine and finish"):
        Robot(policy)
