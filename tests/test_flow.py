"""The whole way once, as a newcomer goes it: train by one command, evaluate by another."""

import csv
import json
import os
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

SETTINGS = """
    --policy.features 16 --num-agents 3 --height 8 --width 8 --train-maps 30 --cases-per-map 4 --validation-maps 4
    --validation-cases-per-map 3 --test-maps 5 --rounds 4 --updates-per-round 60 --batch-size 32
    --demonstration-steps 1024 --dagger-steps 256 --rollout-teams 16 --rollout-length 16 --validate-every 2 --threads 1
"""


def command(module: str, *arguments: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "80"}
    return subprocess.run(
        [sys.executable, "-W", "error::ResourceWarning", "-m", module, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, "subprocess.CompletedProcess[str]"]:
    home = tmp_path_factory.mktemp("home")
    return home, command("gnn_policy.train", *SETTINGS.split(), folder=home)


def test_training_leaves_all_that_it_promises(trained: tuple[Path, "subprocess.CompletedProcess[str]"]) -> None:
    home, done = trained
    assert done.returncode == 0, done.stderr
    run = home / "runs" / "quick"
    assert sorted(each.name for each in run.iterdir()) == [
        "animation.svg",
        "best.safetensors",
        "config.toml",
        "demonstrations",
        "learning_curve.png",
        "metrics.csv",
        "results.json",
        "state.pt",
        "tensorboard",
    ]
    assert tomllib.loads((run / "config.toml").read_text())["policy"]["features"] == 16
    assert sorted(each.name for each in (run / "demonstrations").iterdir()) == [
        f"round_{number:04d}.safetensors" for number in range(4)
    ]
    assert list((run / "tensorboard").iterdir())
    assert (run / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert ET.parse(run / "animation.svg").getroot().tag.endswith("svg")
    with (run / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["round"]) for row in rows] == [0, 1, 2, 3]
    losses = [float(row["loss"]) for row in rows]
    assert losses[-1] < losses[0] < 1.7, "the policy learns nothing"
    assert [bool(row["validation_success"]) for row in rows] == [False, True, False, True]
    for words in ("validation success", "argmax", "stuck,1", "PIBT", "expert", "animation.svg", "learning_curve.png"):
        assert words in done.stdout


def test_the_results_make_sense(trained: tuple[Path, "subprocess.CompletedProcess[str]"]) -> None:
    (table,) = json.loads((trained[0] / "runs" / "quick" / "results.json").read_text())["tables"].values()
    assert table["cases"] + table["unsolved_by_expert"] == 20
    argmax, stuck, sampled, random, greedy, restless, pibt, expert = table["rows"]
    assert expert["success_rate"]["mean"] == 1
    assert expert["flowtime_increase"]["mean"] == 0
    assert pibt["success_rate"]["mean"] > 0.9
    assert greedy["success_rate"]["mean"] > 0.5
    for row in (argmax, stuck, sampled, random, greedy, restless, pibt):
        rate = row["success_rate"]
        assert 0 <= rate["low"] <= rate["mean"] <= rate["high"] <= 1
        assert rate["mean"] <= row["latched"] <= 1
        # The expert costs at most 1.05 times the optimum, so nobody undercuts it by more.
        assert row["flowtime_increase"]["mean"] >= 1 / 1.05 - 1
        if rate["mean"] > 0:
            assert 1 <= row["makespan"]["mean"] <= 100
    assert sampled["success_rate"]["mean"] > 0, "a trained policy brings some team of three home"


def test_evaluation_repeats_the_results_of_training(trained: tuple[Path, "subprocess.CompletedProcess[str]"]) -> None:
    home, _ = trained
    done = command("gnn_policy.evaluate", "runs/quick", "--threads", "1", folder=home)
    assert done.returncode == 0, done.stderr
    evaluation = home / "runs" / "quick" / "evaluation"
    assert (evaluation / "results.json").read_bytes() == (home / "runs" / "quick" / "results.json").read_bytes()
    assert ET.parse(evaluation / "animation.svg").getroot().tag.endswith("svg")
