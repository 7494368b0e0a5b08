"""The command that runs a policy on your own map and writes a page."""

import json
import re
import sys
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

import pytest
import torch

import oracles
from gnn_policy import DecentralizedPolicy, Execution, PolicyConfig, play, rollout, save
from mapf_env import load_scen, parse_map, random_instance, save_instances, save_map, save_scen

LIFELONG = ["--task", "lifelong", "--execution", "argmax", "--max-steps", "9"]


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A working folder with a map, a scenario and an untrained policy."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    instance = random_instance(height=9, width=12, density=0.2, num_agents=6, seed=3)
    save_map("own.map", instance.grid)
    save_scen("own.scen", instance, "own.map")
    (tmp_path / "elsewhere").mkdir()
    save_scen("elsewhere/far.scen", instance, "own.map")
    torch.manual_seed(0)
    config = PolicyConfig(encoder="lean", features=8, fov_radius=2, comm_radius=3.0)
    save(DecentralizedPolicy(config, Execution(actions="stuck")), "policy.safetensors")
    return tmp_path


def played(*arguments):
    return play.main([*arguments, "--policy", "policy.safetensors", "--threads", "1"])


def shown(path):
    """The data in a page of replays."""
    return json.loads(re.findall(r"^const data = (.*);$", path.read_text(encoding="utf-8"), re.MULTILINE)[0])


def test_a_scenario_is_played_as_it_stands(home, capsys):
    played("own.scen", "--max-steps", "30")
    data, instance = shown(home / "own.html"), load_scen("own.scen")
    (scene,) = data["scenes"]
    (panel,) = scene["panels"]
    assert scene["goals"] == instance.goals.tolist()
    paths = oracles.track_of_a_replay(panel["paths"])
    assert paths[0] == instance.starts.tolist()
    assert len(paths) == 31
    assert (data["fov_radius"], scene["comm_radius"]) == (2, 3.0)
    for before, after in pairwise(paths):
        assert not oracles.faults(instance.grid, oracles.cells(before), oracles.cells(after))
    home_now = sum(cell == goal for cell, goal in zip(paths[-1], scene["goals"], strict=True))
    told = capsys.readouterr().out
    assert f"6 robots on 9 x 12 cells: {home_now} on goal after 30 steps, failed: " in told
    assert data["title"] in told
    assert "replay: own.html" in told


def test_an_instance_of_a_set_is_played(home):
    instances = [random_instance(height=5, width=5, num_agents=3, seed=seed) for seed in range(2)]
    save_instances("set.json", instances)
    played("set.json", "--index", "1", "--max-steps", "3")
    (scene,) = shown(home / "set.html")["scenes"]
    assert scene["goals"] == instances[1].goals.tolist()


def test_robots_are_placed_on_a_map_by_the_seed(home):
    pages = {}
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        played("own.map", "--agents", "4", "--seed", seed, "--max-steps", "5", "--out", f"{name}.html")
        pages[name] = shown(home / f"{name}.html")
    assert pages["a"] == pages["b"] != pages["c"]
    assert len(pages["a"]["scenes"][0]["goals"]) == 4


def test_every_option_reaches_the_rollout(home, monkeypatch):
    asked = []
    monkeypatch.setattr(
        sys.modules["gnn_policy.rollout"], "rollout", lambda *given, **how: asked.append(how) or rollout(*given, **how)
    )
    for options in ([], ["--execution", "argmax"], ["--execution", "sampled,0.5,pibt", "--max-steps", "7"], LIFELONG):
        played("own.scen", "--seed", "3", *options)
    instance = load_scen("own.scen")
    longest = max(
        oracles.distances(instance.grid, goal)[start]
        for start, goal in zip(oracles.cells(instance.starts), oracles.cells(instance.goals), strict=True)
    )
    rows = [
        Execution(actions="stuck"),
        Execution(),
        Execution(actions="sampled", temperature=0.5, shield="pibt"),
        Execution(),
    ]
    limits, tasks = [4 * longest, 4 * longest, 7, 9], ["one_shot"] * 3 + ["lifelong"]
    assert asked == [
        {"task": task, "seed": 3, "max_steps": [limit], "execution": row}
        for task, row, limit in zip(tasks, rows, limits, strict=True)
    ]


