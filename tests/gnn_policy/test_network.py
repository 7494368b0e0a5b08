"""Properties of the network: weights for any team, bags, symmetry between robots, and a reach of K - 1 hops."""

import sys
from collections import deque
from dataclasses import replace
from types import ModuleType

import jaxtyping
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import bags
import own_layers
from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig, network, policy_config
from mapf_env import Bag

few = settings(max_examples=25)

ENCODERS = ("released", "lean")
PAPER = {"graph_layer": "filter"}
RICH = {
    "graph_layer": "attention",
    "edge_features": ("relative_position", "last_moves"),
    "robot_features": ("on_goal", "steps_left"),
    "memory": 2,
}
KINDS = pytest.mark.parametrize("kind", [PAPER, RICH, {**RICH, **PAPER}], ids=["paper", "attention", "filter"])

sizes = st.lists(st.integers(1, 6), min_size=1, max_size=4)


def seeded_policy(seed=0, **config):
    """A policy in which even a far robot is felt clearly."""
    torch.manual_seed(seed)
    policy = DecentralizedPolicy(PolicyConfig(**{"features": 16, "encoder": "lean", **config})).eval()
    with torch.no_grad():
        policy.head.weight.mul_(10)
    return policy


def hops_from(links, start):
    """Breadth-first distances along links (sender, receiver); robots out of reach are absent."""
    distance, queue = {start: 0}, deque([start])
    while queue:
        here = queue.popleft()
        for there in [receiver for sender, receiver in links if sender == here]:
            if there not in distance:
                distance[there] = distance[here] + 1
                queue.append(there)
    return distance


@pytest.mark.parametrize(("taps", "count"), [(1, 173_733), (2, 190_117), (3, 206_501)])
def test_the_released_network_has_the_papers_number_of_weights(taps, count):
    policy = DecentralizedPolicy(PolicyConfig(taps=taps))
    assert sum(weights.numel() for weights in policy.parameters() if weights.requires_grad) == count
    generator = np.random.default_rng(0)
    for sizes in ([1], [14], [3, 5, 1]):
        logits = policy.eval()(bags.random_bag(generator, sizes, policy.config))
        assert logits.shape == (sum(sizes), 5)


@KINDS
@pytest.mark.parametrize("encoder", ENCODERS)
@few
@given(seed=st.integers(0, 2**32 - 1), sizes=sizes, taps=st.integers(1, 4))
def test_splitting_or_joining_bags_changes_no_logits(kind, encoder, seed, sizes, taps):
    generator = np.random.default_rng(seed)
    policy = seeded_policy(seed, encoder=encoder, taps=taps, **kind)
    bag = bags.random_bag(generator, sizes, policy.config, weighted=True)
    with torch.no_grad():
        together, alone = policy(bag), torch.cat([policy(part) for part in bags.split(bag)])
    torch.testing.assert_close(alone, together, rtol=1e-4, atol=1e-5)


@KINDS
@pytest.mark.parametrize("encoder", ENCODERS)
def test_many_robots_are_read_in_parts_with_the_same_logits(kind, encoder, monkeypatch):
    generator = np.random.default_rng(0)
    policy = seeded_policy(0, encoder=encoder, taps=3, **kind)
    bag = bags.random_bag(generator, [5, 30, 2], policy.config, weighted=True)
    with torch.no_grad():
        whole = policy(bag)
        monkeypatch.setattr("gnn_policy.network._AT_ONCE", 7)
        sizes = list[int]()
        extract = policy.extract
        monkeypatch.setattr(policy, "extract", lambda fov, *rest: sizes.append(len(fov)) or extract(fov, *rest))
        torch.testing.assert_close(policy(bag), whole, rtol=1e-4, atol=1e-5)
    assert sizes == [7] * 5 + [2]
    policy.train()(bag)
    assert sizes[-1] == 37  # batch norm is trained on all robots


@KINDS
@pytest.mark.parametrize("encoder", ENCODERS)
@few
@given(seed=st.integers(0, 2**32 - 1), sizes=sizes, taps=st.integers(1, 4), directed=st.booleans())
def test_permuting_robots_permutes_logits(kind, encoder, seed, sizes, taps, directed):
    generator = np.random.default_rng(seed)
    policy = seeded_policy(seed, encoder=encoder, taps=taps, **kind)
    bag = bags.random_bag(generator, sizes, policy.config, directed=directed)
    order = generator.permutation(sum(sizes))
    with torch.no_grad():
        logits, permuted = policy(bag), policy(bags.permuted(bag, order, generator))
    torch.testing.assert_close(permuted, logits[order], rtol=1e-4, atol=1e-5)


@KINDS
def test_one_tap_does_not_communicate(kind):
    policy = seeded_policy(taps=1, **kind)
    loud = bags.random_bag(np.random.default_rng(0), [5, 5], policy.config, share=0.8)
    silent = loud._replace(
        edge_index=loud.edge_index[:, :0], edge_weight=loud.edge_weight[:0], edge_attr=loud.edge_attr[:0]
    )
    with torch.no_grad():
        assert torch.equal(policy(silent), policy(loud))


