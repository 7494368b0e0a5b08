"""Work on a Ray cluster of two worker processes: the results of one machine, also if a worker is killed in mid-run."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import fields, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

import experts
import gnn_policy
from experts import cluster
from gnn_policy import evaluate
from gnn_policy.progress import TrainingProgress
from gnn_policy.training import Training
from mapf_env import Instance, random_instance
from pogema_methods import method_named
from small_training import CONFIG, CROWDS

pytestmark = pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra cluster")

INSTANCES = [random_instance(num_agents=3 + seed % 4, seed=seed) for seed in range(24)]


def descendants() -> set[int]:
    """The processes that this process, or one of them, has started."""
    parents: dict[int, int] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(status.parent.name)] = int(status.read_text().rpartition(")")[2].split()[1])
        except OSError:  # it has ended
            continue
    found = {os.getpid()}
    while more := {child for child, parent in parents.items() if parent in found} - found:
        found |= more
    return found - {os.getpid()}


def listening(processes: set[int]) -> list[str]:
    """The addresses, in hexadecimal digits, at which processes listen."""
    sockets = set[str]()
    for process in processes:
        for link in Path(f"/proc/{process}/fd").iterdir():
            try:
                sockets.add(os.readlink(link))
            except OSError:
                continue
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()[1:]]
    return [row[1].partition(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in sockets]


@pytest.fixture(scope="module")
def workers() -> Iterator[cluster.Workers]:
    with ExitStack() as stack:
        yield started(stack, 4)


def started(stack: ExitStack, tries: int) -> cluster.Workers:
    """Start Ray, again where a busy machine takes longer than the 30 seconds that Ray gives itself."""
    try:
        return stack.enter_context(cluster.connect("local", workers=2))
    except Exception as failure:
        if tries == 1 or "timed out during startup" not in str(failure):
            raise
        return started(stack, tries - 1)


def same(one: experts.Result, other: experts.Result) -> bool:
    """All but the seconds are equal."""
    for each in fields(one):
        ours, theirs = getattr(one, each.name), getattr(other, each.name)
        if each.name == "solution":
            if not np.array_equal(ours.paths, theirs.paths):
                return False
        elif each.name != "seconds" and ours != theirs:
            return False
    return True


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_local_cluster_listens_on_the_loopback_interface_only(workers: cluster.Workers) -> None:
    addresses = listening(descendants())
    assert addresses
    ipv4, ipv6 = "0100007F", "0000000000000000FFFF00000100007F"
    assert set(addresses) <= {ipv4, ipv6, "00000000000000000000000001000000"}


def test_parts_come_back_in_order_from_both_workers_and_are_taken_as_needed(workers: cluster.Workers) -> None:
    assert workers.count == 2
    taken: list[int] = []

    def parts() -> Iterator[int]:
        for part in range(12):
            taken.append(part)
            yield part

    def slow(part: int) -> tuple[int, int]:
        time.sleep(0.2 if part == 0 else 0.05)
        return part, os.getpid()

    results = workers.map(slow, parts(), ahead=4)
    found = [next(results)]
    assert len(taken) == 4
    found += results
    assert [part for part, _ in found] == list(range(12))
    assert len({process for _, process in found}) == 2


def test_a_killed_worker_changes_no_result(workers: cluster.Workers, tmp_path: Path) -> None:
    marker = tmp_path / "killed"
    victim = INSTANCES[9].starts.tolist()

    def solver(instance: Instance) -> experts.Result:
        if instance.starts.tolist() == victim and not marker.exists():
            marker.write_text(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGKILL)
        return experts.solve(instance, w=1.1)

    progress: list[tuple[int, int]] = []
    report = lambda done, solved: progress.append((done, solved))  # noqa: E731
    results = experts.solve_many(INSTANCES, solver=solver, cluster="local", progress=report)
    assert marker.exists()
    assert int(marker.read_text()) not in descendants() | {os.getpid()}
    expected = [experts.solve(instance, w=1.1) for instance in INSTANCES]
    assert all(same(one, other) for one, other in zip(results, expected, strict=True))
    assert progress == [(done, done) for done in range(1, 25)]


def test_a_part_that_kills_every_worker_is_an_error(monkeypatch: pytest.MonkeyPatch, workers: cluster.Workers) -> None:
    monkeypatch.setattr(cluster, "MOST_RETRIES", 1)

    def dies(part: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(RuntimeError, match="has lost 2 workers, the last because of WorkerCrashedError"):
        list(cluster.Workers().map(dies, [0]))


def test_errors_are_those_of_the_function(workers: cluster.Workers) -> None:
    def refuses(part: int) -> int:
        if part == 3:
            raise ValueError(f"part {part} is wrong")
        return part

    results = workers.map(refuses, range(8))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match=r"^part 3 is wrong$"):
        next(results)
    with pytest.raises(RuntimeError, match=r"the caller has mapf-env 0.0.1, a worker of the cluster"):
        cluster._call(len, [], "0.0.1")


@pytest.mark.parametrize("solver", ["ecbs", "lacam"])
@pytest.mark.parametrize("backlog", [1, 7, 64])
def test_a_stream_is_that_of_one_machine(workers: cluster.Workers, solver: str, backlog: int) -> None:
    stream = experts.solve_stream(iter(INSTANCES), solver=solver, w=1.2, backlog=backlog, cluster="local")
    expected = experts.solve_many(INSTANCES, solver=solver, w=1.2)
    assert all(same(one, other) for one, other in zip(stream, expected, strict=True))
    assert experts.solve_many([], cluster="local") == []


def test_labels_are_those_of_one_machine(workers: cluster.Workers) -> None:
    label = partial(experts.label_plans, INSTANCES, steps=5, rounds=3)
    one, other = label(cluster="local"), label()
    for each in fields(one):
        assert np.array_equal(getattr(one, each.name), getattr(other, each.name)), each.name
    assert one.source[-1] == 23
    assert np.array_equal(experts.next_moves(INSTANCES, cluster="local"), experts.next_moves(INSTANCES))
    states = [INSTANCES[source] for source in other.source]
    relabel = partial(experts.relabel, states, offsets=other.offsets, w=1.1)
    for ours, theirs in zip(relabel(other.positions, cluster="local"), relabel(other.positions), strict=True):
        assert np.array_equal(ours, theirs)
    same_size = [each for each in INSTANCES if each.num_agents == 3]
    positions = np.stack([each.goals[::-1] for each in same_size])
    actions, solved = experts.relabel(same_size, positions, cluster="local")
    assert actions.shape == (6, 3)
    assert np.array_equal(actions, experts.relabel(same_size, positions)[0])
    assert solved.all()
    positions[4, 1] = (-1, 0)
    with pytest.raises(ValueError, match=r"among the states from number 4 on, positions\[0, 1\]: agent 1 at \(-1, 0\)"):
        experts.relabel(same_size, positions, cluster="local")


@pytest.mark.parametrize("task", ["one_shot", "lifelong"])
def test_rollouts_are_those_of_one_machine(workers: cluster.Workers, task: Any) -> None:
    torch.set_num_threads(1)
    policy = gnn_policy.load("n4").train()
    play = partial(gnn_policy.rollout, policy, INSTANCES, task=task, seed=3, max_steps=20, batch_size=5)
    one, other = play(cluster="local"), play()
    assert policy.training
    for ours, theirs in zip(one.solutions, other.solutions, strict=True):
        assert np.array_equal(ours.paths, theirs.paths)
    for name in ("success", "flowtime", "makespan", "on_goal", "latched", "replaced", "throughput"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_evaluation_writes_the_same_file(workers: cluster.Workers, tmp_path: Path) -> None:
    cases = ["--maps", "5", "--cases-per-map", "2", "--height", "9", "--width", "9"]
    command = ["n4", *cases, "--executions", "sampled", "--threads", "1", "--out"]
    for name, options in (("one", []), ("cluster", ["--cluster", "local"])):
        evaluate.main([*command, str(tmp_path / name), *options])
    results = [(tmp_path / name / "results.json").read_bytes() for name in ("one", "cluster")]
    assert results[0] == results[1]
    assert json.loads(results[0])["tables"]


@pytest.mark.parametrize("words", ["n4", "pibt_swap"])
def test_methods_of_the_benchmark_play_as_on_one_machine(workers: cluster.Workers, words: str) -> None:
    torch.set_num_threads(1)
    one, other = (method_named(words, where).play(INSTANCES, 20, 0) for where in ("local", None))
    for each in fields(one):
        assert np.array_equal(getattr(one, each.name), getattr(other, each.name)), each.name
    assert one.home.any()


@pytest.mark.parametrize("config", [CONFIG, CROWDS], ids=["visited", "plans"])
def test_training_gives_the_same_weights(workers: cluster.Workers, tmp_path: Path, config: Any) -> None:
    weights = []
    for name in (None, "local"):
        chosen = replace(config, rounds=2, cluster=name)
        run = Training(chosen, tmp_path / str(name), TrainingProgress(2, Console(quiet=True)))
        run.run()
        weights.append(run.policy.state_dict())
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    config.require_same_settings(replace(config, cluster="10.0.0.5:6379"), "the run has", "--run")


def test_ray_is_imported_only_for_a_cluster_and_missed_in_words() -> None:
    code = (
        "import sys, experts; from mapf_env import random_instance; cases = [random_instance(num_agents=3, seed=1)]\n"
        "experts.solve_many(cases); assert 'ray' not in sys.modules; sys.modules['ray'] = None\n"
        "try: experts.solve_many(cases, cluster='local')\n"
        "except ImportError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert 'pip install "mapf-env[cluster]"' in done.stdout