def test_a_policy_has_the_execution_of_its_file(home, monkeypatch):
    asked = []
    monkeypatch.setattr(
        sys.modules["gnn_policy.rollout"],
        "rollout",
        lambda *given, **how: asked.append(how["execution"]) or rollout(*given, **how),
    )
    for policy in ("n12-informed", "n12"):
        play.main(["own.scen", "--policy", policy, "--threads", "1"])
    assert asked == [Execution(actions="stuck", shield="pibt"), Execution(actions="stuck")]
    play.main(["own.scen", "--policy", "n12-informed", "--execution", "argmax", "--threads", "1"])
    assert asked[-1] == Execution(shield="pibt"), "an execution keeps the shield of the file unless it names one"


def test_a_lifelong_team_plays_to_the_last_step_and_its_arrivals_are_reported(home, capsys):
    instance = load_scen("own.scen")
    save_scen("rest.scen", instance.at(instance.goals), "own.map")
    played("rest.scen", "--task", "lifelong", "--max-steps", "25")
    (scene,) = shown(home / "rest.html")["scenes"]
    (panel,) = scene["panels"]
    paths = oracles.track_of_a_replay(panel["paths"])
    assert len(paths) == 26
    for before, after in pairwise(paths):
        assert not oracles.faults(instance.grid, oracles.cells(before), oracles.cells(after))
    told = capsys.readouterr().out
    assert "arrivals" in told
    assert "failed" not in told


def test_a_scenario_elsewhere_takes_the_first_robots_and_a_map(home):
    played("elsewhere/far.scen", "--map", "own.map", "--agents", "2", "--max-steps", "3")
    assert shown(home / "far.html")["scenes"][0]["goals"] == load_scen("own.scen", 2).goals.tolist()


def test_a_team_that_starts_on_its_goals_has_solved_the_case(home, capsys):
    instance = load_scen("own.scen")
    save_scen("rest.scen", instance.at(instance.goals), "own.map")
    played("rest.scen")
    assert "6 on goal after 0 steps, flowtime 0" in capsys.readouterr().out


def test_a_drawing_is_played_with_its_own_robots_or_with_random_ones(home):
    Path("own.txt").write_text("A..a\n.##.\nb..B\n")
    played("own.txt", "--max-steps", "3", "--out", "drawn.html")
    (scene,) = shown(home / "drawn.html")["scenes"]
    assert scene["goals"] == [[0, 3], [2, 0]]
    assert scene["panels"][0]["paths"]["starts"] == [[0, 0], [2, 3]]
    played("own.txt", "--agents", "1", "--max-steps", "3", "--out", "first.html")
    assert shown(home / "first.html")["scenes"][0]["goals"] == [[0, 3]]
    Path("plain.txt").write_text("....\n.##.\n....\n")
    played("plain.txt", "--agents", "3", "--seed", "5", "--max-steps", "3")
    expected = random_instance(grid=parse_map("....\n.##.\n...."), num_agents=3, seed=5)
    assert shown(home / "plain.html")["scenes"][0]["goals"] == expected.goals.tolist()


@pytest.mark.parametrize(
    ("drawing", "words"), [("..\n.", "line 2 has 1 cells"), ("Aa\nb.", "goal b"), ("..", "--agents N")]
)
def test_a_drawing_that_cannot_be_played_is_refused(home, capsys, drawing, words):
    Path("bad.txt").write_text(drawing)
    with pytest.raises(SystemExit) as end:
        played("bad.txt")
    assert end.value.code == 2
    assert words in capsys.readouterr().err


