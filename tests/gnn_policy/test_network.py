"""The network's laws: weights for any team, symmetry between robots, and a reach of K - 1 hops."""

import sys
from collections import deque
from dataclasses import replace
from types import ModuleType

import jaxtyping
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gnn_policy import DecentralizedPolicy, GraphFilter, PolicyConfig, network, policy_config, shift_operator

few = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])

ENCODERS = ("released", "lean")


def seeded_policy(seed=0, **config):
    torch.manual_seed(seed)
    return DecentralizedPolicy(PolicyConfig(**{"features": 16, **config})).eval()


def random_views(generator, teams, robots, radius=4):
    side = 2 * radius + 3
    return torch.from_numpy(generator.integers(0, 2, (teams, robots, 3, side, side), dtype=np.uint8))


def random_graph(generator, robots, share=0.4):
    upper = np.triu(generator.random((robots, robots)) < share, 1)
    return torch.from_numpy((upper | upper.T).astype(np.float32))


def hops_from(graph, start):
    """Breadth-first distances over a graph (N, N); robots out of reach are absent."""
    distance, queue = {start: 0}, deque([start])
    while queue:
        here = queue.popleft()
        for there in range(len(graph)):
            if graph[here, there] > 0 and there not in distance:
                distance[there] = distance[here] + 1
                queue.append(there)
    return distance


@pytest.mark.parametrize(("taps", "count"), [(1, 173_733), (2, 190_117), (3, 206_501)])
def test_the_released_network_has_the_papers_number_of_weights(taps, count):
    policy = DecentralizedPolicy(PolicyConfig(taps=taps))
    assert sum(weights.numel() for weights in policy.parameters() if weights.requires_grad) == count
    for robots in (1, 14):
        logits = policy.eval()(torch.zeros(1, robots, 3, 11, 11), torch.zeros(1, robots, robots))
        assert logits.shape == (1, robots, 5)


@pytest.mark.parametrize("encoder", ENCODERS)
@few
@given(seed=st.integers(0, 2**32 - 1), robots=st.integers(1, 7), taps=st.integers(1, 4))
def test_permuting_robots_permutes_logits(encoder, seed, robots, taps):
    generator = np.random.default_rng(seed)
    policy = seeded_policy(seed, encoder=encoder, taps=taps)
    views, graph = random_views(generator, 1, robots), random_graph(generator, robots)[None]
    order = generator.permutation(robots)
    with torch.no_grad():
        logits, permuted = policy(views, graph), policy(views[:, order], graph[:, order][:, :, order])
    torch.testing.assert_close(permuted, logits[:, order], rtol=1e-4, atol=1e-5)


def test_one_tap_does_not_communicate():
    generator = np.random.default_rng(0)
    policy, views = seeded_policy(taps=1), random_views(generator, 2, 5)
    with torch.no_grad():
        silent = policy(views, torch.zeros(2, 5, 5))
        loud = policy(views, torch.stack([random_graph(generator, 5), torch.ones(5, 5) - torch.eye(5)]))
    assert torch.equal(silent, loud)


@pytest.mark.parametrize("taps", [1, 2, 3, 4])
def test_logits_depend_on_exactly_the_robots_within_taps_minus_one_hops(taps):
    generator = np.random.default_rng(taps)
    policy = seeded_policy(taps=taps)
    robots = 7
    path = torch.from_numpy(np.eye(robots, k=1, dtype=np.float32) + np.eye(robots, k=-1, dtype=np.float32))
    random = random_graph(generator, robots, 0.3)
    for graph in (path, random):
        views = random_views(generator, 1, robots)
        with torch.no_grad():
            before = policy(views, graph[None])[0]
            for changed in range(robots):
                altered = views.clone()
                altered[0, changed] = 1 - altered[0, changed]
                moved = (policy(altered, graph[None])[0] - before).abs().amax(-1)
                reach = {robot for robot, hops in hops_from(graph, changed).items() if hops < taps}
                felt = {robot for robot in range(robots) if moved[robot] > 1e-7}
                assert felt == reach, f"a change of robot {changed} is felt by {felt}, not by {reach}"


def test_a_robot_out_of_range_changes_nothing():
    generator = np.random.default_rng(3)
    policy = seeded_policy()
    views, graph = random_views(generator, 1, 5), random_graph(generator, 5)[None]
    wider = torch.zeros(1, 6, 6)
    wider[:, :5, :5] = graph
    with torch.no_grad():
        alone = policy(views, graph)
        accompanied = policy(torch.cat([views, random_views(generator, 1, 1)], 1), wider)
    torch.testing.assert_close(accompanied[:, :5], alone, rtol=1e-5, atol=1e-6)


