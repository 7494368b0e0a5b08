"""A batch in two halves: the mean of two networks' gradients, whatever computes them."""

import copy
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import bags
from gnn_policy import DecentralizedPolicy, PolicyConfig, half_batches
from gnn_policy.half_batches import HalfBatches
from gnn_policy.imitation import EXPERT_ACTION, ImitationLoss

RICH = {
    "graph_layer": "attention",
    "robot_features": ("on_goal",),
    "edge_features": ("relative_position",),
}


def policy_with(**config):
    torch.manual_seed(0)
    return DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2, **config)).train()


def part_of(policy, sizes, seed=0):
    """A part of a batch: teams of these sizes and their labels."""
    generator = np.random.default_rng(seed)
    bag = bags.random_bag(generator, sizes, policy.config, share=0.5)
    labels = torch.from_numpy(generator.integers(5, size=sum(sizes)))
    return TensorDict({**bag._asdict(), EXPERT_ACTION: labels})


def halves_of(policy, *sizes, seed=0):
    return [part_of(policy, own, 100 * seed + number) for number, own in enumerate(sizes)]


def gradients(policy):
    return [weight.grad.clone() for weight in policy.parameters()]


def plain(policy, batch):
    """Gradients, loss and accuracy by a copy of the network, without halves."""
    network = copy.deepcopy(policy)
    outcome = ImitationLoss(network)(batch)
    outcome["loss_imitation"].backward()
    return gradients(network), outcome["loss_imitation"].item(), outcome["accuracy"].item(), network


@pytest.mark.parametrize("sizes", [([3, 3], [3, 3]), ([3] * 3, [3] * 4), ([5, 1, 2], [12]), ([2] * 16, [4] * 16)])
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("config", [{}, RICH], ids=["paper", "attention"])
def test_the_gradients_are_the_mean_over_all_robots_of_the_halves(sizes, threads, config):
    policy = policy_with(**config)
    parts = halves_of(policy, *sizes)
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", threads)
    first, second = (plain(policy, part) for part in parts)
    robots = sum(map(sum, sizes))
    shares = [sum(own) / robots for own in sizes]
    for _ in range(3):  # in turn at first, at once then
        loss, accuracy = halves.backward(parts).tolist()
        for gradient, one, two in zip(gradients(policy), first[0], second[0], strict=True):
            torch.testing.assert_close(gradient, shares[0] * one + shares[1] * two)
        assert loss == pytest.approx(shares[0] * first[1] + shares[1] * second[1])
        assert accuracy == pytest.approx(shares[0] * first[2] + shares[1] * second[2])
    halves.close()


def test_running_statistics_are_those_of_the_first_half_and_steps_reach_both():
    policy = policy_with()
    parts = halves_of(policy, [3] * 4, [3] * 4)
    _, _, _, first = plain(policy, parts[0])
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", 2)
    halves.backward(parts)
    for (name, buffer), expected in zip(policy.named_buffers(), first.buffers(), strict=True):
        assert torch.equal(buffer, expected), name
    optimizer = torch.optim.Adam(policy.parameters(), 0.1, fused=True)
    optimizer.step()
    expected = [(1 / 2) * (one + two) for one, two in zip(*(plain(policy, part)[0] for part in parts), strict=True)]
    halves.backward(parts)
    for gradient, mean in zip(gradients(policy), expected, strict=True):
        torch.testing.assert_close(gradient, mean)
    halves.close()


@pytest.mark.parametrize("graph_layer", ["filter", "attention", "own_layers:Forgetful"])
def test_results_are_bit_identical_on_any_number_of_threads(graph_layer):
    trained = []
    for threads in (1, 2, 2):
        policy = policy_with(graph_layer=graph_layer)
        halves = HalfBatches(policy, ImitationLoss(policy), "float32", threads)
        optimizer = torch.optim.Adam(policy.parameters(), 0.01, fused=True)
        torch.manual_seed(5)
        losses = []
        for step in range(8):
            losses.append(halves.backward(halves_of(policy, [3] * 8, [2] * 8, seed=step))[0].item())
            optimizer.step()
        halves.close()
        trained.append((losses, policy.state_dict()))
    for losses, weights in trained[1:]:
        assert losses == trained[0][0]
        assert all(torch.equal(weights[name], trained[0][1][name]) for name in weights)


@pytest.mark.parametrize("sizes", [[3], [2, 4], [1, 3, 2]])
def test_small_batches_stay_whole(sizes):
    policy = policy_with()
    (part,) = parts = halves_of(policy, sizes)
    expected, loss, accuracy, _ = plain(policy, part)
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", 2)
    assert halves.backward(parts).tolist() == [pytest.approx(loss), pytest.approx(accuracy)]
    for gradient, whole in zip(gradients(policy), expected, strict=True):
        torch.testing.assert_close(gradient, whole)
    halves.close()


def test_returned_arrays_need_no_gradient():
    policy = policy_with()
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", 2)
    figures = halves.backward(halves_of(policy, [3] * 2, [3] * 2))
    halves.close()
    assert figures.shape == (2,)
    assert not figures.requires_grad


def test_loss_and_gradients_stay_on_the_device_of_the_policy(monkeypatch):
    """Shown on the meta device, whose values cannot be read."""
    monkeypatch.setattr(half_batches, "autocast", lambda *_: nullcontext())  # it refuses the meta device
    policy = policy_with(**RICH)
    parts = [part.to("meta") for part in halves_of(policy, [3] * 2, [3] * 2)]
    policy.to("meta")
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", 1)
    figures = halves.backward(parts)
    halves.close()
    assert figures.device.type == "meta"
    assert {gradient.device.type for gradient in gradients(policy)} == {"meta"}


@pytest.mark.parametrize("wrong", [0, 1])
def test_an_error_in_either_half_is_raised(wrong):
    policy = policy_with()
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", 2)
    parts = halves_of(policy, [3] * 4, [3] * 4)
    halves.backward(parts)
    parts[wrong][EXPERT_ACTION] = torch.full((12,), 9)  # pyright: ignore[reportArgumentType, reportCallIssue]
    with pytest.raises(IndexError):
        halves.backward(parts)
    halves.close()
