"""The command that trains: complete help, options of the settings, one line for a mistake."""

import json
import re
import subprocess
import sys
from dataclasses import fields, replace
from types import ModuleType

import numpy as np
import pytest

from gnn_policy import Execution, PolicyConfig, checkpoint, load, results_json, train
from gnn_policy.config import TrainConfig
from gnn_policy.recipes import RECIPES
from mapf_env import save_map
from small_training import CONFIG, MIXED, arguments_for


def shown_help(capsys, command):
    with pytest.raises(SystemExit) as end:
        command(["--help"])
    assert end.value.code == 0
    return capsys.readouterr().out


def test_the_help_names_and_explains_every_setting(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    text = shown_help(capsys, train.main)
    options = [each.name for each in fields(TrainConfig) if each.name not in ("policy", "execution", "families")]
    options += [f"policy.{each.name}" for each in fields(PolicyConfig)] + ["recipe", "config", "run"]
    options += [f"execution.{each.name}" for each in fields(Execution)]
    for option in options:
        assert f"--{option.replace('_', '-')}" in text, option
    for words in ("T_max in makespans", "Filter taps K", "Strength of the weight decay", "quick", "paper"):
        assert words in text


def test_an_option_for_every_setting_reaches_the_settings():
    assert train.parse([]).config == RECIPES["quick"]
    assert train.parse(["--recipe", "paper"]).config == TrainConfig()
    arguments = "--seed 7 --recipe paper --lr 0.01 --policy.taps 2 --run here --no-augment"
    command = train.parse(arguments.split())
    assert command.config == replace(TrainConfig(), seed=7, lr=0.01, policy=PolicyConfig(taps=2), augment=False)
    assert str(command.run) == "here"
    quick = train.parse(["--policy.taps", "1"]).config
    assert quick == replace(RECIPES["quick"], policy=replace(RECIPES["quick"].policy, taps=1))


def test_a_policy_is_refined_as_it_is_executed():
    config = train.parse(["--recipe", "refine"]).config
    assert (config.objective, config.init) == ("delay", "general")
    assert config.policy == checkpoint.config_of("general")
    assert config.rollout_execution == checkpoint.executed_as("general")
    config = train.parse(["--recipe", "refine", "--init", "n12-informed"]).config
    assert config.policy == checkpoint.config_of("n12-informed")
    assert config.rollout_execution == checkpoint.executed_as("n12-informed")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--recipe general --num-agents 7", "--num-agents has no effect on a training with families: change the"),
        ("--recipe general --density 0.2", "--density has no effect on a training with families"),
        ("--files depot.map --styles walls", "--styles has no effect on a training with files: the maps are those"),
    ],
)
def test_options_that_have_no_effect_are_refused(capsys, options, words):
    with pytest.raises(SystemExit) as end:
        train.main(options.split())
    assert end.value.code == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert train.parse(["--files", "depot.map", "--num-agents", "7"]).config.num_agents == 7


def test_a_file_of_settings_is_the_base_of_the_other_options_and_names_the_run(tmp_path):
    MIXED.save(tmp_path / "mixed.toml")
    command = train.parse(["--config", str(tmp_path / "mixed.toml"), "--lr", "0.5", "--policy.taps", "2"])
    assert command.config == replace(MIXED, lr=0.5, policy=replace(MIXED.policy, taps=2))
    assert train.parse([f"--config={tmp_path / 'mixed.toml'}"]).config == MIXED
    (tmp_path / "two.toml").write_text("rounds = 2\n")
    assert train.parse(["--config", str(tmp_path / "two.toml")]).config == TrainConfig(rounds=2)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "none.toml"),
        ("round = 2", "there is no setting 'round': did you mean 'rounds'? The settings are aggregation"),
        ("rounds = 0", "rounds must be positive"),
        ("rounds =", "bad.toml"),
    ],
)
def test_a_file_of_settings_that_is_wrong_takes_one_line(tmp_path, capsys, content, words):
    file = tmp_path / "none.toml"
    if content is not None:
        file = tmp_path / "bad.toml"
        file.write_text(content)
    with pytest.raises(SystemExit) as end:
        train.main(["--config", str(file), "--run", str(tmp_path / "run")])
    assert end.value.code == 2
    shown = capsys.readouterr()
    assert shown.err.startswith("error: ")
    assert shown.err.count("\n") == 1
    assert words in shown.err
    assert not (tmp_path / "run").exists()


def test_mixed_families_are_trained_and_evaluated_by_one_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    MIXED.save(tmp_path / "mixed.toml")
    train.main(["--config", "mixed.toml"])
    run = tmp_path / "runs" / "mixed"
    assert (run / "config.toml").read_text() == MIXED.to_toml()
    shown = capsys.readouterr().out
    tables = json.loads((run / "results.json").read_text())["tables"]
    assert list(tables) == ["2 to 5 robots, family 1 (cells)", "3 to 4 robots, family 2 (maze)"]
    for title, table in tables.items():
        assert f"{title}, 2 test maps" in shown
        assert table["cases"] + table["unsolved_by_expert"] == 4
    assert load(run).config == MIXED.policy
    train.main(["--config", "mixed.toml"])
    assert "holds a finished run" in " ".join(capsys.readouterr().out.split())


