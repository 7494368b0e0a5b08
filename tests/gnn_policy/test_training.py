"""Training: a function of its settings, whatever happens to the process that runs it."""

import contextlib
import csv
import math
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig, checkpoint, load, rollout, save, training
from gnn_policy.demonstrations import BatchMaker, Demonstrations
from gnn_policy.progress import TrainingProgress
from gnn_policy.run_folder import open_run
from gnn_policy.training import Training
from own_layers import Deaf
from small_training import CONFIG, CROWDS, MIXED, arguments_for


class Silence(TrainingProgress):
    """Progress that nobody watches; whoever listens hears of finished rounds."""

    def __init__(self, listener=lambda row: None):
        super().__init__(CONFIG.rounds, Console(quiet=True))
        self.listener = listener

    def finished(self, row):
        super().finished(row)
        self.listener(row)


def trained(config, folder, finished=lambda row: None):
    run = Training(config, folder, Silence(finished))
    run.run()
    return run


def weights(run):
    return {name: tensor.clone() for name, tensor in run.policy.state_dict().items()}


def assert_equal_weights(one, two):
    assert one.keys() == two.keys()
    for name, tensor in one.items():
        assert torch.equal(tensor, two[name]), name


def timeless(rows):
    return [{name: value for name, value in row.items() if "seconds" not in name} for row in rows]


def metrics(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return timeless(csv.DictReader(file))


def test_a_graph_layer_of_ones_own_is_trained_and_loaded(tmp_path):
    config = replace(CONFIG, policy=replace(CONFIG.policy, graph_layer="own_layers:Deaf"))
    run = trained(config, tmp_path)
    assert isinstance(load(tmp_path, plugins=["own_layers:Deaf"]).graph_layer, Deaf)
    torch.manual_seed(config.seed)
    begun = DecentralizedPolicy(config.policy).state_dict()
    assert not torch.equal(weights(run)["graph_layer.mix.weight"], begun["graph_layer.mix.weight"])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(CONFIG, tmp_path_factory.mktemp("run"))


def test_equal_seeds_give_equal_weights_and_others_do_not(run, tmp_path):
    torch.manual_seed(12345)  # the state of the process plays no part
    again = trained(CONFIG, tmp_path / "again")
    assert_equal_weights(weights(run), weights(again))
    assert metrics(run.folder) == metrics(again.folder)
    other = trained(replace(CONFIG, seed=1, rounds=1), tmp_path / "other")
    assert not torch.equal(weights(run)["head.weight"], weights(other)["head.weight"])


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"expert": "pibt", "robot_order": "random", "beta_decay": 0.5},
        {"aggregation": "failed", "expert": "experts:lacam"},
        {"policy": replace(CONFIG.policy, graph_layer="own_layers:Forgetful")},
        {"families": MIXED.families, "augment": True, "beta_decay": 0.5},
        {"families": CROWDS.families, "objective": "delay", "averaging": 0.9, "clip_norm": 1.0},
        {
            "families": CROWDS.families,
            "rollout_actions": "stuck",
            "execution": Execution(actions="stuck", shield="pibt"),
        },
    ],
)
def test_a_run_stopped_after_any_round_resumes_and_ends_the_same(run, tmp_path, settings):
    config = replace(CONFIG, **settings)
    if settings:
        run = trained(config, tmp_path / "whole")
    assert all(row.demonstrations for row in run.history)

    class StopError(Exception):
        pass

    def stop(row):
        raise StopError

    folder = tmp_path / "run"
    for _ in range(CONFIG.rounds):
        with pytest.raises(StopError):
            trained(config, folder, stop)
    resumed = trained(config, folder)
    assert_equal_weights(weights(run), weights(resumed))
    assert metrics(run.folder) == metrics(folder)
    assert timeless(map(asdict, run.history)) == timeless(map(asdict, resumed.history))


def test_the_rows_count_updates_samples_and_states(run):
    for number, row in enumerate(run.history):
        assert row.round == number
        assert row.updates == 3 * (number + 1)
        assert row.samples == 3 * (number + 1) * CONFIG.batch_size * CONFIG.num_agents
        assert row.unlabelled == 0
        expected = [
            Demonstrations.load(run.folder / "demonstrations" / f"round_{r:04d}.safetensors") for r in range(number + 1)
        ]
        assert row.demonstrations == sum(map(len, expected))
        assert (row.validation_success is None) == (number == 0)
    assert [row.seconds for row in run.history] == sorted(row.seconds for row in run.history)


