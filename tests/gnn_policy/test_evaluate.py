"""The command that evaluates: any policy, any cases, as it was trained where nothing else is asked for."""

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import fields, replace

import pytest
import torch

from gnn_policy import DecentralizedPolicy, PolicyConfig, evaluate, evaluation_tables, metrics, save
from gnn_policy.config import TrainConfig
from gnn_policy.execution import Execution
from mapf_env import random_instance, save_instances
from small_training import MIXED

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
    --timeout 4 --seed 6 --threads 1 --executions stuck,0.5 argmax,pibt,connected --failures 2
    --cluster local
"""


@pytest.fixture
def file(tmp_path):
    torch.manual_seed(0)
    save(DecentralizedPolicy(CONFIG.policy), tmp_path / "policy.safetensors", training=CONFIG.to_toml())
    return tmp_path / "policy.safetensors"


def evaluated(monkeypatch, *arguments):
    """Return the settings, the folder and the options with which the command would evaluate."""
    calls = []
    monkeypatch.setattr(
        evaluation_tables,
        "evaluate_and_report",
        lambda policy, config, folder, console, **how: calls.append((config, folder, how)),
    )
    evaluate.main(list(arguments))
    return calls[0]


def test_the_help_names_every_option(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        evaluate.main(["--help"])
    text = capsys.readouterr().out
    for each in fields(evaluate.Command):
        assert (f"--{each.name.replace('_', '-')}" if each.name != "policy" else "POLICY") in text, each.name
    assert "Random seed for sampling and for the shield's tie-breaking" in text


def test_settings_that_are_not_given_are_those_of_training(file, monkeypatch):
    config, folder, how = evaluated(monkeypatch, str(file))
    assert config == CONFIG
    assert how["num_agents"] == ()
    assert how["split"] == "test"
    assert how["executions"] == [Execution(), Execution(actions="stuck"), Execution(actions="sampled")]
    assert folder == file.parent / "evaluation"


def test_executions_keep_the_shield_of_the_policys_file(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    _, folder, how = evaluated(monkeypatch, "n12-informed", "--executions", "argmax", "stuck,idle")
    assert how["executions"] == [Execution(shield="pibt"), Execution(actions="stuck")]
    assert str(folder) == "evaluation/n12-informed"
    _, folder, how = evaluated(monkeypatch, "--executions", "argmax")
    assert how["executions"] == [Execution(shield="pibt_swap", temperature=1.5)]
    assert str(folder) == "evaluation/general"
    _, _, how = evaluated(monkeypatch)
    assert [each.actions for each in how["executions"]] == ["fallback", "argmax"]


@pytest.mark.parametrize("split", ["test", "validation"])
def test_every_option_reaches_the_evaluation(file, monkeypatch, tmp_path, split):
    config, folder, how = evaluated(
        monkeypatch, str(file), *CHANGES.split(), "--split", split, "--out", str(tmp_path / "out")
    )
    size = {"test_maps": 2, "cases_per_map": 3}
    if split == "validation":
        size = {"validation_maps": 2, "validation_cases_per_map": 3}
    assert config == replace(
        CONFIG, **size, height=7, width=8, density=0.2, styles=("walls",), data_seed=9, w=1.5, timeout=4.0, seed=6
    )
    assert how == {
        "num_agents": (2, 5),
        "executions": [Execution(actions="stuck", temperature=0.5), Execution(shield="pibt", comm_range="connected")],
        "split": split,
        "steps": 256,
        "whole": False,
        "threads": 1,
        "failures": 2,
        "cluster": "local",
    }
    assert torch.get_num_threads() == 1
    assert folder == tmp_path / "out"


def test_it_writes_numbers_and_an_animation(file, capsys):
    evaluate.main([str(file), "--num-agents", "2", "3", "--threads", "1", "--failures", "2"])
    folder = file.parent / "evaluation"
    page = (folder / "failures.html").read_text(encoding="utf-8")
    assert [page.count(f'"title":"{n} robots, case ') for n in (2, 3)] == [2, 2]
    tables = json.loads((folder / "results.json").read_text())["tables"]
    assert list(tables) == ["2", "3"]
    assert all(table["cases"] == 6 for table in tables.values())
    assert ET.parse(folder / "animation.svg").getroot().tag.endswith("svg")
    shown = capsys.readouterr().out
    assert "PIBT" in shown
    assert str(folder) in shown.replace("\n", "")


def test_the_default_executions_differ_in_their_actions(file, monkeypatch):
    execution = Execution(actions="sampled", temperature=0.5, shield="pibt", comm_weights="distance")
    save(DecentralizedPolicy(CONFIG.policy, execution), file, training=CONFIG.to_toml())
    _, _, how = evaluated(monkeypatch, str(file))
    assert how["executions"] == [replace(execution, actions=actions) for actions in ("argmax", "stuck", "sampled")]
    _, _, how = evaluated(monkeypatch, str(file), "--executions", "stuck")
    assert how["executions"] == [replace(execution, actions="stuck")]
    _, _, how = evaluated(monkeypatch, str(file), "--executions", "stuck,1,idle,binary")
    assert how["executions"] == [Execution(actions="stuck", comm_weights="binary")]


def test_families_of_training_have_a_table_each_unless_a_map_is_given(file, monkeypatch, capsys):
    save(DecentralizedPolicy(CONFIG.policy), file, training=replace(CONFIG, families=MIXED.families).to_toml())
    evaluate.main([str(file), "--threads", "1", "--executions", "argmax"])
    folder = file.parent / "evaluation"
    results = json.loads((folder / "results.json").read_text())
    assert list(results["tables"]) == ["2 to 5 robots, family 1 (cells)", "3 to 4 robots, family 2 (maze)"]
    shown = capsys.readouterr().out
    assert all(f"{title}, 3 test maps" in shown for title in results["tables"])
    evaluate.main([str(file), "--executions", "argmax", "--num-agents", "2", "4", "--out", str(file.parent / "sizes")])
    sized = json.loads((file.parent / "sizes" / "results.json").read_text())
    assert list(sized["tables"]) == [
        f"{N} robots, family {family}" for family in ("1 (cells)", "2 (maze)") for N in (2, 4)
    ]
    config, _, _ = evaluated(monkeypatch, str(file), "--height", "9", "--out", str(file.parent / "high"))
    assert config == replace(CONFIG, height=9)


def test_families_of_lifelong_tasks_have_tables_of_throughput_next_to_those_of_success(file, capsys):
    both = (MIXED.families[0], replace(MIXED.families[1], task="lifelong"))
    save(DecentralizedPolicy(CONFIG.policy), file, training=replace(CONFIG, families=both).to_toml())
    for task, kinds in (None, ["success_rate", "throughput"]), ("lifelong", ["throughput", "throughput"]):
        out = file.parent / str(task)
        words = ["--threads", "1", "--executions", "argmax", "--steps", "20", "--out", str(out)]
        evaluate.main([str(file), *words, *(["--task", task] if task else [])])
        results = json.loads((out / "results.json").read_text())
        for table, kind in zip(results["tables"].values(), kinds, strict=True):
            assert {"success_rate", "throughput"} & table["rows"][0].keys() == {kind}
        assert results["settings"]["steps"] == 20
        assert "arrivals" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        evaluate.main([str(file), "--failures", "1", "--out", str(file.parent / "failures")])
    assert "a lifelong team cannot fail" in capsys.readouterr().err


def test_evaluations_of_other_families_are_not_mixed_up(file, capsys):
    for number, families in enumerate((MIXED.families, (replace(MIXED.families[0], density=(0.3, 0.3)),))):
        save(DecentralizedPolicy(CONFIG.policy), file, training=replace(CONFIG, families=families).to_toml())
        if not number:
            evaluate.main([str(file), "--threads", "1", "--executions", "argmax"])
    with pytest.raises(SystemExit):
        evaluate.main([str(file), "--threads", "1", "--executions", "argmax"])
    assert "other settings (" in capsys.readouterr().err


@pytest.mark.parametrize("split", ["test", "validation"])
def test_the_users_files_are_evaluated(file, tmp_path, capsys, split):
    grid = random_instance(height=6, width=7, density=0.1, seed=0).grid
    instances = [random_instance(grid=grid, num_agents=2 + seed % 3, seed=seed) for seed in range(20)]
    save_instances(tmp_path / "set.json", instances)
    out = tmp_path / "out"
    evaluate.main([str(file), "--files", str(tmp_path / "set.json"), "--split", split, "--out", str(out)])
    results = json.loads((out / "results.json").read_text())
    assert list(results["tables"]) == ["your maps"]
    assert results["tables"]["your maps"]["cases"] == 20
    assert results["settings"]["files"] == [str(tmp_path / "set.json")]
    assert "your maps" in capsys.readouterr().out


def test_lifelong_teams_have_a_table_of_throughput(file, capsys):
    arguments = [str(file), "--task", "lifelong", "--steps", "20", "--num-agents", "2", "3", "--threads", "1"]
    evaluate.main(arguments)
    numbers = file.parent / "evaluation" / "results.json"
    before = numbers.read_bytes()
    results = json.loads(before)
    assert (results["settings"]["task"], results["settings"]["steps"]) == ("lifelong", 20)
    assert list(results["tables"]) == ["2", "3"]
    for table in results["tables"].values():
        assert [row["name"] for row in table["rows"]] == [
            "argmax",
            "stuck,1",
            "sampled,1",
            *metrics.LIFELONG_BASELINES,
        ]
        rates = {row["name"]: row["throughput"]["mean"] for row in table["rows"]}
        assert rates["PIBT*"] > rates["random"] >= 0
        assert (table["cases"], table["steps"]) == (6, 20)
    shown = capsys.readouterr().out
    assert "arrivals" in shown
    assert "3 robots, 3 test maps" in shown
    assert ET.parse(numbers.parent / "animation.svg").getroot().tag.endswith("svg")
    assert "arrivals per step" in (numbers.parent / "animation.svg").read_text()
    evaluate.main(arguments)
    assert numbers.read_bytes() == before
    capsys.readouterr()
    for other in (["--steps", "21"], ["--task", "one_shot"]):
        with pytest.raises(SystemExit):
            evaluate.main([*arguments, *other])
        assert "other settings (" in capsys.readouterr().err


def test_evaluation_loads_neither_the_training_loop_nor_torchrl(file):
    program = (
        "import sys\n"
        "from gnn_policy import evaluate\n"
        f"evaluate.main([{str(file)!r}, '--threads', '1', '--maps', '1', '--cases-per-map', '1'])\n"
        "training = {'training', 'dagger', 'labelling', 'demonstrations', 'imitation', 'team_env', 'half_batches'}\n"
        "heavy = {'torchrl', 'tensorboard', *(f'gnn_policy.{name}' for name in training)}\n"
        "print(sorted(heavy & sys.modules.keys()))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ("--styles walls", "styles"),
        ("--executions argmax", "executions"),
        ("--num-agents 2", "tables"),
        ("--split validation --maps 3 --cases-per-map 2", "split"),
        ("--maps 2 --seed 9", "maps, seed"),
    ],
)
def test_results_of_other_settings_are_not_overwritten(file, capsys, changed, named):
    evaluate.main([str(file), "--threads", "1"])
    numbers = file.parent / "evaluation" / "results.json"
    before = numbers.read_bytes()
    evaluate.main([str(file)])
    assert numbers.read_bytes() == before, "equal settings give equal numbers"
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        evaluate.main([str(file), *changed.split()])
    assert end.value.code == 2
    shown = capsys.readouterr()
    assert shown.err == (
        f"error: {numbers} has results of other settings ({named}): choose another folder with --out, "
        "or delete the file\n"
    )
    assert "robots" not in shown.out, "it is refused before any work"
    assert numbers.read_bytes() == before
    evaluate.main([str(file), *changed.split(), "--out", str(file.parent / "other")])
    assert (file.parent / "other" / "results.json").exists()


def test_results_of_another_policy_or_another_program_are_not_overwritten(file, capsys):
    evaluate.main([str(file), "--threads", "1"])
    numbers = file.parent / "evaluation" / "results.json"
    torch.manual_seed(1)
    save(DecentralizedPolicy(CONFIG.policy), file, training=CONFIG.to_toml())
    for content, named in ((numbers.read_text(), "policy"), ("[]", "unknown"), ("{", "unknown"), ("{}", "unknown")):
        numbers.write_text(content)
        with pytest.raises(SystemExit):
            evaluate.main([str(file)])
        assert f"other settings ({named})" in capsys.readouterr().err
        assert numbers.read_text() == content


@pytest.mark.parametrize(
    "wrong",
    [
        "--maps 0",
        "--timeout 0",
        "--timeout -1",
        "--executions sampled,0",
        "--executions argmax guess",
        "--executions",
        "--w 0.9",
        "--density 0.99",
        "--num-agents 99",
        "--num-agents 0",
        "--seed -1",
        "--threads -1",
        "--device abacus",
        "--failures -1",
        "--failures 1 --task lifelong",
        "--task lifelong --steps 0",
        "--files nowhere.map",
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
    config, _, _ = evaluated(monkeypatch, str(tmp_path / "policy.safetensors"), "--maps", "1")
    assert config == replace(TrainConfig(), test_maps=1)


def test_each_team_size_is_written_when_it_is_finished_and_not_played_again(file, monkeypatch, capsys):
    numbers, sizes = file.parent / "evaluation" / "results.json", ["2", "3", "4"]
    whole = file.parent / "whole"
    evaluate.main([str(file), "--num-agents", *sizes, "--out", str(whole)])
    compare, played = metrics.compare, []

    def interrupted(reference, *given, **options):
        played.append(reference.instances[0].num_agents)
        if len(played) == 3:
            raise KeyboardInterrupt
        return compare(reference, *given, **options)

    monkeypatch.setattr(metrics, "compare", interrupted)
    with pytest.raises(SystemExit) as end:
        evaluate.main([str(file), "--num-agents", *sizes])
    assert end.value.code == 130
    assert list(json.loads(numbers.read_text())["tables"]) == ["2", "3"]
    capsys.readouterr()
    evaluate.main([str(file), "--num-agents", *sizes])
    assert played == [2, 3, 4, 4]
    assert numbers.read_bytes() == (whole / "results.json").read_bytes()
    assert (numbers.parent / "animation.svg").read_bytes() == (whole / "animation.svg").read_bytes()
    shown = capsys.readouterr().out
    assert all(f"{size} robots, 3 test maps" in shown for size in sizes)
    evaluate.main([str(file), "--num-agents", *sizes])
    assert played[4:] == [2, 3, 4], "a complete evaluation is repeated"
    assert numbers.read_bytes() == (whole / "results.json").read_bytes()
