"""The files that an evaluation leaves behind."""

import io
import json

import numpy as np
import pytest
import torch
from rich.console import Console

from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig, evaluation_tables
from gnn_policy.checkpoint import fingerprint
from gnn_policy.config import TrainConfig
from gnn_policy.rollout import Rollouts
from mapf_env import Instance, Solution


def test_the_animation_shows_the_solved_case_of_median_length():
    grid = np.zeros((1, 2), bool)
    instance = Instance(grid, [[0, 0]], [[0, 1]])

    def played(success, makespans):
        count = len(success)
        paths = [Solution(np.zeros((2, 1, 2), int))] * count
        zeros = np.zeros(count, np.int64)
        return Rollouts(
            instances=[instance] * count,
            solutions=paths,
            goals=[instance.goals[None]] * count,
            success=np.array(success),
            flowtime=zeros,
            makespan=np.array(makespans),
            on_goal=np.zeros(count),
            latched=np.array(success),
            replaced=np.zeros(count),
            throughput=np.zeros(count),
        )

    assert evaluation_tables._worth_watching(played([True, True, False, True], [9, 4, 5, 6])) == 3
    assert evaluation_tables._worth_watching(played([False, True, False], [1, 7, 9])) == 1
    assert evaluation_tables._worth_watching(played([False, False], [5, 5])) == 0


def test_the_numbers_are_written_last(tmp_path, monkeypatch):
    torch.manual_seed(0)
    policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2))
    config = TrainConfig(
        policy=policy.config, num_agents=2, height=5, width=5, density=0.0, test_maps=2, cases_per_map=2, w=1.1
    )
    console = Console(file=io.StringIO(), width=80)

    def crash(*_, **__):
        raise RuntimeError("crash")

    with monkeypatch.context() as patch:
        patch.setattr(evaluation_tables, "animate", crash)
        with pytest.raises(RuntimeError, match="crash"):
            evaluation_tables.evaluate_and_report(policy, config, tmp_path, console, threads=1)
    assert list(tmp_path.iterdir()) == [], "a run with results.json counts as finished"
    evaluation_tables.evaluate_and_report(policy, config, tmp_path, console, threads=1)
    numbers = json.loads((tmp_path / "results.json").read_text())
    assert numbers["tables"]["2"]["cases"] == 4
    assert [row["name"] for row in numbers["tables"]["2"]["rows"]][:4] == [
        "argmax",
        "stuck,1",
        "sampled,1",
        "random",
    ]
    assert numbers["settings"] == {
        "policy": fingerprint(policy),
        "executions": ["argmax", "stuck,1", "sampled,1"],
        "tables": ["2"],
        "split": "test",
        "task": "one_shot",
        "maps": 2,
        "cases_per_map": 2,
        "height": 5,
        "width": 5,
        "density": 0.0,
        "styles": ["cells"],
        "families": [],
        "files": [],
        "data_seed": 0,
        "w": 1.1,
        "timeout": 3.0,
        "reference_nodes": 200_000,
        "seed": 0,
    }


def test_the_executions_have_the_shield_of_the_policy(tmp_path):
    torch.manual_seed(0)
    execution = Execution(shield="pibt")
    policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2), execution)
    config = TrainConfig(
        policy=policy.config, num_agents=2, height=5, width=5, density=0.0, test_maps=1, cases_per_map=1
    )
    evaluation_tables.evaluate_and_report(policy, config, tmp_path, Console(file=io.StringIO(), width=80), threads=1)
    rows = json.loads((tmp_path / "results.json").read_text())["tables"]["2"]["rows"]
    assert [row["name"] for row in rows][:4] == ["argmax,pibt", "stuck,1,pibt", "sampled,1,pibt", "random"]
