"""The settings: the paper's constants by their numbers, files that return what they hold, errors by name."""

from dataclasses import asdict, fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnn_policy import Execution, PolicyConfig
from gnn_policy.cases import Family, make_cases
from gnn_policy.config import TrainConfig
from gnn_policy.recipes import RECIPES
from mapf_env import save_map
from small_training import CONFIG, MIXED


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
        ("rounds", 150),
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
    assert RECIPES["paper"].updates_per_round is None


EXAMPLES = {
    **RECIPES,
    "changed": replace(
        RECIPES["quick"],
        policy=PolicyConfig(
            taps=2,
            comm_radius=7.5,
            extra_channels=("cost_to_go", "other_goals"),
            robot_features=("on_goal", "last_moves"),
            edge_features=("relative_position", "priority"),
            graph_layer="attention",
            memory=3,
        ),
        execution=Execution(actions="sampled", temperature=0.1 + 0.2, shield="pibt", comm_range="connected"),
        rollout_actions="stuck",
        styles=("walls", "maze"),
        files=('C:\\maps\\"odd" ü.map', "two"),
        init="n12",
        lr=3e-4,
        seed=2**40,
        updates_per_round=None,
    ),
    "families": MIXED,
    "argmax": replace(
        TrainConfig(), rollout_actions="sampled", execution=Execution(actions="argmax"), weight_decay=1e-300
    ),
}


@pytest.mark.parametrize("config", EXAMPLES.values(), ids=EXAMPLES)
def test_settings_return_from_their_file(tmp_path, config):
    config.save(tmp_path / "config.toml")
    assert TrainConfig.load(tmp_path / "config.toml") == config
    assert TrainConfig.from_toml(config.to_toml()).to_toml() == config.to_toml()


@given(
    lr=st.floats(1e-300, 1e300),
    density=st.floats(0, 1),
    radius=st.floats(0, 1e6),
    seed=st.integers(0, 2**63 - 1),
    shares=st.lists(st.floats(1e-9, 1e9), max_size=3),
    file=st.text(st.characters(exclude_categories=("Cs",)), min_size=1),
)
def test_any_numbers_and_texts_return_from_toml(lr, density, radius, seed, shares, file):
    config = TrainConfig(
        policy=PolicyConfig(comm_radius=radius),
        families=tuple(Family(share=share, density=(0, density)) for share in shares),
        files=(file,),
        lr=lr,
        density=density,
        seed=seed,
    )
    assert TrainConfig.from_toml(config.to_toml()) == config


def test_a_settings_file_needs_only_what_differs_from_the_defaults(tmp_path):
    (tmp_path / "mine.toml").write_text(
        """
        rounds = 7
        lr = 1
        [policy]
        taps = 2
        extra_channels = ["cost_to_go"]
        [execution]
        shield = "pibt"
        [[families]]
        style = "maze"
        height = [10, 30]
        corridor_width = [1, 3]
        [[families]]
        share = 2
        num_agents = [4, 40]
        density = [0, 0.3]
        """
    )
    assert TrainConfig.load(tmp_path / "mine.toml") == TrainConfig(
        rounds=7,
        lr=1,
        policy=PolicyConfig(taps=2, extra_channels=("cost_to_go",)),
        execution=Execution(actions="stuck", shield="pibt"),
        families=(
            Family(style="maze", height=(10, 30), corridor_width=(1, 3)),
            Family(share=2, num_agents=(4, 40), density=(0, 0.3)),
        ),
    )
    assert TrainConfig.from_toml("") == TrainConfig()


@pytest.mark.parametrize(
    "damaged",
    [
        "{",
        "rounds = ",
        "rounds = 1\nrounds = 2",
        "policy = 1",
        "execution = []",
        "families = 3",
        "families = [1]",
        "[families]\nstyle = 'maze'",
        "rounds = '7'",
        "rounds = 7.5",
        "rounds = true",
        "files = 'own.map'",
        "[policy]\ntaps = 0",
        "[execution]\nshield = 'none'",
        "[[families]]\nheight = 8",
        "[[families]]\nheight = [8]",
        "a = " + "[" * 5000,
        "\x00",
    ],
)
def test_damaged_settings_name_their_file_in_one_line(tmp_path, damaged):
    (tmp_path / "config.toml").write_text(damaged)
    with pytest.raises(ValueError, match=r"config\.toml: not the settings of a training"):
        TrainConfig.load(tmp_path / "config.toml")


