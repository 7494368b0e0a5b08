"""The paper's experiment does only what is not done, and its tables and figures say what was tested."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

import paper
import paper_experiment
from gnn_policy import DecentralizedPolicy, load, save
from gnn_policy.checkpoint import fingerprint
from gnn_policy.config import TrainConfig
from gnn_policy.progress import TrainingProgress
from gnn_policy.recipes import RECIPES
from gnn_policy.run_folder import lock_run
from gnn_policy.training import Training
from paper_experiment import Experiment, Model, Options, Scene
from paper_figures import draw, success_rates, tables
from small_training import CONFIG


class Stop(TrainingProgress):
    """Somebody who stops the training after its first round."""

    def finished(self, row):
        raise KeyboardInterrupt


def experiment(folder: Path, **changes: object):
    options = {
        "folder": folder,
        "train_on": (4, 12),
        "kinds": ("paper",),
        "styles": ("cells",),
        "cases_per_map": 1,
        "large": False,
    }
    return Experiment(Options(**{**options, **changes}))


def finish(whole, model, success: float = 0.5) -> None:
    """Write what a training and a test of the model leave."""
    whole.run_of(model).mkdir(parents=True)
    (whole.run_of(model) / "metrics.csv").write_text("a round\n" * (1 + model.config.rounds))
    estimate = {"mean": success, "low": success - 0.1, "high": success + 0.1}
    measures = ("success_rate", "flowtime_increase", "flowtime_increase_solved", "makespan")
    folder = whole.result(Scene("cells", model.num_agents), model.name).parent
    folder.mkdir(parents=True)
    for player, row in ((model.name, "argmax"), ("baselines", "PIBT*")):
        rows = [{"name": row, **dict.fromkeys(measures, estimate), "latched": 0.875}]
        (folder / f"{player}.json").write_text(json.dumps({"cases": 90, "expert_over_bound": 1.0625, "rows": rows}))


def test_figure_two_tests_every_k_on_its_own_size_and_figure_three_k_3_on_all(tmp_path):
    pairs = {(scene.name, model.name) for scene, model in experiment(tmp_path).pairs()}
    own = {(f"20x20-cells-n{N}", f"n{N}-k{K}") for N in (4, 12) for K in (1, 2, 3)}
    general = {(f"20x20-cells-n{N}", f"n{M}-k3") for N in (4, 6, 8, 10, 12, 14) for M in (4, 12)}
    without_communication = {(f"20x20-cells-n{N}", "n12-k1") for N in (4, 6, 8, 10, 12, 14)}
    assert pairs == own | general | without_communication
    large = {(scene.name, model.name) for scene, model in experiment(tmp_path, large=True).pairs()} - pairs
    assert large == {(f"50x50-cells-n{N}", "n12-k3") for N in (20, 40, 60)}
    kinds = ("connected", "informed")
    beyond = {(scene.name, model.name) for scene, model in experiment(tmp_path, kinds=kinds).pairs()}
    connected = {("20x20-cells-n12", f"n12-k{K}-connected") for K in (2, 3)}
    assert beyond == connected | {(f"20x20-cells-n{N}", "n12-k3-informed") for N in (4, 6, 8, 10, 12, 14)}


def test_models_sample_on_teams_of_their_own_size_and_the_informed_one_keeps_its_shield(tmp_path):
    whole = experiment(tmp_path)

    def names(N, model):
        return [each.name for each in whole.executions(model, model.trained_for(Scene("cells", N)))]

    assert names(4, Model(4, 3)) == ["argmax", "stuck,1", "sampled,1"]
    assert names(6, Model(4, 3)) == ["argmax", "stuck,1"]
    assert names(14, Model(12, 3, "informed")) == ["argmax,pibt", "stuck,1,pibt"]


def test_rounds_have_equally_many_robot_states_for_every_size_of_the_team():
    full = RECIPES["full"]
    for N in (4, 6, 8, 10, 12):
        config = Model(N, 3).config
        for name in ("batch_size", "dagger_steps", "demonstration_steps"):
            assert getattr(config, name) * N == pytest.approx(getattr(full, name) * 12, rel=0.02)


def test_only_missing_models_are_trained_and_a_stopped_training_resumes(tmp_path, monkeypatch):
    shorter = replace(CONFIG, rounds=2)
    monkeypatch.setitem(RECIPES, "full", shorter)
    whole = experiment(tmp_path, taps=(3,))
    finish(whole, Model(4, 3))
    run = whole.run_of(Model(12, 3))
    stopped = Training(whole.models[-1].config, run, Stop(2, Console(quiet=True)))
    with pytest.raises(KeyboardInterrupt):
        stopped.run()
    assert not whole.is_trained(Model(12, 3))
    first = (run / "metrics.csv").read_text()
    paper.train(whole, Console(quiet=True))
    assert whole.is_trained(Model(12, 3))
    assert (run / "metrics.csv").read_text().startswith(first)
    assert TrainConfig.load(run / "config.toml").num_agents == 12
    assert {each.name for each in tmp_path.iterdir() if each.is_dir()} == {"n4-k3", "n12-k3", "results"}


def test_models_are_tested_once_and_results_of_other_settings_are_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(RECIPES, "full", replace(CONFIG, rounds=1, dagger_every=0))
    options = {"taps": (3,), "train_on": (4,)}
    whole, console = experiment(tmp_path, **options), Console(quiet=True)
    paper.train(whole, console)
    monkeypatch.setattr(paper_experiment, "TEAMS", (4, 6))
    whole = experiment(tmp_path, **options)
    paper.test(whole, console)
    files = {path: path.read_text() for path in sorted((tmp_path / "results").glob("*/*.json"))}
    assert [f"{path.parent.name}/{path.stem}" for path in files] == [
        f"20x20-cells-n{N}/{player}" for N in (4, 6) for player in ("baselines", "n4-k3")
    ]
    found = json.loads(files[whole.result(Scene("cells", 6), "n4-k3")])
    assert [row["name"] for row in found["rows"]] == found["settings"]["rows"] == ["argmax", "stuck,1"]
    assert found["cases"] + found["unsolved_by_expert"] == CONFIG.test_maps
    paper.test(whole, console)
    assert all(path.read_text() == text for path, text in files.items())
    for changed, word in (({"cases_per_map": 2}, "cases_per_map"), ({"rows": ("argmax",)}, "rows")):
        with pytest.raises(FileExistsError, match=rf"other settings \({word}\)"):
            paper.test(experiment(tmp_path, **options, **changed), console)
    weights = whole.run_of(Model(4, 3)) / "best.safetensors"
    save(DecentralizedPolicy(Model(4, 3).config.policy), weights)
    with pytest.raises(FileExistsError, match=r"other settings \(policy\)"):
        paper.plan(whole, console)


def test_policies_of_the_package_are_tested_in_place_of_trained_ones(tmp_path):
    whole = experiment(tmp_path, packaged=True, kinds=("paper", "informed"))
    files = [whole.policy_of(model) for model in whole.models]
    assert [file and file.name for file in files] == [
        *("n4.safetensors", "n12.safetensors", None, None, None, None),
        "n12-informed.safetensors",
    ]
    assert not whole.untrained()


def test_unknown_models_are_refused(tmp_path):
    for wrong in ({"taps": (0,)}, {"taps": ()}, {"train_on": ()}):
        with pytest.raises(ValueError, match="at least one"):
            experiment(tmp_path, **wrong)
    for wrong in ({"train_on": (4, 0)}, {"cases_per_map": 0}, {"large_cases_per_map": 0}):
        with pytest.raises(ValueError, match="must be positive"):
            experiment(tmp_path, **wrong)
    assert experiment(tmp_path, threads=0).threads >= 1


def test_a_model_of_other_settings_is_refused(tmp_path, monkeypatch):
    whole = experiment(tmp_path)
    finish(whole, Model(4, 3))
    replace(Model(4, 3).config, density=0.3, threads=7).save(whole.run_of(Model(4, 3)) / "config.toml")
    for action in (whole.untrained, lambda: whole.policy_of(Model(4, 3))):
        with pytest.raises(FileExistsError, match=r"n4-k3 holds a model of other settings \(density\)"):
            action()
    monkeypatch.setitem(RECIPES, "full", replace(RECIPES["full"], rounds=7))
    with pytest.raises(FileExistsError, match=r"n12\.safetensors holds a model of other settings \(rounds\)"):
        experiment(tmp_path, packaged=True).policy_of(Model(12, 3))


def test_a_pair_that_another_process_tested_meanwhile_is_left_as_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(paper_experiment, "TEAMS", (4,))
    whole = experiment(tmp_path, packaged=True, taps=(3,), train_on=(4,))
    path = whole.result(Scene("cells", 4), "n4-k3")
    baselines = whole.result(Scene("cells", 4), "baselines")

    def tested_by_another(reference):
        path.write_text("another's")
        return []

    path.parent.mkdir(parents=True)
    monkeypatch.setattr(paper.metrics, "baselines", tested_by_another)
    paper.test(whole, Console(quiet=True))
    assert baselines.exists()
    assert path.read_text() == "another's"


def test_a_model_that_another_process_trains_is_left_to_it(tmp_path, monkeypatch):
    monkeypatch.setitem(RECIPES, "full", replace(CONFIG, rounds=1))
    whole = experiment(tmp_path, taps=(3,))
    lock = lock_run(whole.run_of(Model(4, 3)))
    paper.train(whole, Console(quiet=True))
    lock.release()
    assert [model.num_agents for model in whole.models if whole.is_trained(model)] == [12]


def test_tables_and_figures_show_results_next_to_the_paper(tmp_path):
    whole = experiment(tmp_path)
    for N in (4, 6, 8, 10, 12):
        finish(whole, Model(N, 3), success=0.75)
    drawn = list(draw(whole))
    text = (tmp_path / "results.md").read_text()
    assert "## Cells, 20 x 20" in text
    assert "90 cases for each size of the team" in text
    assert "flowtime is at most 1.0625 x its bound" in text
    assert "| 10 |  |  |  | 0.750 [0.650, 0.850] -0.148 -0.224 |  |  |" in text
    assert "encoder lean" in text
    assert "| n12-k3 argmax |  |  |  |  | 0.750 [0.650, 0.850] |" in text
    assert "| n12-k3 argmax |  |  |  |  | +75.0% [+65.0, +85.0] |" in text
    assert "| PIBT* | 0.875 | 0.875 | 0.875 | 0.875 | 0.875 |" in text
    assert "| longer version, trained on 10 | 0.991 | 0.983 | 0.979 | 0.974 | 0.968 |" in text
    assert "| paper, trained on 10 | 0.965 | 0.952 | 0.925 | 0.898 | 0.854 |" in text
    assert "sampled" not in text
    assert success_rates(whole, "cells", "argmax")[4, 4] == pytest.approx(0.75)
    assert drawn == [tmp_path / name for name in ("figure2-cells.png", "figure3-cells.png", "results.md")]
    for picture in drawn[:2]:
        assert picture.read_bytes()[:4] == b"\x89PNG"


def test_the_tables_of_the_docs_match_the_results_next_to_them():
    folder = Path(__file__).parents[2] / "docs" / "paper"
    drawn = "\n".join(tables(Experiment(Options(folder=folder)))) + "\n"
    assert (folder / "results.md").read_text() == drawn
    assert drawn.count("\n## ") >= 1
    assert "\n| n12-k3-informed* argmax,pibt |" in drawn, "a star knows the map"


def test_the_results_of_the_docs_are_those_of_the_package():
    results = Path(__file__).parents[2] / "docs" / "paper" / "results"
    played = {path.stem: json.loads(path.read_text())["settings"]["policy"] for path in results.glob("*/n*-k3*.json")}
    packaged = {name: fingerprint(load(name.replace("-k3", ""))) for name in played if "connected" not in name}
    assert len(packaged) == 6
    for name, known in packaged.items():
        assert played[name] == known, name