def test_a_run_on_the_users_own_map_shows_one_table(tmp_path, capsys):
    save_map(tmp_path / "own.map", np.zeros((6, 7), bool))
    config = replace(CONFIG, files=(str(tmp_path / "own.map"),))
    train.main(arguments_for(config, tmp_path / "run"))
    assert "your maps" in capsys.readouterr().out
    (table,) = json.loads((tmp_path / "run" / "results.json").read_text())["tables"].values()
    assert table["cases"] == config.cases_per_map


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ("--rounds 0", "rounds"),
        ("--density 0.99", "density|obstacles|room"),
        ("--num-agents 500", "agents"),
        ("--policy.encoder released --policy.fov-radius 2", "fov_radius"),
        ("--device abacus", "abacus"),
        ("--threads 5000", "threads"),
        ("--w 0.5", "w must be"),
        ("--init nowhere", "nowhere"),
        ("--init n12 --policy.taps 2", "another network than the one to train .taps: 3, not 2"),
        ("--files nowhere.map", "nowhere.map"),
    ],
)
def test_a_mistake_takes_one_line_and_leaves_no_folder(tmp_path, capsys, wrong, named):
    with pytest.raises(SystemExit) as end:
        train.main(["--run", str(tmp_path / "run"), "--threads", "1", "--train-maps", "2", *wrong.split()])
    assert end.value.code == 2
    shown = capsys.readouterr()
    assert re.fullmatch(r"error: .+\n", shown.err)
    assert re.search(named, shown.err)
    assert "Traceback" not in shown.out + shown.err
    assert not (tmp_path / "run").exists()


def test_a_folder_that_is_taken_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SystemExit) as end:
        train.main(["--run", str(tmp_path), "--train-maps", "2"])
    assert end.value.code == 2
    assert capsys.readouterr().err == (
        f"error: {tmp_path} exists and is not a training run: choose another folder with --run\n"
    )


@pytest.mark.parametrize("wrong", [["--surprise"], ["--rounds", "many"], ["--recipe", "cake"], ["--policy.taps", "0"]])
def test_unknown_options_and_values_are_refused(capsys, wrong):
    with pytest.raises(SystemExit) as end:
        train.main(wrong)
    assert end.value.code == 2
    assert wrong[0].split(".")[-1].strip("-") in capsys.readouterr().err


def test_a_finished_run_is_not_trained_over(tmp_path, capsys):
    arguments = ["--run", str(tmp_path), "--train-maps", "2", "--validation-maps", "1"]
    train.parse(arguments).config.save(tmp_path / "config.toml")
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(SystemExit) as end:
        train.main(arguments)
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path} holds a finished run")
    assert "--run" in error
    assert error.count("\n") == 1
    with pytest.raises(SystemExit):
        train.main([*arguments, "--seed", "1"])
    assert capsys.readouterr().err.startswith(f"error: {tmp_path} holds a run with other settings (seed)")


def test_an_expert_with_wrong_plans_stops_training_with_its_name_and_fault(tmp_path, monkeypatch, capsys):
    module = ModuleType("lazy")
    exec(
        "import numpy as np, experts, mapf_env\n"
        "def stay(instance):\n"
        "    return experts.Result.of(mapf_env.Solution(np.stack([instance.starts] * 3)))\n"
        "def leave(instance):\n"
        "    raise SystemExit(0)\n"
        "def guess(instance):\n"
        "    return instance.starts\n",
        module.__dict__,
    )
    monkeypatch.setitem(sys.modules, "lazy", module)
    for name in ("stay", "leave", "guess"):
        with pytest.raises(SystemExit) as end:
            train.main(arguments_for(replace(CONFIG, expert=f"lazy:{name}"), tmp_path / name))
        assert end.value.code == 2
        told = capsys.readouterr().err
        assert told.startswith("error: ")
        assert told.count("\n") == 1
        assert name == "leave" or "stay" in told or "guess" in told
        assert not (tmp_path / name / "best.safetensors").exists()


def test_a_run_killed_in_its_final_evaluation_is_finished_by_the_same_command(tmp_path, monkeypatch, capsys):
    folder, arguments = tmp_path / "run", arguments_for(CONFIG, tmp_path / "run")
    written = []

    def watched(path, *given, **options):
        with pytest.raises(FileExistsError, match="another process is training"):
            lock_in_another_process(folder)
        written.append(path.name)
        if len(written) == 1:
            raise KeyboardInterrupt
        return write_whole(path, *given, **options)

    write_whole = results_json.write_whole
    monkeypatch.setattr(results_json, "write_whole", watched)
    with pytest.raises(SystemExit) as end:
        train.main(arguments)
    assert end.value.code == 130
    assert not (folder / "results.json").exists()
    state = (folder / "state.pt").read_bytes()
    capsys.readouterr()
    for attempt in ("finishes", "shows again"):
        train.main(arguments)
        shown = capsys.readouterr().out
        assert "3 robots, 2 test maps" in shown, attempt
        assert "expert*" in shown
        assert (folder / "state.pt").read_bytes() == state
    assert written == ["results.json", "results.json"]
    assert "holds a finished run" in " ".join(shown.split())
    with pytest.raises(SystemExit) as end:
        train.main(arguments_for(replace(CONFIG, seed=1), folder))
    assert end.value.code == 2


def lock_in_another_process(folder):
    """Raise what another process meets that wants to train in the folder."""
    program = "import sys, pathlib; from gnn_policy.run_folder import lock_run; lock_run(pathlib.Path(sys.argv[1]))"
    done = subprocess.run([sys.executable, "-c", program, str(folder)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise FileExistsError(done.stderr)
