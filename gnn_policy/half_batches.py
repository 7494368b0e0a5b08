"""Gradient steps on two cores: each thread takes half a batch.

The network's operations are so short that OpenMP's threads, which wait for each other in every one of them, spend a
good part of a step waiting, and nearly all of it once another process takes a part of a core. Two halves of a batch
wait for each other once a step, asleep.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
from tensordict import TensorDict

from gnn_policy.config import Precision
from gnn_policy.imitation import EXPERT_ACTION, ImitationLoss
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.precision import autocast


class HalfBatches:
    """The imitation loss of a batch and its gradients, the mean over the two halves of the batch.

    Batch norm sees half a batch; its running statistics are those of the first half. What is computed depends neither
    on how many threads compute it nor on which of them is faster. A network that draws random numbers, as dropout does,
    has its halves computed in turn, so that the draws keep their order.

    Args:
        policy: The network, which receives the gradients; it stays on its device.
        loss: Its loss.
        precision: As in `TrainConfig`.
        threads: CPU threads for both halves together.
    """

    def __init__(self, policy: DecentralizedPolicy, loss: ImitationLoss, precision: Precision, threads: int) -> None:
        self._policy, self._twin = policy, copy.deepcopy(policy)
        for weight, shared in zip(self._twin.parameters(), policy.parameters(), strict=True):
            weight.data = shared.data
        self._losses = loss, ImitationLoss(self._twin)
        self._precision: Precision = precision
        self._at_once: bool | None = None if threads > 1 else False
        self.threads = max(threads // 2, 1)
        """CPU threads of a half."""
        self._pool = ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(self.threads,))

    def backward(self, parts: Sequence[TensorDict]) -> torch.Tensor:
        """Set the gradients of the policy's weights; return the mean loss and accuracy (2,) over all robots.

        Args:
            parts: The two halves of a batch, or all of a small one.
        """
        self._policy.zero_grad()
        self._twin.zero_grad()
        self._twin.train(self._policy.training)
        robots = sum(len(part[EXPERT_ACTION]) for part in parts)
        halves = [(number, part, len(part[EXPERT_ACTION]) / robots) for number, part in enumerate(parts)]
        if len(halves) == 1:
            return self._half(*halves[0])
        if self._at_once:
            second = self._pool.submit(self._half, *halves[1])
            figures = self._half(*halves[0]) + second.result()
        else:
            before = torch.get_rng_state()
            figures = self._half(*halves[0]) + self._half(*halves[1])
            if self._at_once is None:
                self._at_once = torch.equal(before, torch.get_rng_state())
        with torch.no_grad():
            for weight, other in zip(self._policy.parameters(), self._twin.parameters(), strict=True):
                if weight.grad is not None and other.grad is not None:
                    weight.grad += other.grad
        return figures

    def _half(self, number: int, batch: TensorDict, share: float) -> torch.Tensor:
        """Add the gradients of a part of the batch; return its parts (2,) of loss and accuracy."""
        with autocast(self._precision, self._policy.head.weight.device):
            outcome = self._losses[number](batch)
        (outcome["loss_imitation"] * share).backward()
        return torch.stack([outcome["loss_imitation"].detach(), outcome["accuracy"]]) * share

    def close(self) -> None:
        """End the second thread."""
        self._pool.shutdown()
