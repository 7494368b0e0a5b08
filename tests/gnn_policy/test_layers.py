"""The graph layers against dense and plain readings of their definitions, and against torch_geometric."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import bags
from gnn_policy import Attention, DecentralizedPolicy, GraphFilter, PolicyConfig
from gnn_policy.layers import GRAPH_LAYERS, MessageLayer, exchange_in_parts
from mapf_env import Bag, Senses

few = settings(max_examples=25)
EDGES = Senses(fov_radius=1, edge_features=("relative_position", "on_goal"))

sizes = st.lists(st.integers(1, 6), min_size=1, max_size=4)


def made(kind, taps, in_features=8, out_features=8, seed=0):
    torch.manual_seed(seed)
    return GRAPH_LAYERS[kind](in_features, out_features, taps, EDGES.num_edge_features).eval()


def features_of(generator, bag, width=8):
    return torch.from_numpy(generator.normal(size=(len(bag.team), width)).astype(np.float32))


@pytest.mark.parametrize("kind", GRAPH_LAYERS)
def test_the_layers_of_the_package_work_by_messages(kind):
    layer = made(kind, 3)
    assert isinstance(layer, MessageLayer)
    assert layer.rounds == 2


def filtered(layer, features, dense):
    """Sum of S^k X A_k with S = D^-1/2 A D^-1/2 of a dense adjacency; isolated robots have no shift."""
    weights, bias = (each.detach().double().numpy() for each in (layer.mix.weight, layer.mix.bias))
    taps = layer.rounds + 1
    degree = dense.sum(axis=1)
    root = np.array([1 / math.sqrt(d) if d > 0 else 0.0 for d in degree])
    shift = np.diag(root) @ dense @ np.diag(root)
    signal = features.double().numpy()
    parts = weights.T.reshape(taps, signal.shape[1], -1)
    return bias + sum(np.linalg.matrix_power(shift, k) @ signal @ parts[k] for k in range(taps))


@few
@given(
    seed=st.integers(0, 2**32 - 1),
    sizes=sizes,
    taps=st.integers(1, 4),
    share=st.floats(0, 1),
    weighted=st.booleans(),
    directed=st.booleans(),
)
def test_the_filter_is_the_dense_sum_over_taps_of_shifted_features(seed, sizes, taps, share, weighted, directed):
    generator = np.random.default_rng(seed)
    bag = bags.random_bag(generator, sizes, EDGES, share=share, weighted=weighted, directed=directed)
    bag = bags.permuted(bag, np.arange(sum(sizes)), generator)  # links in any order
    layer, features = made("filter", taps), features_of(generator, bag)
    expected = filtered(layer, features, bags.adjacency(bag))
    with torch.no_grad():
        np.testing.assert_allclose(layer(features, bag).numpy(), expected, rtol=1e-5, atol=1e-5)
        exact = layer.double()(features.double(), bag._replace(edge_weight=bag.edge_weight.double()))
    np.testing.assert_allclose(exact.numpy(), expected, rtol=1e-9, atol=1e-9)


def test_the_papers_filter_of_128_features_is_the_dense_one():
    generator = np.random.default_rng(0)
    bag = bags.random_bag(generator, [50, 30], EDGES, share=0.2)
    layer, features = made("filter", 3, 128, 128), features_of(generator, bag, 128)
    with torch.no_grad():
        result = layer(features, bag).numpy()
    np.testing.assert_allclose(result, filtered(layer, features, bags.adjacency(bag)), rtol=1e-5, atol=1e-5)


def normalised(norm, row):
    centred = row - row.mean()
    return centred / math.sqrt((centred**2).mean() + norm.eps) * norm.weight.numpy() + norm.bias.numpy()


def linear(layer, row):
    return layer.weight.double().numpy() @ row + (0 if layer.bias is None else layer.bias.double().numpy())


def attended(attention, features, bag):
    """Attention robot by robot and head by head, from its definition."""
    state = features.double().numpy()
    hears = [[] for _ in state]
    for link, (sender, receiver) in enumerate(bag.edge_index.T.tolist()):
        hears[receiver].append((sender, bag.edge_attr[link].double().numpy()))
    heads = attention.heads
    width = state.shape[1] // heads
    for layer in attention.layers:
        calm = [normalised(layer.norm, row) for row in state]
        following = []
        for robot, row in enumerate(calm):
            gathered = np.zeros_like(row)
            messages = [linear(layer.message, calm[sender]) + linear(layer.edge, attr) for sender, attr in hears[robot]]
            for head in range(heads if messages else 0):
                part = slice(head * width, (head + 1) * width)
                scores = []
                for message in messages:
                    hidden = linear(layer.own, row)[part] + message[part]
                    hidden = np.where(hidden > 0, hidden, 0.2 * hidden)
                    scores.append(math.exp(float(hidden @ layer.score[head].double().numpy())))
                for score, message in zip(scores, messages, strict=True):
                    gathered[part] += score / sum(scores) * message[part]
            first, _, second = layer.update
            inner = linear(first, np.concatenate([row, gathered]))
            following.append(state[robot] + linear(second, np.maximum(inner, 0)))
        state = np.array(following)
    return np.array([linear(attention.last, row) for row in state])


@few
@given(
    seed=st.integers(0, 2**32 - 1), sizes=sizes, taps=st.integers(1, 3), share=st.floats(0, 1), directed=st.booleans()
)
def test_attention_is_a_softmax_over_incoming_links_for_each_head(seed, sizes, taps, share, directed):
    generator = np.random.default_rng(seed)
    bag = bags.random_bag(generator, sizes, EDGES, share=share, directed=directed)
    layer, features = made("attention", taps, 8, 6, seed), features_of(generator, bag)
    with torch.no_grad():
        for name, weight in layer.named_parameters():
            if "norm" in name:
                weight.add_(torch.randn_like(weight) / 4)
        result = layer(features, bag).numpy()
        np.testing.assert_allclose(result, attended(layer, features, bag), rtol=1e-4, atol=1e-5)


def test_attention_ignores_the_weights_of_links_and_reads_their_features():
    generator = np.random.default_rng(1)
    bag = bags.random_bag(generator, [6], EDGES, weighted=True)
    layer, features = made("attention", 2), features_of(generator, bag)
    with torch.no_grad():
        result = layer(features, bag)
        assert torch.equal(layer(features, bag._replace(edge_weight=bag.edge_weight * 3)), result)
        other = layer(features, bag._replace(edge_attr=bag.edge_attr * 3))
    changed = (other - result).abs().amax(1) > 1e-6
    assert set(torch.nonzero(changed).flatten().tolist()) == set(bag.edge_index[1].tolist())


def test_attention_without_edge_features_needs_none():
    generator = np.random.default_rng(1)
    bag = bags.random_bag(generator, [6], Senses(fov_radius=1))
    assert Attention(8, 8, 2)(features_of(generator, bag), bag).shape == (6, 8)


def test_scores_beyond_the_range_of_the_exponential_are_safe():
    generator = np.random.default_rng(2)
    bag = bags.random_bag(generator, [5, 1], EDGES, share=0.9)
    layer, features = made("attention", 2), features_of(generator, bag)
    with torch.no_grad():
        layer.layers[0].score.mul_(1e4)
    features.requires_grad_()
    result = layer(features, bag)
    result.sum().backward()
    assert torch.isfinite(result).all()
    assert torch.isfinite(features.grad).all()  # pyright: ignore[reportArgumentType]


def test_features_that_heads_cannot_share_are_refused():
    with pytest.raises(ValueError, match="features must be a multiple of the 4 attention heads, got 10"):
        DecentralizedPolicy(PolicyConfig(graph_layer="attention", features=10))


@pytest.mark.parametrize("kind", GRAPH_LAYERS)
@few
@given(seed=st.integers(0, 2**32 - 1), sizes=sizes, taps=st.integers(1, 4))
def test_teams_together_are_each_team_alone(kind, seed, sizes, taps):
    generator = np.random.default_rng(seed)
    bag = bags.random_bag(generator, sizes, EDGES, weighted=True)
    layer, features = made(kind, taps), features_of(generator, bag)
    with torch.no_grad():
        together = layer(features, bag)
        alone = [layer(part, own) for part, own in zip(features.split(sizes), bags.split(bag), strict=True)]
    torch.testing.assert_close(torch.cat(alone), together, rtol=1e-5, atol=1e-5)


@few
@given(st.sampled_from(sorted(GRAPH_LAYERS)), st.integers(0, 10**6), sizes, st.integers(1, 4), st.integers(1, 9))
def test_robots_in_parts_exchange_what_they_do_at_once(kind, seed, sizes, taps, at_once):
    generator, layer = np.random.default_rng(seed), made(kind, taps)
    bag = bags.random_bag(generator, sizes, EDGES, share=0.5, weighted=True, directed=True)
    if seed % 2:
        bag = bags.permuted(bag, np.arange(sum(sizes)), generator)  # links in any order
    features = features_of(generator, bag)
    with torch.no_grad():
        whole = layer(features, bag)
        parts = list(exchange_in_parts(layer, iter(features.split(at_once)), bag, at_once))
    assert [len(part) for part in parts] == [len(part) for part in features.split(at_once)]
    torch.testing.assert_close(torch.cat(parts), whole)


@pytest.mark.parametrize("kind", GRAPH_LAYERS)
def test_gradients_reach_every_weight_and_are_finite_where_robots_hear_nobody(kind):
    generator = np.random.default_rng(3)
    bag = bags.random_bag(generator, [6, 1], EDGES)
    layer, features = made(kind, 3).train(), features_of(generator, bag).requires_grad_()
    (layer(features, bag) ** 2).sum().backward()
    for name, weight in layer.named_parameters():
        assert weight.grad is not None, name
        assert torch.isfinite(weight.grad).all(), name
        assert weight.grad.abs().max() > 0, name
    assert torch.isfinite(features.grad).all()  # pyright: ignore[reportArgumentType]
    assert features.grad.abs().amax(1).min() > 0  # pyright: ignore[reportOptionalMemberAccess]


@pytest.mark.parametrize("kind", GRAPH_LAYERS)
def test_under_autocast_results_are_those_of_float32_to_the_precision_of_bfloat16(kind):
    generator = np.random.default_rng(4)
    bag = bags.random_bag(generator, [8, 5], EDGES)
    layer, features = made(kind, 3), features_of(generator, bag)
    with torch.no_grad():
        expected = layer(features, bag)
    with torch.autocast("cpu", torch.bfloat16):
        result = layer(features.bfloat16(), bag)
    torch.testing.assert_close(result.float(), expected, rtol=0.1, atol=0.1)
    result.float().sum().backward()
    assert {weight.grad.dtype for weight in layer.parameters() if weight.grad is not None} == {torch.float32}


@pytest.mark.parametrize("directed", [False, True])
def test_the_filter_is_torch_geometrics_tag_convolution(directed):
    geometric = pytest.importorskip("torch_geometric.nn")
    generator = np.random.default_rng(5)
    bag = bags.random_bag(generator, [9, 4, 1], EDGES, weighted=True, directed=directed)
    layer, features = GraphFilter(8, 6, 3), features_of(generator, bag)
    theirs = geometric.TAGConv(8, 6, K=2)
    with torch.no_grad():
        for k, part in enumerate(theirs.lins):
            part.weight.copy_(layer.mix.weight[:, 8 * k : 8 * k + 8])
        theirs.bias.copy_(layer.mix.bias)
        expected = theirs(features, bag.edge_index, bag.edge_weight)
        torch.testing.assert_close(layer(features, bag), expected, rtol=1e-5, atol=1e-5)


def test_links_have_the_direction_that_torch_geometric_gives_them():
    """Row 0 of `edge_index` sends and row 1 hears, in our layers and in theirs."""
    geometric = pytest.importorskip("torch_geometric.nn")
    bag = Bag(
        *(torch.zeros(3, 0), torch.zeros(3, 0)),
        edge_index=torch.tensor([[0], [2]]),  # pyright: ignore[reportArgumentType]
        edge_weight=torch.ones(1),
        edge_attr=torch.zeros(1, 3),
        team=torch.zeros(3, dtype=torch.int64),
    )
    features = torch.randn(3, 8, generator=torch.Generator().manual_seed(0), requires_grad=True)
    for layer in (lambda x: made("attention", 2)(x, bag), lambda x: geometric.GATv2Conv(8, 8)(x, bag.edge_index)):
        (gradient,) = torch.autograd.grad(layer(features)[2].sum(), features)
        assert (gradient.abs().amax(1) > 0).tolist() == [True, False, True]
        (gradient,) = torch.autograd.grad(layer(features)[0].sum(), features)
        assert (gradient.abs().amax(1) > 0).tolist() == [True, False, False]
