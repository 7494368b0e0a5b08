"""What the commands share: a user's mistake is answered in one line, and threads are counted."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from gnn_policy.network import DecentralizedPolicy
from mapf_env.arguments import MOST_THREADS


@contextmanager
def mistakes_in_one_line() -> Iterator[None]:
    """Answer what bad options and files raise by one line on stderr and exit status 2, Ctrl-C by one and 130."""
    try:
        yield
    except (ValueError, OSError) as mistake:
        print(f"error: {mistake}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        raise SystemExit(130) from None


def cpu_threads(asked: int) -> int:
    """`asked`, or for 0 as many threads as the process may use."""
    if not 0 <= asked <= MOST_THREADS:
        raise ValueError(f"threads must lie in 0..{MOST_THREADS}, got {asked}")
    if asked > 0:
        return asked
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def on_device(policy: DecentralizedPolicy, device: str) -> DecentralizedPolicy:
    """The policy on a device of PyTorch's, as "cuda".

    Raises:
        ValueError: If there is none of that name here.
    """
    try:
        return policy.to(device)
    except (RuntimeError, AssertionError) as refusal:
        raise ValueError(f"the network cannot live on device {device!r}: {str(refusal).splitlines()[0]}") from None
