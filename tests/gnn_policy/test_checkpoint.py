"""Checkpoints: what is loaded is what was saved, or an error says which file and why."""

import json
import os
import subprocess
import sys
import tomllib
from dataclasses import asdict
from types import ModuleType

import numpy as np
import pytest
import safetensors.torch
import tomli_w
import torch

from bags import random_bag
from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig, checkpoint, evaluate, load, play, rollout, save
from gnn_policy.config import TrainConfig
from mapf_env import random_instance, save_map
from own_layers import Deaf

CONFIG = PolicyConfig(encoder="lean", features=8, taps=2, fov_radius=3, comm_radius=4.5)

EXECUTION = Execution(
    actions="sampled", temperature=0.5, shield="pibt", comm_range="connected", comm_weights="distance"
)


@pytest.fixture
def policy():
    torch.manual_seed(0)
    policy = DecentralizedPolicy(CONFIG, EXECUTION)
    policy(random_bag(np.random.default_rng(0), [3, 3], CONFIG))  # batch statistics that differ from their first values
    return policy.eval()


@pytest.fixture
def file(policy, tmp_path):
    save(policy, tmp_path / "policy.safetensors", command="train me")
    return tmp_path / "policy.safetensors"


def test_a_policy_returns_as_it_was_saved(policy, file):
    again = load(file)
    assert (again.config, again.execution) == (CONFIG, EXECUTION)
    assert checkpoint.executed_as(file) == EXECUTION
    assert not again.training
    assert again.state_dict().keys() == policy.state_dict().keys()
    for name, tensor in policy.state_dict().items():
        assert torch.equal(again.state_dict()[name], tensor), name
    bag = random_bag(np.random.default_rng(1), [4, 1, 7], CONFIG)
    assert torch.equal(again(bag), policy(bag))
    assert checkpoint.about(file)["command"] == "train me"


def test_a_part_of_ones_own_returns_where_it_can_be_imported(tmp_path, monkeypatch):
    module, file = ModuleType("my_parts"), tmp_path / "own.safetensors"
    module.Own = Deaf  # pyright: ignore[reportAttributeAccessIssue]
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "my_parts", module)
        policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, graph_layer="my_parts:Own")).eval()
        save(policy, file)
        bag = random_bag(np.random.default_rng(1), [4, 2], policy.config)
        assert torch.equal(load(file, plugins={"my_parts:Own"})(bag), policy(bag))
    with pytest.raises(checkpoint.CheckpointError, match="'my_parts:Own' cannot be found"):
        load(file, plugins=("my_parts:Own",))


def test_other_networks_are_not_saved(tmp_path):
    with pytest.raises(TypeError, match=r"save writes a DecentralizedPolicy, got Linear: .* torch\.save"):
        save(torch.nn.Linear(3, 5), tmp_path / "linear.safetensors")  # pyright: ignore[reportArgumentType]
    assert not os.listdir(tmp_path)


def test_weights_too_small_to_show_are_saved_as_zero(policy, file):
    with torch.no_grad():
        policy.head.weight[0, :3] = torch.tensor([1e-40, -1e-16, 1e-14])
        expected = policy.head.weight.clone()
        expected[0, :2] = 0
    save(policy, file)
    assert torch.equal(load(file).head.weight, expected)
    for packaged in checkpoint.WEIGHTS.glob("*.safetensors"):
        for name, tensor in load(packaged).state_dict().items():
            assert not ((tensor != 0) & (tensor.abs() < 1e-15)).any(), f"{packaged.name}: {name}"


def test_a_run_folder_stands_for_its_best_policy(policy, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"best\.safetensors"):
        load(tmp_path)
    save(policy, str(tmp_path / "best.safetensors"))
    assert load(str(tmp_path)).config == CONFIG


