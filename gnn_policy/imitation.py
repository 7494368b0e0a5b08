"""The imitation loss: cross-entropy between every robot's softmax and the expert's move."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.objectives import LossModule

from gnn_policy.demonstrations import EXPERT_ACTION
from gnn_policy.team_env import FOV, GRAPH


class ImitationLoss(LossModule):
    """Mean cross-entropy over all robots, and the share of moves that agree with the expert's.

    Reads `FOV`, `GRAPH` and `EXPERT_ACTION`; writes "loss_imitation" and "accuracy". TorchRL's own BCLoss fails on
    categorical multi-agent actors.
    """

    def __init__(self, policy: nn.Module) -> None:
        super().__init__()
        self.policy = policy
        self.in_keys = [FOV, GRAPH, EXPERT_ACTION]  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = ["loss_imitation", "accuracy"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss of a batch of team states."""
        logits = self.policy(tensordict[FOV], tensordict[GRAPH]).flatten(0, 1).float()
        labels = tensordict[EXPERT_ACTION].flatten()
        loss = torch.nn.functional.cross_entropy(logits, labels)
        accuracy = (logits.detach().argmax(-1) == labels).float().mean()
        return TensorDict({"loss_imitation": loss, "accuracy": accuracy})
