"""The processes that train one policy together, as torchrun starts them."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Process:
    """This process among those that train together."""

    rank: int = 0
    """Number of this process; process 0 writes the run folder and prints to the console."""
    count: int = 1
    """Number of processes on all machines."""
    local_count: int = 1
    """Number of processes on this machine."""

    def share(self, name: str, total: int) -> int:
        """Return the share of each process in `total`.

        Raises:
            ValueError: If it cannot be divided evenly.
        """
        if total % self.count:
            raise ValueError(f"{name} must be a multiple of the {self.count} processes, got {total}")
        return total // self.count

    def gather(self, value: T) -> list[T]:
        """Return the values of all processes, in their order."""
        if self.count == 1:
            return [value]
        values: list[T | None] = [None] * self.count
        distributed.all_gather_object(values, value)
        return values  # pyright: ignore[reportReturnType]

    def from_first(self, value: T) -> T:
        """Return the value of process 0."""
        if self.count == 1:
            return value
        values = [value]
        distributed.broadcast_object_list(values)
        return values[0]

    def average(self, tensor: torch.Tensor) -> torch.Tensor:
        """Average a tensor over the processes, in place."""
        if self.count > 1:
            distributed.all_reduce(tensor)
            tensor /= self.count
        return tensor

    def wrap(self, module: nn.Module) -> nn.Module:
        """Wrap `module` to average gradients in its backward pass; batch norm follows the statistics of process 0."""
        return DistributedDataParallel(module) if self.count > 1 else module


@contextmanager
def join_processes() -> Iterator[Process]:
    """Join the other processes that `torchrun` started (nccl between GPUs, gloo otherwise); without it, run alone."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Process()
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    distributed.init_process_group(backend, timeout=timedelta(hours=12))  # others wait while 0 validates
    try:
        local = int(os.environ["LOCAL_WORLD_SIZE"])
        yield Process(distributed.get_rank(), distributed.get_world_size(), local)
    finally:
        # A thread of the group that outlives it may ask for Python while the process ends, which aborts the process:
        # the group ends its threads only when nothing refers to it any more.
        gc.collect()
        distributed.destroy_process_group()