def test_a_policy_of_the_package_is_loaded_by_its_name_unless_there_is_such_a_file(policy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for packaged in checkpoint.WEIGHTS.glob("*.safetensors"):
        by_name, by_path = load(packaged.stem), load(packaged)
        assert checkpoint.fingerprint(by_name) == checkpoint.fingerprint(by_path)
    save(policy, "n10")
    assert load("n10").config == CONFIG
    for missing in ("n11", f"../{checkpoint.WEIGHTS.name}/n12"):
        with pytest.raises(FileNotFoundError, match="one of general, n10, n12, n12-informed, n4, n6, n8"):
            load(missing)


def test_other_users_may_read_what_the_umask_lets_them(file):
    plain = file.with_name("plain")
    plain.write_text("")
    assert file.stat().st_mode == plain.stat().st_mode


def with_metadata(file, **changes):
    metadata = {**checkpoint.about(file), **changes}
    file.write_bytes(safetensors.torch.save(safetensors.torch.load_file(file), metadata))


def damage(file, how):
    content = file.read_bytes()
    settings = json.loads(checkpoint.about(file)["policy"])
    match how:
        case "empty":
            file.write_bytes(b"")
        case "no header":
            file.write_bytes(content[:6])
        case "half a header":
            file.write_bytes(content[:200])
        case "truncated":
            file.write_bytes(content[:-1])
        case "longer":
            file.write_bytes(content + b"\0")
        case "noise":
            file.write_bytes(bytes(range(256)) * 8)
        case "text":
            file.write_text("these are not the weights that you are looking for")
        case "pickle":
            torch.save(safetensors.torch.load(content), file)
        case "foreign":
            file.write_bytes(safetensors.torch.save({"weight": torch.zeros(3)}))
        case "later format":
            with_metadata(file, format="mapf-env policy 3")
        case "without settings":
            file.write_bytes(safetensors.torch.save(safetensors.torch.load(content), {"format": checkpoint.FORMAT}))
        case "settings are not JSON":
            with_metadata(file, policy="{")
        case "settings are not a table":
            with_metadata(file, policy="null")
        case "unknown setting":
            with_metadata(file, policy=json.dumps({**settings, "layers": 7}))
        case "bad setting":
            with_metadata(file, policy=json.dumps({**settings, "taps": 0}))
        case "without execution":
            notes = {name: value for name, value in checkpoint.about(file).items() if name != "execution"}
            file.write_bytes(safetensors.torch.save(safetensors.torch.load(content), notes))
        case "execution is not a table":
            with_metadata(file, execution="[1]")
        case "unknown execution":
            with_metadata(file, execution=json.dumps({"patience": 2}))
        case "bad execution":
            with_metadata(file, execution=json.dumps({"shield": "none"}))
        case "other size":
            with_metadata(file, policy=json.dumps({**settings, "features": 16}))
        case "other encoder":
            with_metadata(file, policy=json.dumps({**settings, "encoder": "released"}))
        case "missing weights":
            weights = safetensors.torch.load(content)
            weights.pop("head.bias")
            file.write_bytes(safetensors.torch.save(weights, checkpoint.about(file)))


DAMAGES = [
    "empty",
    "no header",
    "half a header",
    "truncated",
    "longer",
    "noise",
    "text",
    "pickle",
    "foreign",
    "later format",
    "without settings",
    "settings are not JSON",
    "settings are not a table",
    "unknown setting",
    "bad setting",
    "without execution",
    "execution is not a table",
    "unknown execution",
    "bad execution",
    "other size",
    "other encoder",
    "missing weights",
]


@pytest.mark.parametrize("how", DAMAGES)
def test_damaged_and_foreign_files_are_refused_in_one_line_that_names_the_file(file, how, capsys):
    damage(file, how)
    with pytest.raises(checkpoint.CheckpointError) as refusal:
        load(file)
    assert str(file) in str(refusal.value)
    assert "\n" not in str(refusal.value)
    with pytest.raises(SystemExit) as end:
        evaluate.main([str(file)])
    assert end.value.code == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err == f"error: {refusal.value}\n"


def test_a_missing_file_is_named(tmp_path, capsys):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.safetensors"):
        load(tmp_path / "nowhere.safetensors")
    with pytest.raises(SystemExit) as end:
        evaluate.main([str(tmp_path / "nowhere")])
    assert end.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_crash_in_the_middle_of_saving_leaves_the_old_policy(policy, file, monkeypatch):
    before = file.read_bytes()

    def power_cut(*_):
        raise OSError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", power_cut)
        with pytest.raises(OSError, match="power cut"):
            save(policy, file, command="another")
    assert file.read_bytes() == before
    assert os.listdir(file.parent) == [file.name]


def own_file(tmp_path, monkeypatch, body, part="encoder"):
    """A policy whose configuration names a class of `evil.py` in the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "evil", raising=False)
    (tmp_path / "evil.py").write_text(body)
    torch.manual_seed(0)
    save(DecentralizedPolicy(CONFIG), tmp_path / "evil.safetensors")
    settings = {**json.loads(checkpoint.about(tmp_path / "evil.safetensors")["policy"]), part: "evil:Net"}
    with_metadata(tmp_path / "evil.safetensors", policy=json.dumps(settings))
    save_map("own.map", np.zeros((4, 4), bool))
    return tmp_path / "evil.safetensors"


COMMANDS = [(evaluate, ["evil.safetensors"]), (play, ["own.map", "--agents", "2", "--policy", "evil.safetensors"])]


@pytest.mark.parametrize("part", ["encoder", "graph_layer"])
def test_a_file_imports_nothing_that_the_user_has_not_asked_for(tmp_path, monkeypatch, capsys, part):
    file = own_file(tmp_path, monkeypatch, "open('ran', 'w')\nraise SystemExit(0)", part)
    for plugins in ((), ("other:Net",), ["evil:Other"]):
        with pytest.raises(checkpoint.CheckpointError, match=r"'evil:Net' from the module 'evil'.*--plugins evil:Net"):
            load(file, plugins=plugins)
    with pytest.raises(TypeError, match="plugins"):
        load(file, plugins="evil:Net")
    for command, arguments in COMMANDS:
        with pytest.raises(SystemExit) as end:
            command.main(arguments)
        assert end.value.code == 2
        told = capsys.readouterr().err
        assert "'evil'" in told
        assert told.count("\n") == 1
    assert not (tmp_path / "ran").exists()
    assert "evil" not in sys.modules


@pytest.mark.parametrize(
    "body", ["raise SystemExit(0)", "import sys; sys.exit()", "1 / 0", "def", "raise RuntimeError('two\\nlines')"]
)
def test_a_module_that_fails_when_it_is_imported_is_an_error_in_one_line(tmp_path, monkeypatch, capsys, body):
    own_file(tmp_path, monkeypatch, body)
    for command, arguments in COMMANDS:
        with pytest.raises(SystemExit) as end:
            command.main([*arguments, "--plugins", "evil:Net"])
        assert end.value.code == 2
        told = capsys.readouterr().err
        assert "evil:Net" in told
        assert told.count("\n") == 1
    assert not list(tmp_path.glob("*.html"))


@pytest.mark.parametrize(
    "settings",
    [
        {"features": 25_000},
        {"features": 2**31 - 1},
        {"taps": 2**31 - 1},
        {"fov_radius": 10_000},
        {"fov_radius": 2**31 - 1},
        {"extra_channels": ["cost_to_go"]},
        {"encoder": "released", "features": 25_000},
    ],
)
def test_sizes_in_a_file_are_compared_with_its_tensors_before_memory_is_allocated(file, settings):
    with_metadata(file, policy=json.dumps({**json.loads(checkpoint.about(file)["policy"]), **settings}))
    resource = pytest.importorskip("resource")  # not on Windows
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(checkpoint.CheckpointError, match=r"policy\.safetensors"):
        load(file)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "kilobytes"


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("encoder", [5, None, [], {}, "", "none"]),
        ("graph_layer", [5, None, [], "none"]),
        ("features", ["8", 8.5, None, True, 0, -8, 2**40, 1e400]),
        ("taps", ["2", 2.0, None, False, 0]),
        ("fov_radius", [[3], "3", 1, None]),
        ("comm_radius", ["4", None, True, -1, float("nan")]),
        ("comm_range", [5, None, "far", []]),
        ("comm_weights", [5, None, "heavy"]),
        ("extra_channels", [1, None, ["smell"], [3], ["cost_to_go", "cost_to_go"]]),
        ("robot_features", [None, ["name"]]),
        ("edge_features", [True, ["distance"]]),
        ("memory", ["4", 0, 17, None]),
    ],
)
def test_settings_of_a_wrong_type_or_range_are_refused_in_one_line_that_names_them(file, capsys, name, values):
    for value in values:
        with_metadata(file, policy=json.dumps({**json.loads(checkpoint.about(file)["policy"]), name: value}))
        with pytest.raises(checkpoint.CheckpointError, match=name):
            load(file)
        with pytest.raises(SystemExit) as end:
            evaluate.main([str(file)])
        assert end.value.code == 2
        assert capsys.readouterr().err.count("\n") == 1
        with_metadata(file, policy=json.dumps(asdict(CONFIG)))


@pytest.mark.parametrize("text", ["[" * 100_000, "{" * 100_000, '{"a":' * 50_000, "[]", "nul", "1" * 5000])
def test_unknown_settings_are_refused(file, text, capsys):
    with_metadata(file, policy=text)
    with pytest.raises(checkpoint.CheckpointError, match=r"policy\.safetensors"):
        load(file)
    with_metadata(file, policy=json.dumps(asdict(CONFIG)), training=text)
    assert load(file).config == CONFIG
    with pytest.raises(SystemExit) as end:
        evaluate.main([str(file)])
    assert end.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_newer_training_settings_stop_neither_play_nor_evaluation(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_map("own.map", np.zeros((4, 4), bool))
    trained = TrainConfig(policy=CONFIG, test_maps=3, execution=Execution(shield="pibt"))
    settings = tomllib.loads(trained.to_toml()) | {"momentum": [0.9]}
    settings["policy"]["dilation"] = settings["execution"]["patience"] = 2  # pyright: ignore[reportArgumentType, reportCallIssue]
    with_metadata(file, training=tomli_w.dumps(settings))
    assert checkpoint.trained_with(file) == trained
    play.main(["own.map", "--agents", "2", "--policy", str(file), "--max-steps", "3"])
    settings["styles"], settings["height"] = ["forest"], "tall"
    with_metadata(file, training=tomli_w.dumps(settings))
    assert load(file).config == CONFIG
    play.main(["own.map", "--agents", "2", "--policy", str(file), "--max-steps", "3", "--out", "second.html"])
    assert (tmp_path / "second.html").exists()
    with pytest.raises(checkpoint.CheckpointError, match="height"):
        checkpoint.trained_with(file)


def test_the_same_weights_make_the_same_file(policy, tmp_path):
    notes = {f"note {number}": str(number) for number in range(20)}
    for name in ("one", "two"):
        save(policy, tmp_path / name, **notes)
        notes = dict(reversed(notes.items()))
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert load(tmp_path / "one").config == CONFIG
    assert checkpoint.about(tmp_path / "one") == {**checkpoint.about(tmp_path / "two"), **notes}
    program = (
        "import sys, gnn_policy; policy = gnn_policy.load(sys.argv[1])\n"
        "gnn_policy.save(policy, sys.argv[2], **{f'note {n}': str(n) for n in range(20)})"
    )
    for name in ("three", "four"):
        subprocess.run([sys.executable, "-c", program, str(tmp_path / "one"), str(tmp_path / name)], check=True)
        assert (tmp_path / name).read_bytes() == (tmp_path / "one").read_bytes()


def test_a_policy_has_the_execution_of_its_file_unless_the_caller_gives_another(file):
    policy, cases = load(file), [random_instance(height=8, width=8, num_agents=6, seed=seed) for seed in range(3)]

    def paths(**how):
        return [each.paths.tolist() for each in rollout(policy, cases, max_steps=12, **how).solutions]

    assert paths() == paths(execution=EXECUTION)
    assert paths() != paths(execution=Execution())
    assert policy.env_settings() == EXECUTION.env_settings(CONFIG)


def test_the_packaged_policies_say_how_they_are_executed():
    for file in checkpoint.WEIGHTS.glob("*.safetensors"):
        trained, execution = checkpoint.trained_with(file), checkpoint.executed_as(file)
        assert load(file).execution == execution
        assert execution == {
            "general": Execution(actions="fallback", temperature=1.5, shield="pibt_swap"),
            "n12-informed": Execution(actions="stuck", shield="pibt"),
        }.get(file.stem, Execution(actions="stuck"))
        assert trained.execution == execution
        assert trained.policy == load(file).config