@KINDS
@pytest.mark.parametrize("directed", [False, True])
@pytest.mark.parametrize("taps", [1, 2, 3, 4])
def test_logits_depend_on_exactly_the_robots_within_taps_minus_one_hops(kind, directed, taps):
    generator = np.random.default_rng(taps)
    policy = seeded_policy(taps=taps, **kind)
    bag = bags.random_bag(generator, [7, 6], policy.config, share=0.3, directed=directed)
    links = [tuple(link) for link in bag.edge_index.T.tolist()]
    dead_ends = set(range(13)) - {receiver for _, receiver in links}  # the filter divides a sender by its degree
    with torch.no_grad():
        before = policy(bag)
        for changed in range(13):
            altered = bag.fov.clone()
            altered[changed] = 1 - altered[changed]
            moved = (policy(bag._replace(fov=altered)) - before).abs().amax(-1)
            reach = {robot for robot, hops in hops_from(links, changed).items() if hops < taps}
            if policy.config.graph_layer == "filter" and changed in dead_ends:
                reach = {changed}
            felt = {robot for robot in range(13) if moved[robot] > 1e-5}
            assert felt == reach, f"a change of robot {changed} is felt by {felt}, not by {reach}"


@KINDS
def test_a_robot_out_of_range_changes_nothing(kind):
    generator = np.random.default_rng(3)
    policy = seeded_policy(**kind)
    bag, other = (bags.random_bag(generator, [size], policy.config) for size in (5, 1))
    wider = bag._replace(
        fov=torch.cat([bag.fov, other.fov]),
        scalars=torch.cat([bag.scalars, other.scalars]),
        team=torch.cat([bag.team, other.team]),
    )
    with torch.no_grad():
        torch.testing.assert_close(policy(wider)[:5], policy(bag), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("encoder", ENCODERS)
def test_views_of_bytes_and_of_floats_give_the_same_logits(encoder):
    policy = seeded_policy(encoder=encoder, extra_channels=("cost_to_go", "greedy_cells"))
    bag = bags.random_bag(np.random.default_rng(1), [4, 8], policy.config)
    coded = bag.fov.clone()
    coded[:, 3] = torch.randint(0, 17, coded[:, 3].shape)  # cost to go: steps from -8 to 8, as shares of 8
    coded[:, 4] = torch.randint(0, 49, coded[:, 4].shape)
    config = policy.config
    decoded = coded.double()
    for channel in (3, 4):
        decoded[:, channel] = decoded[:, channel] / float(config.channel_unit[channel])
        decoded[:, channel] += float(config.channel_low[channel])
    with torch.no_grad():
        from_bytes, from_floats = policy(bag._replace(fov=coded)), policy(bag._replace(fov=decoded.float()))
    torch.testing.assert_close(from_bytes, from_floats, rtol=1e-5, atol=1e-5)
    plain = seeded_policy(encoder=encoder)
    bag = bags.random_bag(np.random.default_rng(1), [4, 8], plain.config)
    with torch.no_grad():
        assert torch.equal(plain(bag), plain(bag._replace(fov=bag.fov.float())))


def test_robots_read_their_scalars_and_no_more():
    policy = seeded_policy(**RICH)
    bag = bags.random_bag(np.random.default_rng(1), [4], policy.config)
    further = torch.cat([bag.scalars, torch.rand(4, 1)], 1)  # such as "stuck", which only the execution reads
    with torch.no_grad():
        logits = policy(bag)
        assert torch.equal(policy(bag._replace(scalars=further)), logits)
        for column in range(policy.config.num_robot_features):
            other = bag.scalars.clone()
            other[:, column] += 1
            assert not torch.equal(policy(bag._replace(scalars=other)), logits)


@pytest.mark.parametrize(
    ("encoder", "radius"), [("released", 3), ("released", 5), ("lean", 2), ("lean", 3), ("lean", 6)]
)
def test_the_encoders_read_views_of_other_sizes(encoder, radius):
    policy = seeded_policy(encoder=encoder, fov_radius=radius)
    assert policy(bags.random_bag(np.random.default_rng(0), [2, 3], policy.config)).shape == (5, 5)


@pytest.fixture
def my_parts(monkeypatch):
    module = ModuleType("my_parts")
    module.number, module.make = 5, lambda *sizes: own_layers.Sums(*sizes)  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "my_parts", module)


def test_your_own_parts_take_their_places():
    policy = seeded_policy(encoder="own_layers:Flat", graph_layer="own_layers:Sums", taps=2, fov_radius=3)
    bag = bags.random_bag(np.random.default_rng(0), [4, 4], policy.config)
    with torch.no_grad():
        features = policy.encoder(bag.fov.float())
        hears = torch.from_numpy(bags.adjacency(bag)).float()
        expected = policy.head(torch.relu(policy.graph_layer.mix(features + hears @ features)))  # pyright: ignore[reportCallIssue]
        torch.testing.assert_close(policy(bag), expected)
    assert isinstance(policy.encoder, own_layers.Flat)
    assert isinstance(policy.graph_layer, own_layers.Sums)