@few
@given(seed=st.integers(0, 2**32 - 1), taps=st.integers(1, 4), robots=st.integers(1, 5))
def test_the_filter_is_the_sum_over_taps_of_shifted_signals(seed, taps, robots):
    generator = np.random.default_rng(seed)
    graph_filter = GraphFilter(3, 4, taps).double()
    signal = generator.normal(size=(2, robots, 3))
    graph = torch.stack([random_graph(generator, robots) for _ in range(2)]).double()
    shift = shift_operator(graph).numpy()
    weights = graph_filter.mix.weight.detach().numpy().T.reshape(taps, 3, 4)
    bias = graph_filter.mix.bias.detach().numpy()
    with torch.no_grad():
        result = graph_filter(torch.from_numpy(signal), graph).numpy()
    for b in range(2):
        expected = np.tile(bias, (robots, 1))
        for k in range(taps):
            expected = expected + np.linalg.matrix_power(shift[b], k) @ signal[b] @ weights[k]
        np.testing.assert_allclose(result[b], expected, rtol=1e-9, atol=1e-9)


@few
@given(seed=st.integers(0, 2**32 - 1), robots=st.integers(1, 7), share=st.floats(0, 1))
def test_the_shift_operator_is_the_normalised_adjacency(seed, robots, share):
    generator = np.random.default_rng(seed)
    graph = random_graph(generator, robots, share) * float(generator.uniform(0.1, 1.1))
    adjacency = graph.numpy().astype(np.float64)
    shift = shift_operator(graph[None])[0].numpy()
    degree = adjacency.sum(1)
    for i in range(robots):
        for j in range(robots):
            expected = adjacency[i, j] / np.sqrt(degree[i] * degree[j]) if adjacency[i, j] > 0 else 0.0
            assert shift[i, j] == pytest.approx(expected, abs=1e-6)
        if degree[i] == 0:
            assert not shift[i].any()
            assert not shift[:, i].any()


@pytest.mark.parametrize("encoder", ENCODERS)
def test_views_of_bytes_and_of_floats_give_the_same_logits(encoder):
    generator = np.random.default_rng(1)
    policy, views, graph = seeded_policy(encoder=encoder), random_views(generator, 3, 4), torch.zeros(3, 4, 4)
    with torch.no_grad():
        assert torch.equal(policy(views, graph), policy(views.float(), graph))


@pytest.mark.parametrize(
    ("encoder", "radius"), [("released", 3), ("released", 5), ("lean", 2), ("lean", 3), ("lean", 6)]
)
def test_the_encoders_read_views_of_other_sizes(encoder, radius):
    policy = seeded_policy(encoder=encoder, fov_radius=radius)
    views = random_views(np.random.default_rng(0), 2, 3, radius)
    assert policy(views, torch.zeros(2, 3, 3)).shape == (2, 3, 5)


class Means(torch.nn.Module):
    """A graph layer of one's own: a robot's features beside the sum over its neighbours' at each hop."""

    def __init__(self, in_features, out_features, taps):
        super().__init__()
        self.mix, self.taps = torch.nn.Linear(in_features, out_features), taps

    def forward(self, signal, graph):
        for _ in range(self.taps - 1):
            signal = signal + graph @ signal
        return self.mix(signal)


class Flat(torch.nn.Sequential):
    """An encoder of one's own."""

    def __init__(self, channels, side, features):
        super().__init__(torch.nn.Flatten(), torch.nn.Linear(channels * side * side, features))


@pytest.fixture
def my_parts(monkeypatch):
    module = ModuleType("my_parts")
    module.Means, module.Flat, module.number, module.make = Means, Flat, 5, lambda *sizes: Means(*sizes)  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "my_parts", module)


@pytest.mark.usefixtures("my_parts")
def test_parts_of_ones_own_have_their_place():
    policy = seeded_policy(encoder="my_parts:Flat", graph_layer="my_parts:Means", taps=2, fov_radius=3)
    generator = np.random.default_rng(0)
    views, graph = random_views(generator, 2, 4, radius=3), random_graph(generator, 4).expand(2, 4, 4)
    with torch.no_grad():
        features = policy.encoder(views.float().flatten(0, 1)).unflatten(0, (2, 4))
        expected = policy.head(torch.relu(policy.filter(features, graph)))
        torch.testing.assert_close(policy(views, graph), expected)
    assert isinstance(policy.encoder, Flat)
    assert isinstance(policy.filter, Means)


@pytest.mark.usefixtures("my_parts")
@pytest.mark.parametrize("part", ["encoder", "graph_layer"])
def test_parts_that_are_none_are_refused(part):
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


def test_shapes_that_do_not_fit_are_refused():
    policy = seeded_policy()
    with pytest.raises(jaxtyping.TypeCheckError):
        policy(torch.zeros(2, 3, 3, 11, 11), torch.zeros(2, 4, 4))


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
