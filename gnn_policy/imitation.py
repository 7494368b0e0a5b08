"""The imitation loss: cross-entropy between every robot's softmax and the expert's move."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.objectives import LossModule

from mapf_env import Bag

EXPERT_ACTION = "expert_action"


class ImitationLoss(LossModule):
    """Mean cross-entropy over all robots of a bag, and the share of moves that agree with the expert's.

    Reads the fields of a `mapf_env.Bag` and `EXPERT_ACTION` (M,) from a TensorDict without batch dimensions; writes
    "loss_imitation" and "accuracy". TorchRL's own BCLoss fails on categorical multi-agent actors.
    """

    def __init__(self, policy: nn.Module) -> None:
        super().__init__()
        self.policy = policy
        self.in_keys = [*Bag._fields, EXPERT_ACTION]  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = ["loss_imitation", "accuracy"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the loss of a bag of robots."""
        bag = Bag(*(tensordict[name] for name in Bag._fields))
        logits, labels = self.policy(bag).float(), tensordict[EXPERT_ACTION]
        loss = torch.nn.functional.cross_entropy(logits, labels)
        accuracy = (logits.detach().argmax(-1) == labels).float().mean()
        return TensorDict({"loss_imitation": loss, "accuracy": accuracy})
