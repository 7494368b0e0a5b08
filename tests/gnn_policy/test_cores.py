"""As many threads as affinity, cgroup quota and OMP_NUM_THREADS allow."""

import pytest

from gnn_policy import cores
from gnn_policy.cores import cpu_threads


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine of 16 cores whose limits the test writes."""
    monkeypatch.setattr(cores.os, "sched_getaffinity", lambda pid: set(range(16)), raising=False)
    monkeypatch.setattr(cores, "CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(cores, "OWN_CGROUPS", tmp_path / "own")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    (tmp_path / "own").write_text("")
    return tmp_path


def put(file, text):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def test_without_a_limit_all_cores_of_the_affinity_count(machine):
    assert cpu_threads(0) == 16
    (machine / "own").unlink()
    assert cpu_threads(0) == 16


@pytest.mark.parametrize(
    ("quota", "threads"),
    [("max 100000", 16), ("400000 100000", 4), ("250000 100000", 2), ("50000 100000", 1), ("x y", 16), ("", 16)],
)
@pytest.mark.parametrize(("own", "folder"), [("/", ""), ("/jobs/one", "jobs/one"), ("/jobs/one", "jobs"), ("/out", "")])
def test_a_quota_of_version_2_counts_in_every_group_above(machine, quota, threads, own, folder):
    put(machine / "own", f"0::{own}\n")
    put(machine / "cgroup" / folder / "cpu.max", quota + "\n")
    assert cpu_threads(0) == threads


@pytest.mark.parametrize("mount", ["cpu", "cpu,cpuacct"])
@pytest.mark.parametrize(("quota", "threads"), [("-1", 16), ("300000", 3), ("10000", 1)])
def test_a_quota_of_version_1_counts(machine, mount, quota, threads):
    put(machine / "own", "5:memory:/jobs\n4:cpu,cpuacct:/jobs\n1:name=systemd:/x\n")
    put(machine / "cgroup" / mount / "jobs" / "cpu.cfs_quota_us", quota + "\n")
    put(machine / "cgroup" / mount / "jobs" / "cpu.cfs_period_us", "100000\n")
    assert cpu_threads(0) == threads


@pytest.mark.parametrize(("value", "threads"), [("3", 3), ("4,2", 4), ("99", 16), ("0", 16), ("many", 16), ("", 16)])
def test_openmps_own_limit_counts(machine, monkeypatch, value, threads):
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert cpu_threads(0) == threads


def test_the_least_of_all_limits_counts_and_processes_share_the_cores(machine, monkeypatch):
    put(machine / "own", "0::/\n")
    put(machine / "cgroup" / "cpu.max", "800000 100000")
    assert (cpu_threads(0), cpu_threads(0, processes=3), cpu_threads(0, processes=9)) == (8, 2, 1)
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    assert (cpu_threads(0), cpu_threads(0, processes=3)) == (5, 2)


def test_a_number_is_taken_as_it_is(machine, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert cpu_threads(3) == cpu_threads(3, processes=2) == 3
    for wrong in (-1, 5000):
        with pytest.raises(ValueError, match="threads"):
            cpu_threads(wrong)
