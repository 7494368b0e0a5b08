"""The ablation trains what is not finished, and its table says what the runs say."""

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import ablation as script
from gnn_policy.network import PolicyConfig
from mapf_env import Solution


@pytest.fixture
def ablation(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script with runs of a second."""
    tiny = replace(
        script.BASE,
        policy=PolicyConfig(encoder="lean", features=8, fov_radius=2),
        num_agents=3,
        height=8,
        width=8,
        train_maps=4,
        cases_per_map=2,
        validation_maps=3,
        validation_cases_per_map=4,
        demonstration_steps=64,
        dagger_steps=32,
        rollout_teams=4,
        rollout_length=8,
        batch_size=4,
    )
    monkeypatch.setattr(script, "BASE", tiny)
    script.reference_set.cache_clear()
    return script


def rows(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


def test_finished_runs_are_not_repeated_and_the_table_has_them_all(
    ablation: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def options(*only: str) -> Any:
        return ablation.Options("dagger", tmp_path, only=only, updates=1)

    ablation.main(options("none"))
    trained: list[str] = []
    train = ablation.train
    monkeypatch.setattr(
        ablation, "train", lambda runs, name, *others: (trained.append(name), train(runs, name, *others))
    )
    ablation.main(options("default", "none", "fresh 0.25"))
    assert trained == ["default", "fresh 0.25"]
    assert "2 runs to go, about" in capsys.readouterr().out
    headings, _, *found = rows((tmp_path / "dagger.md").read_text())
    assert [row[0] for row in found] == ["default", "none", "fresh 0.25"]
    for row in found:
        assert len(row) == len(headings)
        result = json.loads((ablation.run_folder(tmp_path, row[0], 0) / "outcome.json").read_text())
        assert len(result["success"]) == 12
        assert row[2].startswith(f"{np.mean(result['success']):.3f} [")
        assert [moment for moment, _ in result["curve"]] == sorted(moment for moment, _ in result["curve"])
    assert (tmp_path / "dagger.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match=r"no variants \['nonne'\]: choose among \['default', 'none'"):
        ablation.main(options("nonne"))


def test_runs_of_other_settings_are_left_out_of_the_table(ablation: ModuleType, tmp_path: Path) -> None:
    ablation.main(ablation.Options("dagger", tmp_path, only=("none",), updates=1))
    with pytest.raises(FileExistsError, match=r"none-seed-0 holds a run of other settings \(updates_per_round\)"):
        ablation.main(ablation.Options("dagger", tmp_path, only=("default",), updates=2))
    with pytest.raises(ValueError, match="--seeds must be at least 1, got 0"):
        ablation.main(ablation.Options("dagger", tmp_path, seeds=0))


@pytest.mark.parametrize("ablation_name", ["LABELS", "DAGGER"])
def test_all_variants_have_different_settings(ablation: ModuleType, ablation_name: str) -> None:
    variants = getattr(ablation, ablation_name)
    configs = [replace(ablation.BASE, **settings) for settings in variants.values()]
    assert len({each.to_toml() for each in configs}) == len(configs)
    assert len({ablation.run_folder(Path(), name, 0) for name in variants}) == len(configs)
    assert configs[0] == ablation.BASE


def test_all_experts_are_evaluated_on_the_same_cases(ablation: ModuleType, tmp_path: Path) -> None:
    ablation.main(ablation.Options("labels", tmp_path, only=("PIBT", "w = 1.5"), updates=1))
    headings, _, *found = rows((tmp_path / "labels.md").read_text())
    assert [row[0] for row in found] == ["w = 1.5", "PIBT"]
    quality = json.loads((tmp_path / "quality.json").read_text())
    assert list(quality) == list(ablation.LABELS)
    for labels in quality.values():
        assert labels["solved"] > 0.7
        assert labels["over_bound"] >= 1
        assert 0 <= labels["waits"] < 0.5
    assert quality["w = 1"]["over_bound"] == pytest.approx(1)
    assert found[1][headings.index("flowtime / bound")] == f"{quality['PIBT']['over_bound']:.4f}"


def test_waiting_ends_with_the_last_arrival(ablation: ModuleType) -> None:
    waits_once = Solution(np.array([[(0, 0), (1, 0)], [(0, 0), (1, 1)], [(0, 1), (1, 1)], [(0, 2), (1, 1)]]))
    leaves_its_goal = Solution(np.array([[(0, 0)], [(0, 0)], [(0, 1)], [(0, 0)], [(0, 0)]]))
    assert ablation.waiting([waits_once]) == 1 / 4
    assert ablation.waiting([waits_once, leaves_its_goal]) == 2 / 7
    assert ablation.waiting([]) == 0


def test_differences_are_taken_case_by_case(ablation: ModuleType) -> None:
    def result(success: list[int]) -> dict[str, Any]:
        numbers = {"flowtime_increase": 0.1, "accuracy": 0.9, "states": 5, "samples": 5e6, "seconds": 9}
        return {"success": success, **numbers, "expert_seconds": 1.0}

    default, other = [1, 0, 1, 0] * 25, [1, 0, 1, 1] * 25
    table = rows(ablation.markdown({("default", 1): result(default), ("none", 1): result(other)}, {}))
    assert table[2][3] == ""
    spread = 1.96 * np.std([0, 0, 0, 1] * 25, ddof=1) / 10
    assert table[3][3] == f"+0.250 ±{spread:.3f}"
    assert table[3][2].startswith("0.750 [")
    alone = rows(ablation.markdown({("none", 1): result(other)}, {}))
    assert alone[2][3] == ""
