"""A batch in two halves: the mean of two networks' gradients, whatever computes them."""

import copy

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from gnn_policy import DecentralizedPolicy, PolicyConfig
from gnn_policy.demonstrations import EXPERT_ACTION
from gnn_policy.half_batches import HalfBatches
from gnn_policy.imitation import ImitationLoss
from gnn_policy.team_env import FOV, GRAPH


def policy_with(**config):
    torch.manual_seed(0)
    return DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2, **config)).train()


def batch_of(size, robots=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return TensorDict(
        {
            FOV: (torch.rand(size, robots, 3, 7, 7, generator=generator) < 0.3).to(torch.uint8),
            GRAPH: (torch.rand(size, robots, robots, generator=generator) < 0.5).float(),
            EXPERT_ACTION: torch.randint(5, (size, robots), generator=generator),
        },
        batch_size=[size],
    )


def gradients(policy):
    return [weight.grad.clone() for weight in policy.parameters()]


def plain(policy, batch):
    """Gradients, loss and accuracy by a copy of the network, without halves."""
    network = copy.deepcopy(policy)
    outcome = ImitationLoss(network)(batch)
    outcome["loss_imitation"].backward()
    return gradients(network), outcome["loss_imitation"].item(), outcome["accuracy"].item(), network


@pytest.mark.parametrize("size", [4, 7, 32])
@pytest.mark.parametrize("threads", [1, 2])
def test_the_gradients_are_the_mean_of_the_halves(size, threads):
    policy, batch = policy_with(), batch_of(size)
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", threads)
    middle = size // 2
    first, second = plain(policy, batch[:middle]), plain(policy, batch[middle:])
    for _ in range(3):  # in turn at first, at once then
        loss, accuracy = halves.backward(batch)
        shares = (middle / size, 1 - middle / size)
        for gradient, one, two in zip(gradients(policy), first[0], second[0], strict=True):
            torch.testing.assert_close(gradient, shares[0] * one + shares[1] * two)
        assert loss == pytest.approx(shares[0] * first[1] + shares[1] * second[1])
        assert accuracy == pytest.approx(shares[0] * first[2] + shares[1] * second[2])
    halves.close()


def test_running_statistics_are_those_of_the_first_half_and_steps_reach_both():
    policy, batch = policy_with(), batch_of(8)
    _, _, _, first = plain(policy, batch[:4])
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", 2)
    halves.backward(batch)
    for (name, buffer), expected in zip(policy.named_buffers(), first.buffers(), strict=True):
        assert torch.equal(buffer, expected), name
    optimizer = torch.optim.Adam(policy.parameters(), 0.1, fused=True)
    optimizer.step()
    expected = [
        (1 / 2) * (one + two) for one, two in zip(*(plain(policy, part)[0] for part in batch.split(4)), strict=True)
    ]
    halves.backward(batch)
    for gradient, mean in zip(gradients(policy), expected, strict=True):
        torch.testing.assert_close(gradient, mean)
    halves.close()


@pytest.mark.parametrize("graph_layer", ["filter", "own_layers:Forgetful"])
def test_the_number_of_threads_changes_no_bit(graph_layer):
    trained = []
    for threads in (1, 2, 2):
        policy = policy_with(graph_layer=graph_layer)
        halves = HalfBatches(policy, ImitationLoss(policy), "float32", threads)
        optimizer = torch.optim.Adam(policy.parameters(), 0.01, fused=True)
        torch.manual_seed(5)
        losses = []
        for step in range(8):
            losses.append(halves.backward(batch_of(16, seed=step))[0])
            optimizer.step()
        halves.close()
        trained.append((losses, policy.state_dict()))
    for losses, weights in trained[1:]:
        assert losses == trained[0][0]
        assert all(torch.equal(weights[name], trained[0][1][name]) for name in weights)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_small_batches_stay_whole(size):
    policy, batch = policy_with(), batch_of(size)
    expected, loss, accuracy, _ = plain(policy, batch)
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", 2)
    assert halves.backward(batch) == (pytest.approx(loss), pytest.approx(accuracy))
    for gradient, whole in zip(gradients(policy), expected, strict=True):
        torch.testing.assert_close(gradient, whole)
    halves.close()


def test_an_error_in_either_half_is_raised():
    policy = policy_with()
    halves = HalfBatches(policy, ImitationLoss(policy), "float32", 2)
    halves.backward(batch_of(8))
    wrong = batch_of(8)
    wrong[EXPERT_ACTION] = torch.from_numpy(np.full((8, 3), 9))
    with pytest.raises(IndexError):
        halves.backward(wrong)
    halves.close()