@pytest.mark.parametrize(
    ("text", "listed"),
    [
        ("round = 1", ("'round'", "rounds", "families", "num_agents")),
        ("[policy]\ntap = 1", ("'tap'", "taps", "extra_channels", "comm_radius")),
        ("[execution]\nshields = 'pibt'", ("'shields'", "shield", "temperature")),
        ("[[families]]\nsize = [1, 2]", ("'size'", "height", "width", "share")),
    ],
)
def test_an_unknown_setting_is_named_with_all_that_there_are(text, listed):
    with pytest.raises(ValueError, match=r"there is no setting .*[Tt]he settings are ") as refusal:
        TrainConfig.from_toml(text)
    for word in listed:
        assert word in str(refusal.value)
    assert TrainConfig.from_toml(text, ignore_unknown=True) in (TrainConfig(), TrainConfig(families=(Family(),)))


def test_rollouts_of_training_have_the_policys_execution_except_for_the_actions():
    config = TrainConfig(execution=Execution(actions="stuck", temperature=0.5, shield="pibt", comm_range="connected"))
    assert config.rollout_execution == replace(config.execution, actions="argmax")
    for actions in ("sampled", "stuck"):
        assert replace(config, rollout_actions=actions).rollout_execution == replace(config.execution, actions=actions)


def test_settings_of_one_family_are_its_ranges_and_families_replace_them():
    config = TrainConfig(num_agents=7, height=8, width=9, density=0.2, styles=("walls", "maze"))
    assert config.case_families == tuple(
        Family(style=style, height=(8, 8), width=(9, 9), num_agents=(7, 7), density=(0.2, 0.2))
        for style in ("walls", "maze")
    )
    assert MIXED.case_families == MIXED.families


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_the_cases_of_a_split_have_the_sizes_that_the_settings_say(split):
    config = replace(CONFIG, train_maps=5, validation_maps=4, test_maps=3, cases_per_map=2, validation_cases_per_map=1)
    maps, cases_per_map = {"train": (5, 2), "validation": (4, 1), "test": (3, 2)}[split]
    cases = config.cases(split)
    assert (len(cases.grids), len(cases)) == (maps, maps * cases_per_map)
    expected = make_cases(split, seed=0, maps=maps, cases_per_map=cases_per_map, families=config.case_families)
    assert cases.instances == expected.instances
    mixed = replace(config, families=MIXED.families).cases(split)
    assert {each.num_agents for each in mixed.instances} <= set(range(2, 6))
    assert len(mixed) == maps * cases_per_map


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_a_split_that_leaves_a_family_without_a_map_is_refused(split):
    rare = (Family(share=9.0), Family(style="maze", share=1.0))
    enough = replace(CONFIG, train_maps=10, validation_maps=10, test_maps=10, families=rare)
    assert set(enough.cases(split).family_of) == {0, 1}
    with pytest.raises(
        ValueError, match=f'{split}_maps = 4 leaves 1 of 2 families without a map, the first of them style "maze"'
    ):
        replace(enough, **{f"{split}_maps": 4}).cases(split)


def test_the_cases_of_files_are_of_the_files_and_of_the_seed(tmp_path):
    save_map(tmp_path / "own.map", np.zeros((6, 7), bool))
    config = replace(CONFIG, files=(str(tmp_path),), families=MIXED.families)
    cases = config.cases("train")
    assert len(cases) == config.cases_per_map
    assert {(each.grid.shape, each.num_agents) for each in cases.instances} == {((6, 7), config.num_agents)}
    assert replace(config, data_seed=1).cases("train").instances != cases.instances


WRONG = {
    **{name: 0 for name, value in asdict(TrainConfig()).items() if name in {"lr", "final_lr", "timeout", "w"}},
    "num_agents": 0,
    "train_maps": 0,
    "validation_maps": 0,
    "test_maps": 0,
    "cases_per_map": 0,
    "validation_cases_per_map": 0,
    "expert_nodes": 0,
    "rounds": 0,
    "updates_per_round": 0,
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
    "rollout_actions": "always",
    "validate_every": 0,
    "seed": -1,
    "data_seed": -1,
    "threads": -1,
}


@pytest.mark.parametrize(("name", "value"), WRONG.items())
def test_a_setting_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        TrainConfig(**{name: value})


@pytest.mark.parametrize("kind", [TrainConfig, PolicyConfig, Execution, Family])
def test_an_unknown_argument_is_refused_with_all_that_exist(kind):
    with pytest.raises(TypeError) as refusal:
        kind(nonsense=1)
    listed = ", ".join(sorted(each.name for each in fields(kind)))
    assert str(refusal.value) == f"{kind.__name__} has no setting 'nonsense': the settings are {listed}"