@pytest.mark.usefixtures("my_parts")
@pytest.mark.parametrize("part", ["encoder", "graph_layer"])
def test_parts_that_do_not_exist_are_refused(part):
    for name, message in [
        ("mine", rf"{part} must be one of \w+(, \w+)*, or 'module:Class', got 'mine'"),
        ("no.such.module:Part", f"{part} must be .*; 'no.such.module:Part' cannot be found: No module"),
        ("my_parts:Other", f"{part} must be .*; 'my_parts:Other' cannot be found"),
        ("my_parts:number", f"{part} must be .*; 'my_parts:number' is not a function or class but int"),
        ("my_parts:make", f"{part} must be a class of torch.nn.Module, which 'my_parts:make' is not"),
        ("os:kill", f"{part} must be a class of torch.nn.Module"),
    ]:
        with pytest.raises(ValueError, match=message):
            DecentralizedPolicy(replace(PolicyConfig(), **{part: name}))


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"fov_radius": 2}, r"views are \(3, 7, 7\), this policy reads \(3, 11, 11\): .* fov_radius=4"),
        ({"extra_channels": ("cost_to_go",)}, r"views are \(4, 11, 11\), .* extra_channels=\(\)"),
        ({"robot_features": ()}, r"robots have 0 scalars, this policy reads 2: .*robot_features=\('on_goal', 'steps"),
        ({"memory": 3}, r"links have 17 features, this policy reads 12: .*edge_features=\('relative_.* memory=2"),
    ],
)
def test_a_bag_of_other_senses_is_refused_with_the_settings_that_fit(other, message):
    policy = seeded_policy(**RICH)
    bag = bags.random_bag(np.random.default_rng(0), [3], replace(policy.config, **other))
    with pytest.raises(ValueError, match=message):
        policy(bag)


def test_shapes_that_do_not_fit_each_other_are_refused():
    policy = seeded_policy(**RICH)
    bag = bags.random_bag(np.random.default_rng(0), [3], policy.config)
    with pytest.raises(jaxtyping.TypeCheckError):
        policy(bag._replace(scalars=bag.scalars[:2]))


@KINDS
@pytest.mark.parametrize("encoder", ENCODERS)
def test_a_bag_is_read_where_it_is_without_waiting_for_its_values(kind, encoder):
    """Shown on the meta device, whose tensors have no values to wait for: a GPU never has to stop."""
    policy = seeded_policy(encoder=encoder, **kind)
    bag = bags.random_bag(np.random.default_rng(0), [3, 4], policy.config)
    logits = policy.to("meta").train()(Bag(*(part.to("meta") for part in bag)))
    logits.sum().backward()
    assert logits.shape == (7, 5)
    assert logits.device.type == "meta"


def test_a_policy_has_the_settings_of_its_environment():
    config = PolicyConfig(encoder="lean", fov_radius=3, comm_radius=2.5, robot_features=("on_goal",))
    policy = DecentralizedPolicy(config, Execution(actions="stuck", shield="pibt", comm_range="connected"))
    assert policy.env_settings() == {
        "fov_radius": 3,
        "extra_channels": (),
        "robot_features": ("on_goal", "stuck"),
        "edge_features": (),
        "memory": 4,
        "comm_radius": 2.5,
        "comm_range": "connected",
        "comm_weights": "binary",
        "shield": "pibt",
    }
    assert DecentralizedPolicy(config).env_settings()["robot_features"] == ("on_goal",)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"taps": 0}, "taps"),
        ({"features": 0}, "features"),
        ({"fov_radius": 1}, "fov_radius"),
        ({"comm_radius": -1.0}, "comm_radius"),
        ({"comm_radius": 0.0, "comm_range": "connected"}, "comm_radius must be positive to grow"),
        ({"comm_range": "wide"}, "comm_range"),
        ({"comm_weights": "heavy"}, "comm_weights"),
        ({"comm_radius": float("nan")}, "comm_radius"),
        ({"extra_channels": ("smell",)}, "'smell' is not one of them"),
        ({"robot_features": ("smell",)}, "'smell' is not one of them"),
        ({"edge_features": ("smell",)}, "'smell' is not one of them"),
    ],
)
def test_bad_settings_are_refused_by_name(wrong, message):
    with pytest.raises((ValueError, jaxtyping.TypeCheckError), match=message):
        PolicyConfig(**wrong)


def test_the_released_encoder_refuses_views_that_it_would_pool_away():
    with pytest.raises(ValueError, match="fov_radius >= 3"):
        DecentralizedPolicy(PolicyConfig(fov_radius=2))


def test_the_settings_know_the_names_of_all_parts():
    assert tuple(network.ENCODERS) == policy_config.ENCODER_NAMES
    assert tuple(network.GRAPH_LAYERS) == policy_config.GRAPH_LAYER_NAMES
