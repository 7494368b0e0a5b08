"""The validation maps of the general policy, and the table of what is played on them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import generalist
from gnn_policy import checkpoint
from gnn_policy.baselines import GreedyActor
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.policy_config import PolicyConfig
from gnn_policy.rollout import rollout
from mapf_env.config import Shield


def test_every_team_size_has_the_same_maps_which_look_like_those_of_pogema() -> None:
    for name in generalist.SETS:
        few, many = (generalist.instances_of(name, size, 12) for size in (3, 7))
        assert [each.num_agents for each in few] == [3] * 12
        assert [each.num_agents for each in many] == [7] * 12
        assert all(np.array_equal(one.grid, two.grid) for one, two in zip(few, many, strict=True))
        assert len({each.grid.tobytes() for each in few}) == 12
        sides = {side for each in few for side in each.grid.shape}
        assert sides <= set(range(17, 22))
        blocked = np.mean([each.grid.mean() for each in few])
        assert abs(blocked - {"random": 0.2, "mazes": 0.3}[name]) < 0.05


def test_the_table_agrees_with_rollouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(generalist, "STEPS", 20)
    monkeypatch.setenv("COLUMNS", "160")
    checkpoint.save(
        DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2)), tmp_path / "tiny.safetensors"
    )
    generalist.main(
        replace(generalist.Options(str(tmp_path / "tiny.safetensors")), sets=("random",), sizes=(2, 8), cases=3)
    )
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in capsys.readouterr().out.splitlines()]
    found = {(row[1], row[2]): row[3:6] for row in rows if row[0] == "random"}
    assert set(found) == {(size, way) for size in ("2", "8") for way in ("argmax", "PIBT", "PIBT with swap")}
    for size in (2, 8):
        shields: dict[str, Shield] = {"PIBT": "pibt", "PIBT with swap": "pibt_swap"}
        for way, shield in shields.items():
            instances = generalist.instances_of("random", size, 3)
            played = rollout(GreedyActor(shield=shield), instances, seed=generalist.SEED, max_steps=20)
            success, on_goal, flowtime = found[str(size), way]
            assert float(success.split()[0]) == pytest.approx(played.success.mean(), abs=5e-4)
            assert float(on_goal) == pytest.approx(played.on_goal.mean(), abs=5e-4)
            assert float(flowtime) == pytest.approx(np.mean(played.flowtime), abs=0.51)