def test_the_exit_status_tells_success(home):
    instance = load_scen("own.scen")
    save_scen("rest.scen", instance.at(instance.goals), "own.map")
    assert played("rest.scen") == 0
    assert played("own.scen", "--max-steps", "1") == 1
    assert played("own.scen", "--max-steps", "1", "--task", "lifelong") == 0


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("own.map", "give --agents N"),
        ("own.map --agents 0", "num_agents must be at least 1"),
        ("own.map --agents 999", "999"),
        ("own.scen --agents 7", "only 6 entries"),
        ("own.map --agents 3 --map own.map", "--map goes with a scenario only"),
        ("own.map --agents 3 --index 0", "--index goes with a set of instances"),
        ("own.map --agents 3 --seed -1", "seed"),
        ("own.map --agents 3 --max-steps 0", "max_steps must be at least 1"),
        ("own.map --agents 3 --threads -1", "threads"),
        ("own.map --agents 3 --device abacus", "abacus"),
        ("own.scen --map elsewhere", "elsewhere"),
        ("own.map --agents 3 --execution best", "unknown word 'best'"),
        ("own.map --agents 3 --out none/page.html", "none/page.html cannot be written: make the folder"),
        ("own.map --agents 3 --out elsewhere", "elsewhere is a folder"),
        ("own.map --agents 3 --out own.map", "own.map would overwrite the input own.map"),
        ("elsewhere/far.scen --map own.map --out own.map", "own.map would overwrite the input own.map"),
        ("none.map --agents 3", "none.map"),
        ("none.scen", "none.scen"),
        ("elsewhere --agents 3 --map own.map", "go with one file"),
        ("policy.safetensors --agents 3", "must be a map"),
        ("own.scen --policy none", "none"),
    ],
)
def test_a_mistake_takes_one_line(home, capsys, wrong, words):
    with pytest.raises(SystemExit) as end:
        play.main(["--policy", "policy.safetensors", *wrong.split()])
    assert end.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ")
    assert told.count("\n") == 1
    assert words in told
    assert not list(home.glob("*.html"))


def test_the_help_names_every_option(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        play.main(["--help"])
    text = capsys.readouterr().out
    for each in fields(play.Command):
        assert (f"--{each.name.replace('_', '-')}" if each.name != "file" else "FILE") in text, each.name


def test_a_page_without_a_name_replaces_no_file(home, capsys):
    (home / "own.html").write_text("mine")
    (home / "own-2.html").symlink_to("nowhere")
    for name in ("own-3.html", "own-4.html"):
        played("own.scen", "--max-steps", "3")
        assert f"replay: {name}" in capsys.readouterr().out
        assert shown(home / name)
    assert (home / "own.html").read_text() == "mine"
    played("own.scen", "--max-steps", "3", "--out", "own.html")
    assert shown(home / "own.html")


def test_the_files_of_a_folder_are_scenes_of_one_page(home, capsys):
    instances = [random_instance(height=5, width=5, num_agents=3, seed=seed) for seed in range(2)]
    save_instances("elsewhere/set.json", instances)
    save_map("elsewhere/own.map", load_scen("own.scen").grid)
    save_scen("elsewhere/far.scen", load_scen("own.scen"), "elsewhere/own.map")
    played("elsewhere", "--max-steps", "5")
    data, told = shown(home / "elsewhere.html"), capsys.readouterr().out
    assert [scene["title"].partition(":")[0] for scene in data["scenes"]] == ["far.scen", "set.json"]
    assert data["scenes"][1]["goals"] == instances[0].goals.tolist()
    assert "far.scen: 6 robots on 9 x 12 cells: " in told
    assert "set.json: 3 robots on 5 x 5 cells: " in told

    played("elsewhere", "--agents", "2", "--max-steps", "5", "--out", "maps.html")
    assert len(shown(home / "maps.html")["scenes"]) == 3  # and the map


def test_a_folder_without_instances_is_refused_in_one_line(home, capsys):
    (home / "maps").mkdir()
    save_map("maps/own.map", load_scen("own.scen").grid)
    for options, message in ((["maps"], "for maps give --agents"), (["maps", "--index", "0"], "go with one file")):
        with pytest.raises(SystemExit) as end:
            played(*options)
        assert end.value.code == 2
        assert message in capsys.readouterr().err
