"""Checkpoints: what is loaded is what was saved, or an error says which file and why."""

import json
import os
import sys
from types import ModuleType

import pytest
import safetensors.torch
import torch

from gnn_policy import DecentralizedPolicy, PolicyConfig, Robot, checkpoint, evaluate, load, save
from own_layers import Deaf

CONFIG = PolicyConfig(encoder="lean", features=8, taps=2, fov_radius=3, comm_radius=4.5)


@pytest.fixture
def policy():
    torch.manual_seed(0)
    policy = DecentralizedPolicy(CONFIG)
    policy(torch.rand(2, 3, 3, 9, 9), torch.zeros(2, 3, 3))  # batch statistics that differ from their initial values
    return policy.eval()


@pytest.fixture
def file(policy, tmp_path):
    save(policy, tmp_path / "policy.safetensors", command="train me")
    return tmp_path / "policy.safetensors"


def test_a_policy_returns_as_it_was_saved(policy, file):
    again = load(file)
    assert again.config == CONFIG
    assert not again.training
    assert again.state_dict().keys() == policy.state_dict().keys()
    for name, tensor in policy.state_dict().items():
        assert torch.equal(again.state_dict()[name], tensor), name
    views, graph = torch.rand(2, 4, 3, 9, 9), torch.ones(2, 4, 4)
    assert torch.equal(again(views, graph), policy(views, graph))
    assert checkpoint.about(file)["command"] == "train me"


def test_a_part_of_ones_own_returns_where_it_can_be_imported(tmp_path, monkeypatch):
    module, file = ModuleType("my_parts"), tmp_path / "own.safetensors"
    module.Own = Deaf  # pyright: ignore[reportAttributeAccessIssue]
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "my_parts", module)
        policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, graph_layer="my_parts:Own")).eval()
        save(policy, file)
        views, graph = torch.rand(2, 4, 3, 11, 11), torch.ones(2, 4, 4)
        assert torch.equal(load(file)(views, graph), policy(views, graph))
        with pytest.raises(ValueError, match=r"messages of a graph filter, but .* has the graph layer 'my_parts:Own'"):
            Robot(policy)
    with pytest.raises(checkpoint.CheckpointError, match="'my_parts:Own' cannot be found"):
        load(file)


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
        with pytest.raises(FileNotFoundError, match="one of n10, n12, n12-informed, n4, n6, n8"):
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
            with_metadata(file, format="mapf-env policy 2")
        case "without settings":
            file.write_bytes(safetensors.torch.save(safetensors.torch.load(content), {"format": checkpoint.FORMAT}))
        case "settings are no JSON":
            with_metadata(file, policy="{")
        case "settings are no table":
            with_metadata(file, policy="null")
        case "unknown setting":
            with_metadata(file, policy=json.dumps({**settings, "layers": 7}))
        case "bad setting":
            with_metadata(file, policy=json.dumps({**settings, "taps": 0}))
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
    "settings are no JSON",
    "settings are no table",
    "unknown setting",
    "bad setting",
    "other size",
    "other encoder",
    "missing weights",
]


@pytest.mark.parametrize("how", DAMAGES)
def test_what_is_no_policy_of_ours_is_refused_in_one_line_that_names_the_file(file, how, capsys):
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