def test_seconds_are_those_of_the_clock(tmp_path, monkeypatch):
    now = [0.0]

    def slow(function, seconds):
        def slowed(*arguments, **options):
            now[0] += seconds
            return function(*arguments, **options)

        return slowed

    class StopError(Exception):
        pass

    def stop(row):
        raise StopError

    monkeypatch.setattr("experts.relabel", slow(training.metrics.experts.relabel, 7))
    monkeypatch.setattr(Demonstrations, "save", slow(Demonstrations.save, 2))
    monkeypatch.setattr(BatchMaker, "batch", slow(BatchMaker.batch, 1))
    monkeypatch.setattr(training, "rollout", slow(rollout, 50))
    for listener in (stop, lambda row: None):
        run = Training(CONFIG, tmp_path / "run", Silence(listener), clock=lambda: now[0])
        now[0] += 1000 if listener is stop else 0  # before the rounds
        with contextlib.suppress(StopError):
            run.run()
    rows = run.history
    for row in rows:
        labelled = 7 if row.round else 7 * (CONFIG.demonstration_steps // CONFIG.rollout_teams + 1)
        assert (row.expert_seconds, row.collect_seconds, row.fit_seconds) == (labelled, labelled + 2, 3 * 2), (
            "two halves of three batches"
        )
    spent = [row.collect_seconds + row.fit_seconds for row in rows]
    asked_as_a_collector_starts = 7
    first = 1000 + asked_as_a_collector_starts + spent[0]
    second = first + asked_as_a_collector_starts + spent[1] + 50
    assert [row.seconds for row in rows] == [first, second, second + spent[2] + 50]


def test_the_learning_rate_falls_along_a_cosine(run, tmp_path):
    config = replace(CONFIG, rounds=5, lr=1e-2, final_lr=1e-4, validate_every=9, updates_per_round=1, dagger_every=0)
    for finished in (run, trained(config, tmp_path / "run")):
        c = finished.config
        for row in finished.history:
            expected = c.final_lr + (c.lr - c.final_lr) * (1 + math.cos(math.pi * row.round / c.rounds)) / 2
            assert row.lr == pytest.approx(expected, rel=1e-9)


def test_the_optimiser_is_the_papers(run):
    (group,) = run.optimizer.param_groups
    assert isinstance(run.optimizer, torch.optim.Adam)
    assert group["betas"][0] == CONFIG.beta1
    assert group["weight_decay"] == CONFIG.weight_decay
    assert {id(p) for p in group["params"]} == {id(p) for p in run.policy.parameters()}


def test_batch_statistics_are_learnt_in_fitting_only(run):
    """Each gradient step updates them once; rollouts and validation leave them alone."""
    counts = [int(value) for name, value in weights(run).items() if name.endswith("num_batches_tracked")]
    assert counts
    assert set(counts) == {run.history[-1].updates}


def test_validation_is_the_share_of_validation_cases_that_are_solved(run):
    cases = CONFIG.cases("validation").instances
    reference = training.metrics.ReferenceSet.prepare(cases, w=CONFIG.w, timeout=CONFIG.timeout, threads=1)
    played = rollout(run.policy, cases, max_steps=reference.max_steps, seed=CONFIG.seed)
    assert run.history[-1].validation_success == played.success.mean()


@pytest.mark.parametrize(
    ("merits", "best"),
    [
        ([(0.2, 0.5), (0.9, 0.5), (0.4, 0.1)], 1),
        ([(0.5, 0.3), (0.5, 0.2), (0.5, 0.4)], 1),  # equal success: the smaller flowtime increase
        ([(0.5, 0.3), (0.5, 0.3), (0.4, 0.0)], 0),  # a tie: the first
        ([(0.0, 2.0), (0.0, 2.5), (0.1, 9.0)], 2),
    ],
)
def test_the_best_validated_round_is_kept(tmp_path, monkeypatch, merits, best):
    answers = iter(merits)

    def judge(name, reference, played):
        success, increase = next(answers)
        return SimpleNamespace(
            success_rate=SimpleNamespace(mean=success), flowtime_increase=SimpleNamespace(mean=increase)
        )

    monkeypatch.setattr(training.metrics, "score", judge)
    snapshots = []
    folder = tmp_path / "run"
    run = Training(
        replace(CONFIG, validate_every=1, updates_per_round=1),
        folder,
        Silence(lambda row: snapshots.append(weights(run))),
    )
    run.run()
    assert_equal_weights(load(folder).state_dict(), snapshots[best])


def batches_seen(monkeypatch, config, folder):
    """For each gradient step: the round's number of demonstrations and the states chosen."""
    seen = []

    class Watched(BatchMaker):
        def batches(self, demonstrations, draws, rng, *, ahead):
            seen.extend((len(demonstrations), np.concatenate(parts)) for parts in draws)
            return super().batches(demonstrations, draws, rng, ahead=ahead)

    monkeypatch.setattr(training, "BatchMaker", Watched)
    run = trained(config, folder)
    return run, seen


def test_one_batch_holds_teams_and_maps_of_several_sizes(tmp_path, monkeypatch):
    mixed = []
    make = BatchMaker.batch

    def watched(self, demonstrations, chosen, rng):
        batch = make(self, demonstrations, chosen, rng)
        states = demonstrations.take(chosen).states
        assert np.bincount(batch["team"]).tolist() == np.diff(states.offsets).tolist()
        assert len(batch["expert_action"]) == states.num_robots
        mixed.append((len(set(np.diff(states.offsets))), len(set(states.maps.tolist()))))
        return batch

    monkeypatch.setattr(BatchMaker, "batch", watched)
    run = trained(MIXED, tmp_path / "run")
    assert max(sizes for sizes, _ in mixed) > 2
    assert max(maps for _, maps in mixed) > 2
    shard = Demonstrations.load(tmp_path / "run" / "demonstrations" / "round_0000.safetensors")
    assert set(np.diff(shard.states.offsets).tolist()) <= {2, 3, 4, 5}
    families = MIXED.cases("train")
    assert {families.family_of[families.map_of == number][0] for number in set(shard.states.maps.tolist())} == {0, 1}
    assert run.history[-1].samples > 0


def test_training_starts_from_the_weights_that_init_names(run, tmp_path):
    config = replace(CONFIG, init=str(run.folder), seed=9, lr=1e-12, final_lr=1e-12, rounds=1)
    begun = Training(config, tmp_path / "run", Silence())
    assert_equal_weights(weights(begun), load(run.folder).state_dict())
    begun.run()
    for name, tensor in load(run.folder).named_parameters():
        assert torch.allclose(weights(begun)[name], tensor, atol=1e-9), name
    assert checkpoint.trained_with(tmp_path / "run").init == str(run.folder)


def test_a_fine_tuned_run_that_is_resumed_does_not_start_again_from_init(run, tmp_path):
    class StopError(Exception):
        pass

    def stop(row):
        raise StopError

    save(run.policy, tmp_path / "first.safetensors")
    config = replace(CONFIG, init=str(tmp_path / "first.safetensors"), lr=1e-2)
    whole = trained(config, tmp_path / "whole")
    with pytest.raises(StopError):
        trained(config, tmp_path / "torn", stop)
    assert_equal_weights(weights(whole), weights(trained(config, tmp_path / "torn")))
    with pytest.raises(FileExistsError, match=r"other settings \(init\)"):
        Training(replace(config, init=None), tmp_path / "whole", Silence())


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"taps": 2}, "taps: 3, not 2"),
        ({"features": 16}, "features: 8, not 16"),
        ({"extra_channels": ("cost_to_go",)}, r"extra_channels: \(\), not \('cost_to_go',\)"),
        ({"comm_radius": 4.0, "fov_radius": 3}, "fov_radius: 2, not 3, comm_radius: 3.0, not 4.0"),
    ],
)
def test_init_of_another_network_is_refused_and_the_differences_are_named(run, tmp_path, changes, named):
    config = replace(CONFIG, policy=replace(CONFIG.policy, **changes), init=str(run.folder))
    with pytest.raises(ValueError, match=rf"is another network than the one to train \({named}\)") as refusal:
        Training(config, tmp_path / "run", Silence())
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "run").exists()


