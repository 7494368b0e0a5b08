"""The imitation loss is the cross-entropy, reaches every weight, and can be driven to nothing."""

import math
from typing import Literal

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from gnn_policy import DecentralizedPolicy, PolicyConfig
from gnn_policy.demonstrations import EXPERT_ACTION
from gnn_policy.imitation import ImitationLoss
from gnn_policy.team_env import FOV, GRAPH


def random_batch(teams=6, robots=3, seed=0):
    generator = np.random.default_rng(seed)
    graph = np.triu(generator.integers(0, 2, (teams, robots, robots)), 1)
    tensors = {
        FOV: torch.from_numpy(generator.integers(0, 2, (teams, robots, 3, 11, 11), dtype=np.uint8)),
        GRAPH: torch.from_numpy((graph + graph.transpose(0, 2, 1)).astype(np.float32)),
        EXPERT_ACTION: torch.from_numpy(generator.integers(0, 5, (teams, robots))),
    }
    return TensorDict(tensors, batch_size=[teams])


def small_policy(encoder: Literal["released", "lean"] = "lean", taps=3):
    torch.manual_seed(0)
    return DecentralizedPolicy(PolicyConfig(encoder=encoder, features=16, taps=taps))


def test_it_is_the_mean_negative_log_probability_of_the_experts_moves():
    policy, batch = small_policy().eval(), random_batch()
    outcome = ImitationLoss(policy)(batch)
    with torch.no_grad():
        logits = policy(batch[FOV], batch[GRAPH]).double().tolist()
    surprises, agreements = [], []
    for team, labels in enumerate(batch[EXPERT_ACTION].tolist()):
        for robot, label in enumerate(labels):
            row = logits[team][robot]
            surprises.append(math.log(sum(map(math.exp, row))) - row[label])
            agreements.append(row.index(max(row)) == label)
    assert outcome["loss_imitation"].item() == pytest.approx(np.mean(surprises), rel=1e-5)
    assert outcome["accuracy"].item() == pytest.approx(np.mean(agreements))
    assert not outcome["accuracy"].requires_grad


@pytest.mark.parametrize("encoder", ["released", "lean"])
def test_the_gradient_reaches_every_weight(encoder):
    policy = small_policy(encoder).train()
    loss = ImitationLoss(policy)
    loss(random_batch())["loss_imitation"].backward()
    weights = dict(policy.named_parameters())
    assert set(map(id, weights.values())) == set(map(id, loss.parameters()))
    for name, weight in weights.items():
        assert weight.grad is not None, name
        if not (name.startswith("encoder") and name.endswith("bias")):  # batch norm swallows a convolution's bias
            assert weight.grad.abs().max() > 0, name


def test_a_few_states_are_learnt_by_heart():
    policy, batch = small_policy().train(), random_batch(teams=4)
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
