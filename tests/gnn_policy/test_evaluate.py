"""The command that evaluates: any policy, any cases, as it was trained where nothing else is asked for."""

import json
import xml.etree.ElementTree as ET
from dataclasses import fields, replace

import pytest
import torch

from gnn_policy import DecentralizedPolicy, PolicyConfig, evaluate, save
from gnn_policy.config import TrainConfig

CONFIG = TrainConfig(
    policy=PolicyConfig(encoder="lean", features=8, fov_radius=2),
    num_agents=3,
    height=6,
    width=6,
    test_maps=3,
    cases_per_map=2,
    timeout=2.0,
    w=1.2,
    seed=4,
)

CHANGES = """
    --num-agents 2 5 --maps 2 --cases-per-map 3 --height 7 --width 8 --density 0.2 --styles walls --data-seed 9 --w 1.5
    --timeout 4 --temperature 0.5 --seed 6 --threads 1
"""


@pytest.fixture
def file(tmp_path):
    torch.manual_seed(0)
    save(DecentralizedPolicy(CONFIG.policy), tmp_path / "policy.safetensors", training=CONFIG.to_json())
    return tmp_path / "policy.safetensors"


def examined(monkeypatch, *arguments):
    """What the command would examine: titles to instances, and how."""
    calls = []
    monkeypatch.setattr(
        evaluate, "examine", lambda policy, instances, folder, console, **how: calls.append((instances, folder, how))
    )
    evaluate.main(list(arguments))
    return calls[0]


def test_the_help_names_every_option(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        evaluate.main(["--help"])
    text = capsys.readouterr().out
    for each in fields(evaluate.Command):
        assert (f"--{each.name.replace('_', '-')}" if each.name != "run" else "RUN") in text, each.name
    assert "Of sampling and of the shield's tie-breaking" in text


def test_what_is_not_given_is_as_in_training(file, monkeypatch):
    instances, folder, how = examined(monkeypatch, str(file))
    (cases,) = instances.values()
    assert cases == evaluate.split_cases(CONFIG, "test")
    assert (how["w"], how["timeout"], how["seed"], how["temperature"]) == (1.2, 2.0, 4, 1.0)
    assert folder == file.parent / "evaluation"


def test_every_option_reaches_the_examination(file, monkeypatch, tmp_path):
    instances, folder, how = examined(
        monkeypatch,
        str(file),
        *CHANGES.split(),
        *("--out", str(tmp_path / "out")),
    )
    changed = replace(
        CONFIG, test_maps=2, cases_per_map=3, height=7, width=8, density=0.2, styles=("walls",), data_seed=9
    )
    assert list(instances.values()) == [evaluate.split_cases(changed, "test", n) for n in (2, 5)]
    assert how == {"w": 1.5, "timeout": 4.0, "seed": 6, "threads": 1, "temperature": 0.5}
    assert torch.get_num_threads() == 1
    assert folder == tmp_path / "out"


def test_it_writes_numbers_and_an_animation(file, capsys):
    evaluate.main([str(file), "--num-agents", "2", "3", "--threads", "1"])
    folder = file.parent / "evaluation"
    tables = json.loads((folder / "results.json").read_text())
    assert [title.split()[0] for title in tables] == ["2", "3"]
    assert all(table["cases"] == 6 for table in tables.values())
    assert ET.parse(folder / "animation.svg").getroot().tag.endswith("svg")
    shown = capsys.readouterr().out
    assert "PIBT" in shown
    assert str(folder) in shown.replace("\n", "")


@pytest.mark.parametrize(
    "wrong",
    [
        "--maps 0",
        "--timeout 0",
        "--timeout -1",
        "--temperature 0",
        "--w 0.9",
        "--density 0.99",
        "--num-agents 99",
        "--num-agents 0",
        "--seed -1",
        "--threads -1",
    ],
)
def test_a_mistake_takes_one_line(file, capsys, wrong):
    with pytest.raises(SystemExit) as end:
        evaluate.main([str(file), "--threads", "1", *wrong.split()])
    assert end.value.code == 2
    shown = capsys.readouterr()
    assert shown.err.startswith("error: ")
    assert shown.err.count("\n") == 1


def test_a_policy_without_settings_meets_the_papers_cases(tmp_path, monkeypatch):
    save(DecentralizedPolicy(CONFIG.policy), tmp_path / "policy.safetensors")
    instances, _, how = examined(monkeypatch, str(tmp_path / "policy.safetensors"), "--maps", "1")
    (cases,) = instances.values()
    assert len(cases) == 50
    assert cases[0].grid.shape == (20, 20)
    assert how["timeout"] == 3.0