def test_the_policy_of_a_run_is_saved_with_the_execution_of_the_settings(tmp_path):
    execution = Execution(actions="sampled", temperature=0.5, shield="pibt", comm_range="connected")
    run = trained(replace(CONFIG, execution=execution, rounds=2), tmp_path)
    assert run.policy.execution == load(tmp_path).execution == checkpoint.executed_as(tmp_path) == execution


def test_validation_plays_under_the_shield_and_radio_of_the_execution(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(training, "rollout", lambda *given, **how: asked.append(how) or rollout(*given, **how))
    execution = Execution(actions="stuck", shield="pibt", comm_range="connected")
    trained(replace(CONFIG, execution=execution, rounds=2), tmp_path / "one")
    trained(replace(CONFIG, execution=execution, rollout_actions="stuck", rounds=2), tmp_path / "two")
    assert [each["execution"] for each in asked] == [replace(execution, actions="argmax"), execution]


def test_without_a_number_of_updates_a_round_is_one_pass(tmp_path, monkeypatch):
    config = replace(CONFIG, updates_per_round=None, rounds=2)
    run, seen = batches_seen(monkeypatch, config, tmp_path / "run")
    assert len(seen) == sum(math.ceil(row.demonstrations / 8) for row in run.history)
    for row in run.history:
        passed = np.concatenate([chosen for size, chosen in seen if size == row.demonstrations])
        assert sorted(passed) == list(range(row.demonstrations))
    assert all(len(chosen) in (7, 8) for _, chosen in seen)
    assert run.history[-1].samples == CONFIG.num_agents * sum(row.demonstrations for row in run.history)


def test_a_share_of_each_batch_is_fresh_once_states_are_aggregated(tmp_path, monkeypatch):
    config = replace(CONFIG, updates_per_round=40, rounds=2, fresh_share=0.25, fresh_window=5)
    run, seen = batches_seen(monkeypatch, config, tmp_path / "run")
    first, second = run.history[0].demonstrations, run.history[1].demonstrations
    imitating = np.concatenate([chosen for count, chosen in seen if count == first])
    assert (imitating >= first - 5).mean() == pytest.approx(5 / first, abs=0.1), "no state is fresher in round 0"
    assert np.unique(imitating).size > 0.9 * first
    aggregating = np.stack([chosen for count, chosen in seen if count == second])
    assert (aggregating[:, :2] >= second - 5).all()
    assert (aggregating[:, 2:] >= second - 5).mean() < 0.3


def test_plain_imitation_collects_once(tmp_path):
    folder = tmp_path / "run"
    trained(replace(CONFIG, dagger_every=0), folder)
    assert os.listdir(folder / "demonstrations") == ["round_0000.safetensors"]
    trained(replace(CONFIG, dagger_every=2), tmp_path / "other")
    assert sorted(os.listdir(tmp_path / "other" / "demonstrations")) == [
        "round_0000.safetensors",
        "round_0002.safetensors",
    ]


def test_an_expert_that_labels_nothing_is_reported(tmp_path, monkeypatch):
    def helpless(instances, positions, *, offsets, **_):
        return np.full(len(positions), 4, np.int8), np.zeros(len(offsets) - 1, bool)

    monkeypatch.setattr("experts.relabel", helpless)
    with pytest.raises(ValueError, match="expert_nodes"):
        trained(CONFIG, tmp_path / "run")


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(FileExistsError, match=r"is not a training run.*--run"):
        open_run(tmp_path, CONFIG)
    with pytest.raises(FileExistsError, match=r"thesis\.tex .*is not a training run.*--run"):
        open_run(tmp_path / "thesis.tex", CONFIG)
    assert os.listdir(tmp_path) == ["thesis.tex"]


def test_a_run_with_other_settings_is_refused_and_they_are_named(tmp_path):
    open_run(tmp_path, CONFIG)
    open_run(tmp_path, CONFIG)
    with pytest.raises(FileExistsError, match=r"other settings \(lr, seed\).*--run"):
        open_run(tmp_path, replace(CONFIG, seed=5, lr=0.1))
    (tmp_path / "config.toml").write_text("{")
    with pytest.raises(ValueError, match=r"config\.toml"):
        open_run(tmp_path, CONFIG)


def test_a_finished_run_is_refused(tmp_path):
    open_run(tmp_path, CONFIG)
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(FileExistsError, match=rf"{tmp_path} holds a finished run.*--run"):
        open_run(tmp_path, CONFIG)


def test_a_folder_that_another_process_trains_in_is_refused_until_that_one_ends(tmp_path):
    program = "import sys, pathlib; from gnn_policy.run_folder import lock_run; "
    program += "lock = lock_run(pathlib.Path(sys.argv[1])); print('locked', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", program, str(tmp_path / "run")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "locked\n"
        with pytest.raises(FileExistsError, match=r"another process is training in .*run.*--run"):
            Training(CONFIG, tmp_path / "run", Silence())
        assert not (tmp_path / "run").exists()
        other.kill()
    assert not Training(CONFIG, tmp_path / "run", Silence()).history


def test_settings_that_do_not_fit_leave_no_folder_behind(tmp_path):
    for wrong in (
        replace(CONFIG, density=0.99),
        replace(CONFIG, num_agents=40),
        replace(CONFIG, device="abacus"),
        replace(CONFIG, expert="nobody"),
        replace(CONFIG, backend="process", collectors=3, rollout_teams=16),
        replace(CONFIG, policy=PolicyConfig(encoder="released", fov_radius=2)),
        replace(CONFIG, families=(*MIXED.families, replace(MIXED.families[0], num_agents=(100, 120)))),
        replace(CONFIG, init="n12"),
    ):
        with pytest.raises(ValueError, match=r"\w+ \w+"):
            Training(wrong, tmp_path / "run", Silence())
        assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["state.pt", "demonstrations/round_0001.safetensors"])
