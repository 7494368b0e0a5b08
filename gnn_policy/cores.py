"""The number of CPU threads this process may use."""

from __future__ import annotations

import os
import re
from pathlib import Path

from mapf_env.arguments import MOST_THREADS

CGROUPS = Path("/sys/fs/cgroup")
OWN_CGROUPS = Path("/proc/self/cgroup")


def cpu_threads(requested: int, processes: int = 1) -> int:
    """Return the number of threads requested, or for 0 as many as the process may use.

    The latter is the least of the affinity mask's cores, the quota of its cgroups (version 1 or 2) and OMP_NUM_THREADS.

    Args:
        requested: The number of threads, or 0.
        processes: How many processes of this program share the cores.

    Raises:
        ValueError: If the number is out of range.
    """
    if not 0 <= requested <= MOST_THREADS:
        raise ValueError(f"threads must lie in 0..{MOST_THREADS}, got {requested}")
    if requested > 0:
        return requested
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    cores = int(min(cores, _cgroup_quota()))
    first = re.match(r"\s*(\d+)", os.environ.get("OMP_NUM_THREADS", ""))  # "4,2" is for nested regions
    limit = int(first[1]) if first else 0
    return max(min(cores // processes, limit or MOST_THREADS, MOST_THREADS), 1)


def _cgroup_quota() -> float:
    """Cores that the quotas of this process's cgroups allow, infinite without one."""
    try:
        lines = OWN_CGROUPS.read_text().splitlines()
    except OSError:  # not Linux
        return float("inf")
    quotas = [float("inf")]
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            quotas += [_quota_v2(folder / "cpu.max") for folder in _ancestors(CGROUPS, path)]
            quotas += [_quota_v2(folder / "cpu.max") for folder in _ancestors(CGROUPS / "unified", path)]
        elif "cpu" in controllers.split(","):
            for mount in {CGROUPS / controllers, CGROUPS / "cpu", CGROUPS / "cpu,cpuacct"}:
                quotas += [_quota_v1(folder) for folder in _ancestors(mount, path)]
    return min(quotas)


def _ancestors(mount: Path, path: str) -> list[Path]:
    """The folder of a cgroup and of all groups that it lies in, up to where they are mounted.

    In a container the path may be that outside of it; the mount itself is then the container's own group.
    """
    own = mount / path.lstrip("/")
    return [own, *(each for each in own.parents if each == mount or mount in each.parents)]


def _quota_v2(file: Path) -> float:
    return _cores(*(_read(file).split() or ["max"])[:2])


def _quota_v1(folder: Path) -> float:
    return _cores(_read(folder / "cpu.cfs_quota_us"), _read(folder / "cpu.cfs_period_us"))


def _cores(quota: str, period: str = "") -> float:
    """Quota over period in microseconds; infinite where one of them is not a positive number."""
    if not (quota.isdigit() and period.isdigit() and int(quota) > 0 and int(period) > 0):
        return float("inf")
    return int(quota) / int(period)


def _read(file: Path) -> str:
    try:
        return file.read_text().strip()
    except OSError:
        return ""
