"""Exported policies against the networks that they were exported from."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import bags
from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig, Robot, checkpoint, export
from gnn_policy.onnx_export import compare
from gnn_policy.onnx_export import export as write_export
from gnn_policy.robot.exported import ExportedPolicy

FALLBACK = Execution(actions="fallback", temperature=0.7, shield="pibt_swap")
SHAPES = {
    "filter": {"taps": 3, "encoder": "released", "fov_radius": 3},
    "attention": {
        "taps": 2,
        "graph_layer": "attention",
        "extra_channels": ("cost_to_go", "previous_positions"),
        "robot_features": ("on_goal", "stuck", "jammed"),
        "edge_features": ("goal_direction", "relative_position"),
    },
}


@pytest.fixture(scope="module", params=SHAPES)
def exported(request, tmp_path_factory):
    """A policy with the batch statistics of noise, and the folder of its export."""
    torch.manual_seed(3)
    config = PolicyConfig(**{"encoder": "lean", "features": 16, "fov_radius": 2, **SHAPES[request.param]})
    policy = DecentralizedPolicy(config, FALLBACK)
    with torch.no_grad():
        policy(bags.random_bag(np.random.default_rng(0), [8, 8], config))
    policy.eval()
    folder = tmp_path_factory.mktemp(request.param)
    write_export(policy, folder)
    return policy, folder


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 7), share=st.floats(0, 1), loss=st.floats(0, 1))
def test_robots_without_torch_do_what_the_network_does_for_the_team(exported, seed, count, share, loss):
    policy, folder = exported
    generator = np.random.default_rng(seed)
    bag = bags.random_bag(generator, [count], policy.config, share=share, weighted=True)
    came = generator.random((policy.config.taps, count, count)) >= loss
    outcomes = []
    shared = ExportedPolicy(folder)
    for source in (policy, shared):
        robots = [Robot(source, Execution()) for _ in range(count)]
        for i, robot in enumerate(robots):
            own = [link for link, receiver in enumerate(bag.edge_index[1].tolist()) if receiver == i]
            senders = bag.edge_index[0].tolist()
            robot.begin(
                bag.fov[i].numpy(),
                {senders[link]: float(bag.edge_weight[link]) for link in own},
                (0, 0),
                scalars=bag.scalars[i].numpy(),
                edge_attr={senders[link]: bag.edge_attr[link].numpy() for link in own},
            )
        for number in range(robots[0].rounds):
            sent = [robot.message for robot in robots]
            for i, robot in enumerate(robots):
                robot.hear({j: sent[j] for j in range(count) if j in robot.links and came[number, i, j]})
        outcomes.append(np.stack([robot.logits() for robot in robots]))
    np.testing.assert_allclose(outcomes[1], outcomes[0], rtol=1e-4, atol=1e-4)
    if came.all():
        with torch.no_grad():
            np.testing.assert_allclose(outcomes[1], policy(bag).numpy(), rtol=1e-4, atol=1e-4)


def test_the_checker_passes_a_true_export_and_refuses_a_false_one(exported, tmp_path):
    policy, folder = exported
    assert compare(policy, folder, bags=18) < 1e-4
    other = DecentralizedPolicy(policy.config, policy.execution).eval()
    with pytest.raises(ValueError, match="the export of another policy"):
        compare(other, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    manifest["fingerprint"] = checkpoint.fingerprint(other)
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match="ONNX Runtime and torch differ by"):
        compare(other, tmp_path)


def test_the_manifest_says_what_a_robot_must_know(exported):
    policy, folder = exported
    manifest = json.loads((folder / "manifest.json").read_text())
    config = policy.config
    assert manifest["view"] == [config.num_channels, config.fov_side, config.fov_side]
    assert (manifest["scalars"], manifest["edge_attr"]) == (config.num_robot_features, config.num_edge_features)
    assert (manifest["rounds"], manifest["message"]) == (config.taps - 1, 16)
    assert manifest["message_bytes"] == {"float32": 65, "float16": 33, "int8": 21}
    assert manifest["fingerprint"] == checkpoint.fingerprint(policy)
    read = ExportedPolicy(folder)
    assert (read.config, read.execution) == (config, FALLBACK)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"format": "mapf-env robot 9"}, "its format is 'mapf-env robot 9'"),
        ({"rounds": 10**9}, "rounds must lie in"),
        ({"rounds": True}, "rounds must lie in"),
        ({"parts": {}}, "it has no 'encoder'"),
        ({"parts": []}, "is not the manifest"),
        ({"policy": {"taps": "two"}}, "taps"),
        ({"policy": {"nothing": 1}}, "nothing"),
        ({"execution": {"shield": "none"}}, "shield must be one of"),
        (None, "is not the manifest"),
    ],
)
def test_a_damaged_manifest_is_refused(exported, tmp_path, change, complaint):
    _, folder = exported
    manifest = json.loads((folder / "manifest.json").read_text())
    text = "{" if change is None else json.dumps(manifest | change)
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ValueError, match=complaint):
        Robot.load(tmp_path)


def test_missing_and_damaged_parts_are_named(exported, tmp_path):
    _, folder = exported
    with pytest.raises(FileNotFoundError, match=r"python -m gnn_policy\.export"):
        Robot.load(tmp_path)
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    head = tmp_path / "head.onnx"
    whole = head.read_bytes()
    head.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(ValueError, match=r"head\.onnx is damaged: its hash"):
        Robot.load(tmp_path)
    head.unlink()
    with pytest.raises(FileNotFoundError, match=r"there is no .*head\.onnx"):
        Robot.load(tmp_path)


def test_a_robot_of_an_exported_policy_loads_no_torch(exported):
    policy, folder = exported
    config = policy.config
    program = (
        "import sys, numpy as np\n"
        "for name in ('torch', 'torchrl', 'safetensors', 'tyro'): sys.modules[name] = None\n"
        "import gnn_policy\n"
        "robot = gnn_policy.Robot.load(sys.argv[1])\n"
        f"scalars = np.zeros({len(FALLBACK.robot_features(config)) + 40}, np.float32)\n"
        f"view = np.zeros({(config.num_channels, config.fov_side, config.fov_side)}, np.float32)\n"
        "robot.begin(view, {}, (0, 0), scalars=scalars)\n"
        "for _ in range(robot.rounds):\n"
        "    robot.message.to_bytes()\n"
        "    robot.hear({})\n"
        "print(robot.act())"
    )
    done = subprocess.run([sys.executable, "-c", program, str(folder)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() in "01234"


def test_a_layer_that_does_not_work_by_messages_is_not_exported(tmp_path):
    policy = DecentralizedPolicy(PolicyConfig(graph_layer="own_layers:Sums"))
    with pytest.raises(ValueError, match="cannot run on one robot"):
        write_export(policy, tmp_path / "policy")
    assert not (tmp_path / "policy").exists()


def test_the_command_exports_a_policy_and_says_how_far_it_is_from_torch(tmp_path, capsys):
    policy = DecentralizedPolicy(PolicyConfig(encoder="lean", features=8, fov_radius=2, taps=1)).eval()
    checkpoint.save(policy, tmp_path / "own.safetensors")
    export.main([str(tmp_path / "own.safetensors"), "--out", str(tmp_path / "policy"), "--bags", "9"])
    assert "2 parts, 0 rounds, messages of 0 bytes; differs from torch by" in capsys.readouterr().out
    assert compare(policy, tmp_path / "policy", bags=9) < 1e-4
    robot = Robot.load(tmp_path / "policy")
    robot.begin(np.zeros((3, 7, 7), np.float32), {}, (0, 0))
    assert 0 <= robot.act() < 5


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [(["nothing", "--out", "x"], "there is no checkpoint"), (["n12", "--out", "x", "--bags", "0"], "--bags must be")],
)
def test_wrong_arguments_take_one_line(arguments, complaint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        export.main(arguments)
    assert end.value.code == 2
    assert complaint in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
