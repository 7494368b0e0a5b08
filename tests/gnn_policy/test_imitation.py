"""The imitation loss is the cross-entropy, reaches every weight, and can be driven to nothing."""

import math
from typing import Literal

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import bags
from gnn_policy import DecentralizedPolicy, PolicyConfig
from gnn_policy.imitation import EXPERT_ACTION, ImitationLoss
from mapf_env import Bag


def random_batch(policy, sizes=(3, 1, 5, 3, 2, 4), seed=0):
    generator = np.random.default_rng(seed)
    bag = bags.random_bag(generator, sizes, policy.config)
    return TensorDict({**bag._asdict(), EXPERT_ACTION: torch.from_numpy(generator.integers(0, 5, sum(sizes)))})


def small_policy(encoder: Literal["released", "lean"] = "lean", **config):
    torch.manual_seed(0)
    return DecentralizedPolicy(PolicyConfig(encoder=encoder, features=16, **config))


def test_it_is_the_mean_negative_log_probability_of_the_experts_moves_over_all_robots():
    policy = small_policy().eval()
    batch = random_batch(policy)
    outcome = ImitationLoss(policy)(batch)
    with torch.no_grad():
        logits = policy(Bag(*(batch[name] for name in Bag._fields))).double().tolist()
    surprises, agreements = [], []
    for row, label in zip(logits, batch[EXPERT_ACTION].tolist(), strict=True):
        surprises.append(math.log(sum(map(math.exp, row))) - row[label])
        agreements.append(row.index(max(row)) == label)
    assert outcome["loss_imitation"].item() == pytest.approx(np.mean(surprises), rel=1e-5)
    assert outcome["accuracy"].item() == pytest.approx(np.mean(agreements))
    assert not outcome["accuracy"].requires_grad


RICH = {"graph_layer": "attention", "edge_features": ("relative_position",), "robot_features": ("last_moves",)}


@pytest.mark.parametrize("config", [{}, RICH], ids=["paper", "attention"])
@pytest.mark.parametrize("encoder", ["released", "lean"])
def test_the_gradient_reaches_every_weight(encoder, config):
    policy = small_policy(encoder, **config).train()
    loss = ImitationLoss(policy)
    loss(random_batch(policy))["loss_imitation"].backward()
    weights = dict(policy.named_parameters())
    assert set(map(id, weights.values())) == set(map(id, loss.parameters()))
    for name, weight in weights.items():
        assert weight.grad is not None, name
        if not (name.startswith("encoder") and name.endswith("bias")):  # batch norm swallows a convolution's bias
            assert weight.grad.abs().max() > 0, name


@pytest.mark.parametrize("config", [{}, RICH], ids=["paper", "attention"])
def test_a_few_states_are_learnt_by_heart(config):
    policy = small_policy(**config).train()
    batch = random_batch(policy, [3, 2, 4, 3])
    loss = ImitationLoss(policy)
    optimizer = torch.optim.Adam(policy.parameters(), lr=3e-3)
    outcome = loss(batch)
    for _ in range(60):
        optimizer.zero_grad()
        outcome["loss_imitation"].backward()
        optimizer.step()
        outcome = loss(batch)
    assert outcome["loss_imitation"] < 0.05
    assert outcome["accuracy"] == 1
