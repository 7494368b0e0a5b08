"""The settings: the paper's constants by their numbers, files that return what they hold, errors by name."""

from dataclasses import asdict, replace

import pytest

from gnn_policy import PolicyConfig
from gnn_policy.config import RECIPES, TrainConfig


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("train_maps", 420),
        ("validation_maps", 90),
        ("test_maps", 90),
        ("cases_per_map", 50),
        ("height", 20),
        ("width", 20),
        ("density", 0.1),
        ("timeout", 3.0),
        ("lr", 1e-3),
        ("final_lr", 1e-6),
        ("epochs", 150),
        ("batch_size", 64),
        ("weight_decay", 1e-5),
        ("beta1", 0.9),
        ("dagger_every", 4),
    ],
)
def test_the_paper_recipe_has_the_papers_constants(name, value):
    assert getattr(RECIPES["paper"], name) == value


@pytest.mark.parametrize(
    ("name", "value"),
    [("fov_radius", 4), ("comm_radius", 5.0), ("taps", 3), ("features", 128), ("encoder", "released")],
)
def test_the_paper_recipe_has_the_papers_network(name, value):
    assert getattr(RECIPES["paper"].policy, name) == value


def test_an_epoch_of_the_paper_is_a_pass_over_the_data():
    assert RECIPES["paper"].updates_per_epoch is None


def test_settings_return_from_their_file(tmp_path):
    config = replace(
        RECIPES["quick"], policy=PolicyConfig(taps=2, comm_radius=7.5), lr=3e-4, seed=2**40, updates_per_epoch=None
    )
    config.save(tmp_path / "config.json")
    assert TrainConfig.load(tmp_path / "config.json") == config


@pytest.mark.parametrize(
    "damaged",
    ["", "{", "[]", "null", "{}", '{"policy": {}, "surprise": 1}', '{"policy": {"surprise": 1}}', '{"policy": 1}'],
)
def test_damaged_settings_name_their_file(tmp_path, damaged):
    (tmp_path / "config.json").write_text(damaged)
    with pytest.raises(ValueError, match=r"config\.json"):
        TrainConfig.load(tmp_path / "config.json")


WRONG = {
    **{name: 0 for name, value in asdict(TrainConfig()).items() if name in {"lr", "final_lr", "timeout", "w"}},
    "num_agents": 0,
    "train_maps": 0,
    "validation_maps": 0,
    "test_maps": 0,
    "cases_per_map": 0,
    "validation_cases_per_map": 0,
    "expert_nodes": 0,
    "epochs": 0,
    "updates_per_epoch": 0,
    "batch_size": 0,
    "demonstration_steps": 0,
    "dagger_every": -1,
    "dagger_steps": 0,
    "beta_decay": 1.5,
    "robot_order": "lowest",
    "aggregation": "none",
    "fresh_share": -0.1,
    "fresh_window": 0,
    "rollout_length": 0,
    "rollout_teams": 0,
    "beta1": 2.0,
    "weight_decay": -1.0,
    "validate_every": 0,
    "seed": -1,
    "data_seed": -1,
    "threads": -1,
}


@pytest.mark.parametrize(("name", "value"), WRONG.items())
def test_a_setting_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        TrainConfig(**{name: value})
