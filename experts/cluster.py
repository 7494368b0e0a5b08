"""Work on a Ray cluster: a function of a part of the cases, called for all parts by the cluster's workers.

The cases of this project are independent: whoever computes a part gets the same numbers, so a part whose worker died is
computed again. Ray (Moritz et al. 2018) is the optional extra `cluster` and is imported only if an address is given.
"""

from __future__ import annotations

import os
import secrets
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from itertools import islice
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")

LOCAL = "local"
"""The address of a Ray of this machine, which is started and stopped again."""
MOST_RETRIES = 5
"""Workers that one part may lose."""
_OF_MACHINES = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""The variable that lets Ray listen to other machines, on any system; without it, on the loopback interface alone."""
_PARTS_PER_WORKER = 4
"""Parts for each worker: enough that one slow part does not leave the other workers idle for long."""


class Workers:
    """The workers of the cluster that this process is connected to; made by `connect`."""

    def __init__(self) -> None:
        import ray  # pyright: ignore[reportMissingImports]

        self._ray: Any = ray
        self._call = _remote_call(MOST_RETRIES)
        self.count = max(int(ray.cluster_resources().get("CPU", 1)), 1)
        """Number of parts that are computed at the same time: the cluster's cores at the time of the connection."""

    def map(self, function: Callable[[T], R], parts: Iterable[T], *, ahead: int | None = None) -> Iterator[R]:
        """Yield `function(part)` for each part, in their order.

        Args:
            function: The same for all parts; it is sent once. It and what it returns must be picklable.
            parts: Taken one by one, from the calling thread.
            ahead: Parts to hand out at most before their results are read; a few for each worker if not given.

        Raises:
            Exception: What `function` raises.
            RuntimeError: If one part has lost its workers `MOST_RETRIES` times and once more, or a worker has another
                version of mapf-env.
        """
        most = 2 * _PARTS_PER_WORKER * self.count if ahead is None else ahead
        sent, source, waiting = self._ray.put(function), iter(parts), deque[Any]()
        try:
            while True:
                for part in islice(source, most - len(waiting)):
                    waiting.append(self._call.remote(sent, part, version("mapf-env")))
                if not waiting:
                    return
                yield self._result_of(waiting[0])
                waiting.popleft()
        finally:
            for part in waiting:
                self._ray.cancel(part, force=True)

    def _result_of(self, part: Any) -> Any:
        errors = self._ray.exceptions
        try:
            return self._ray.get(part)
        except errors.RayTaskError as failure:
            if isinstance(failure.cause, Exception):
                raise failure.cause from failure
            raise
        except errors.RayError as loss:
            reason = " ".join(str(loss).split())[:300]
            raise RuntimeError(
                f"a part of the cases has lost {MOST_RETRIES + 1} workers, the last because of {type(loss).__name__}: "
                f"{reason} (do the workers have enough memory?)"
            ) from loss

    def size_of_parts(self, cases: int, *, most: int) -> int:
        """Return the number of cases in a part, at most `most`: a few parts for each worker."""
        return min(max(-(-cases // (_PARTS_PER_WORKER * self.count)), 1), most)


@contextmanager
def connect(address: str, *, workers: int = 1) -> Iterator[Workers]:
    """Connect to a Ray cluster, or use the connection that this process has.

    A new connection ends with the block. Ray that is started here listens on the loopback interface only, has no
    dashboard and sends no statistics.

    Args:
        address: `"local"` for a Ray of this machine; `"auto"` for the cluster that this machine belongs to; or an
            address that `ray.init` takes, such as `"10.0.0.5:6379"`.
        workers: Worker processes of `"local"`; other clusters have as many as they have cores.

    Raises:
        ImportError: If Ray is not installed.
        ConnectionError: If there is no cluster at the address.
    """
    ray = _ray(address)
    if ray.is_initialized():
        yield Workers()
        return
    settings: dict[str, Any] = {"logging_level": "warning", "log_to_driver": False}
    if address == LOCAL:
        settings |= {"num_cpus": workers, "include_dashboard": False}
    ray.init(address=address, **settings)
    try:
        yield Workers()
    finally:
        ray.shutdown()


def map_cases(
    function: Callable[[Sequence[T]], R], cases: Sequence[T], cluster: str, *, workers: int, most: int
) -> list[R]:
    """Return what a function of consecutive cases returns for each part of them, computed on a cluster.

    Args:
        function: Called for at most `most` cases.
        cases: All cases.
        cluster: As in `connect`.
        workers: As in `connect`.
        most: Cases in a part.

    Raises:
        ImportError: As `connect`.
        ConnectionError: As `connect`.
        RuntimeError: As `Workers.map`.
    """
    with connect(cluster, workers=workers) as found:
        size = found.size_of_parts(len(cases), most=most)
        return list(found.map(function, (cases[first : first + size] for first in range(0, len(cases), size))))


def _ray(address: str) -> Any:
    """Return the module, told by the environment and a constant of its own how to behave."""
    wishes = {
        "RAY_USAGE_STATS_ENABLED": "0",
        # Keeps GPUs visible to tasks that ask for none; later versions do so anyway, this one warns of it.
        "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    }
    if address == LOCAL:
        # Under `uv run` Ray would install this package again for its workers, which have the caller's already.
        wishes |= {_OF_MACHINES: "0", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
        if "ray" not in sys.modules:  # else it has decided already, and makes the same decision with a warning
            wishes["RAY_AUTH_MODE"] = "token"
    for name, value in wishes.items():
        os.environ.setdefault(name, value)
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ImportError(
            'a cluster needs the extra "cluster" (there is no ray): pip install "mapf-env[cluster]", or in a checkout '
            'pip install ".[cluster]"'
        ) from None
    if address == LOCAL:
        from ray._private import ray_constants  # pyright: ignore[reportMissingImports]

        # For a Ray that was imported before the variables were set.
        ray_constants.RAY_ENABLE_UV_RUN_RUNTIME_ENV = False
        if os.environ[_OF_MACHINES] == "0":
            ray_constants.ENABLE_RAY_CLUSTER = False
    return ray


@cache
def _remote_call(retries: int) -> Any:
    """Return `_call` as Ray's workers call it: one object for all connections, since each is sent to all workers."""
    import ray  # pyright: ignore[reportMissingImports]

    return ray.remote(num_cpus=1, max_retries=retries, retry_exceptions=False)(_call)


def _call(function: Callable[[T], R], part: T, caller: str) -> R:
    """Call the function in a worker of the same version as the caller."""
    if caller != version("mapf-env"):
        raise RuntimeError(
            f"the caller has mapf-env {caller}, a worker of the cluster {version('mapf-env')}: install one version on "
            "all machines"
        )
    return function(part)
