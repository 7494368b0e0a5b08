"""What an examination leaves behind."""

import io
import json

import numpy as np
import pytest
import torch
from rich.console import Console

from gnn_policy import DecentralizedPolicy, PolicyConfig, results
from gnn_policy.cases import make_cases
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
            [instance] * count, paths, np.array(success), zeros, np.array(makespans), np.array(success), np.zeros(count)
        )

    assert results._worth_watching(played([True, True, False, True], [9, 4, 5, 6])) == 3
    assert results._worth_watching(played([False, True, False], [1, 7, 9])) == 1
    assert results._worth_watching(played([False, False], [5, 5])) == 0


def test_the_numbers_are_written_last(tmp_path, monkeypatch):
    torch.manual_seed(0)
    policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2))
    cases = make_cases(
        "test", seed=0, maps=2, cases_per_map=2, num_agents=2, height=5, width=5, density=0.0, styles=["cells"]
    )
    console = Console(file=io.StringIO(), width=80)
    how = {"w": 1.1, "timeout": 3.0, "seed": 0, "threads": 1}

    def crash(*_, **__):
        raise RuntimeError("crash")

    with monkeypatch.context() as patch:
        patch.setattr(results, "animate", crash)
        with pytest.raises(RuntimeError, match="crash"):
            results.examine(policy, {"cases": cases}, tmp_path, console, **how)
    assert list(tmp_path.iterdir()) == [], "a run with results.json counts as finished"
    results.examine(policy, {"cases": cases}, tmp_path, console, **how)
    table = json.loads((tmp_path / "results.json").read_text())["cases"]
    assert table["cases"] == 4
    assert len(table["rows"]) == 5