def test_a_damaged_file_of_a_run_is_named(run, tmp_path, name):
    content = (run.folder / name).read_bytes()
    for damaged in (b"", content[: len(content) // 2], b"\0" * 500):
        folder = tmp_path / f"run{len(damaged)}"
        open_run(folder, CONFIG)
        (folder / "demonstrations").mkdir()
        for each in ("state.pt", *(f"demonstrations/round_000{r}.safetensors" for r in range(3))):
            (folder / each).write_bytes((run.folder / each).read_bytes())
        (folder / name).write_bytes(damaged)
        with pytest.raises(ValueError, match=name.split("/")[-1]):
            Training(CONFIG, folder, Silence())


KILLED_AT_A_WRITE = """
import os, signal, sys
from gnn_policy.train import main
replace, left = os.replace, [writes]
def deadly_replace(*paths):
    left[0] -= 1
    if left[0] == 0 and before:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(*paths)
    if left[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = deadly_replace
sys.stdout = open(os.devnull, "w")
main(arguments)
"""


def tensorboard_rounds(folder, name):
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return [each.step for each in events.Scalars(name)]


@pytest.mark.skipif(sys.platform == "win32", reason="kills by POSIX signals")
@pytest.mark.parametrize("config", [CONFIG, CROWDS], ids=["one family", "mixed families"])
def test_a_run_that_is_killed_again_and_again_ends_like_one_that_is_not(tmp_path, config):
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["gnn_policy.train", "gnn_policy.training"])

    def launch(folder, writes=0, before=False):
        names = {"arguments": arguments_for(config, folder), "writes": writes, "before": before}
        process = context.Process(target=exec, args=(KILLED_AT_A_WRITE, names))
        process.start()
        return process

    whole, torn = tmp_path / "whole", tmp_path / "torn"
    launch(whole).join()  # it also warms the server up
    began = time.monotonic()
    writes_until_killed = [(1, True), (1, False), (2, True), (3, False), (2, False), (4, True)]
    for writes, before in writes_until_killed:
        process = launch(torn, writes, before)
        process.join()
        assert process.exitcode == -signal.SIGKILL
    per_launch = (time.monotonic() - began) / len(writes_until_killed)
    moments = random.Random(1)
    for _ in range(3):
        process = launch(torn)
        process.join(moments.uniform(0.2, 1.0) * per_launch)
        if process.exitcode is None:
            process.kill()
            process.join()
    if not (torn / "results.json").exists():
        process = launch(torn)
        process.join()
        assert process.exitcode == 0

    assert not list(torn.rglob(".writing-*"))
    assert {each.relative_to(torn) for each in torn.rglob("*") if "tfevents" not in each.name} == {
        each.relative_to(whole) for each in whole.rglob("*") if "tfevents" not in each.name
    }
    for name in ("config.toml", "best.safetensors", "results.json", "animation.svg"):
        assert (torn / name).read_bytes() == (whole / name).read_bytes(), name
    for shard in (whole / "demonstrations").iterdir():
        assert (torn / "demonstrations" / shard.name).read_bytes() == shard.read_bytes()
    assert metrics(torn) == metrics(whole)
    states = [torch.load(folder / "state.pt", weights_only=True) for folder in (torn, whole)]
    assert_equal_weights(states[0]["policy"], states[1]["policy"])
    for one, two in zip(*(state["optimizer"]["state"].values() for state in states), strict=True):
        assert_equal_weights(one, two)
    assert states[0]["scheduler"] == states[1]["scheduler"]
    for name in ("loss", "accuracy", "lr"):
        assert tensorboard_rounds(torn, name) == tensorboard_rounds(whole, name) == [0, 1, 2]
