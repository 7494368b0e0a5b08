"""POGEMA's benchmark is read, played and shown by its own rules; the folders here are made up."""

import csv
import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import pogema
import pogema_cases
import pogema_methods
from gnn_policy import Execution, Rollouts, load, rollout, save
from mapf_env import Instance, parse_map, parse_pogema_map
from pogema import Options

COMMAND = Path(pogema.__file__)
CONFIG = """environment:
  on_target: nothing
  max_episode_steps: {steps}
  seed: {seeds}
  num_agents:
    grid_search: [2,
      3]
  map_name:
    grid_search:
      [
        hall,
        corridor,
      ]

algorithms:
  Other:
    num_agents: 99
"""
MAPS = """hall: |-
  ......
  .#..#.
  ......
"corridor": |-
  .......
  ###.###
"""
PUBLISHED = (
    "set,source,method,robots,instances,CSR,ISR,SoC,makespan,throughput\n"
    "01-tiny,a page,Other [/b],2,8,0.5,0.75,12.5,7.25,\n"
    "01-tiny,a book,Third,3,8,1.0,1.0,,,1.5\n"
    "02-else,a page,Fourth,2,8,1.0,1.0,3,4,\n"
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A benchmark of one set: two maps, two seeds."""
    made = tmp_path / "benchmark"
    (made / "01-tiny").mkdir(parents=True)
    (made / "01-tiny" / "01-tiny.yaml").write_text(CONFIG.format(steps=20, seeds="\n    grid_search: [0, 5]"))
    (made / "01-tiny" / "maps.yaml").write_text(MAPS)
    (made / "published.csv").write_text(PUBLISHED)
    return made


def only_set(folder: Path) -> pogema_cases.BenchmarkSet:
    (found,) = pogema_cases.load_sets(folder, ())
    return found


def store_instances(folder: Path, num_agents: int, **changes: Any) -> None:
    """Write the instances that the configuration makes, with changes."""
    cases = only_set(folder).cases(num_agents)
    grids = np.ones((len(cases), 3, 7), np.bool_)
    for place, case in enumerate(cases):
        height, width = case.instance.grid.shape
        grids[place, :height, :width] = case.instance.grid
    columns = {
        "map": np.array([case.map_name for case in cases]),
        "seed": np.array([case.seed for case in cases]),
        "shape": np.array([case.instance.grid.shape for case in cases]),
        "grids": grids,
        "starts": np.array([case.instance.starts for case in cases]),
        "goals": np.array([case.instance.goals for case in cases]),
    }
    np.savez(
        folder / "01-tiny" / "instances.npz",
        **{f"N{num_agents}_{key}": each for key, each in (columns | changes).items()},
    )


def run(folder: Path, out: Path, **options: Any) -> str:
    console = Console(width=100, record=True, markup=False, file=io.StringIO())
    chosen = Options(folder, out=out, **{"methods": ("pibt", "lacam,0.1"), **options})
    cells = pogema.plan(chosen)
    pogema.play(cells, chosen.seed, console)
    published = pogema_cases.load_published(folder / "published.csv")
    task = "lifelong" if chosen.lifelong else "mapf"
    pogema.show([pogema.score(cell) for cell in cells], published, out / task, console)
    return console.export_text()


def test_a_set_follows_its_configuration(folder: Path) -> None:
    group = only_set(folder)
    assert (group.name, group.max_steps, group.sizes, group.seeds) == ("01-tiny", 20, (2, 3), (0, 5))
    assert group.map_names == ("hall", "corridor")
    cases = group.cases(2)
    assert [(case.map_name, case.seed) for case in cases] == [
        ("hall", 0),
        ("hall", 5),
        ("corridor", 0),
        ("corridor", 5),
    ]
    assert cases[3].instance == group.maps["corridor"].instance(2, 5)


def test_instances_are_checked_against_those_of_the_folder(folder: Path) -> None:
    store_instances(folder, 2)
    assert len(only_set(folder).cases(2)) == len(only_set(folder).cases(3)) == 4, "3 robots are not in the file"
    goals = np.array([case.instance.goals for case in only_set(folder).cases(2)])
    goals[2] = goals[2, ::-1]
    for changes, message in (
        ({"goals": goals}, "has another goal for map corridor, seed 0 and 2 robots"),
        ({"seed": np.array([0, 6, 0, 5])}, "has another seed for map hall, seed 5"),
        ({"seed": np.array([0])}, "has other cases of 2 robots than the configuration"),
    ):
        (folder / "01-tiny" / "instances.npz").unlink()
        store_instances(folder, 2, **changes)
        with pytest.raises(ValueError, match=message):
            only_set(folder).cases(2)
    for damage in (b"", b"PK\x03\x04", b"\x80\x04\x95."):
        (folder / "01-tiny" / "instances.npz").write_bytes(damage)
        with pytest.raises(ValueError, match=r"instances\.npz is damaged or of another kind"):
            only_set(folder).cases(2)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ("", "has no block 'environment:'"),
        (CONFIG.replace("nothing", "restart"), "on_target must be 'nothing'"),
        (CONFIG.replace("corridor,", "cave,"), "names the map 'cave'"),
        (CONFIG.replace("{steps}", "many"), "max_episode_steps must be whole numbers from 1, got 'many'"),
        (CONFIG.replace("{seeds}", "-1"), "seed must be whole numbers from 0, got '-1'"),
        (CONFIG.replace("{seeds}", "[]"), "expected 'seed: VALUE' or 'seed:' with 'grid_search:"),
        (CONFIG.replace("  num_agents:\n", "  agents:\n"), "expected 'num_agents: VALUE'"),
        (CONFIG.replace("[2,", "[99999999999,"), "num_agents must be whole numbers from 1, got '99999999999'"),
    ],
)
def test_configurations_of_another_kind_are_refused(folder: Path, config: str, message: str) -> None:
    path = folder / "01-tiny" / "01-tiny.yaml"
    path.write_text(config.replace("{steps}", "20").replace("{seeds}", "0"))
    with pytest.raises(ValueError, match=message) as refusal:
        only_set(folder)
    assert str(path) in str(refusal.value)


def test_published_rows_are_read_and_damaged_ones_are_refused_with_their_line(folder: Path) -> None:
    rows = pogema_cases.load_published(folder / "published.csv")
    assert [(row.method, row.num_agents) for row in rows] == [("Other [/b]", 2), ("Third", 3), ("Fourth", 2)]
    assert rows[0].results == {"CSR": 0.5, "ISR": 0.75, "SoC": 12.5, "makespan": 7.25}
    assert rows[1].results == {"CSR": 1.0, "ISR": 1.0, "throughput": 1.5}
    assert pogema_cases.load_published(folder / "none.csv") == []
    for wrong in (
        PUBLISHED + "01-tiny,a,b,many,8,1,1,1,1\n",
        PUBLISHED + "01-tiny,a,b,2,8,x\n",
        PUBLISHED + "01-tiny\n",
    ):
        (folder / "published.csv").write_text(wrong)
        with pytest.raises(ValueError, match=r"published\.csv, line 5: expected set, source"):
            pogema_cases.load_published(folder / "published.csv")
    (folder / "published.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"published\.csv, line 2: expected set, source"):
        pogema_cases.load_published(folder / "published.csv")


def test_published_lifelong_results_come_with_the_benchmark() -> None:
    rows = pogema_cases.load_published(pogema.LIFELONG_RESULTS)
    assert {row.method for row in rows} == {"Follower", "MATS-LP", "RHCR"}
    assert all(set(row.results) == {"throughput"} for row in rows)
    assert [row.results["throughput"] for row in rows if (row.set_name, row.method) == ("02-mazes", "RHCR")] == [
        1.7,
        2.59,
    ]


def test_a_cell_is_played_once_and_the_tables_show_it_next_to_published_results(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shown = run(folder, out)
    files = {path: path.read_text() for path in out.glob("*/*/*/*.json")}
    assert sorted(str(path.relative_to(out)) for path in files) == [
        f"mapf/01-tiny/N{size}/{method}.json" for size in (2, 3) for method in ("lacam,0.1", "pibt")
    ]
    for path, text in files.items():
        stored = json.loads(text)
        assert len(stored["success"]) == stored["settings"]["cases"] == 4
        assert stored["settings"]["method"] == path.stem
    assert "01-tiny, 4 cases: success (CSR)" in shown
    assert "Other [/b] [1]" in shown
    assert "[1] a page; [2] a book" in shown
    assert "Fourth" not in shown, "another set"
    page = (out / "mapf" / "results.md").read_text()
    assert "| Other [/b] [1] | 12 |  |" in page, "its SoC"
    lacam = json.loads(files[out / "mapf/01-tiny/N2/lacam,0.1.json"])
    assert f"| lacam,0.1 | {np.mean(lacam['success']):.3f} [" in page
    assert (out / "mapf" / "01-tiny.png").read_bytes().startswith(b"\x89PNG")
    run(folder, out)
    assert all(path.read_text() == text for path, text in files.items()), "nothing is played again"


def test_results_of_other_settings_and_damaged_ones_are_refused(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(folder, out, methods=("pibt",), sizes=(2,))
    for changed, words in (({"cases": 2}, "cases, instances"), ({"seed": 1}, "seed")):
        with pytest.raises(FileExistsError, match=rf"pibt\.json has results of other settings \({words}\)"):
            run(folder, out, methods=("pibt",), **changed)
    (folder / "01-tiny" / "maps.yaml").write_text(MAPS.replace(".#..#.", "......"))
    with pytest.raises(FileExistsError, match=r"other settings \(instances\)"):
        run(folder, out, methods=("pibt",), sizes=(2,))
    (folder / "01-tiny" / "maps.yaml").write_text(MAPS)
    file = out / "mapf" / "01-tiny" / "N2" / "pibt.json"
    stored = json.loads(file.read_text())
    for damage in ({"home": [1.0]}, {"seconds": None}, {"flowtime": ["x"] * 4}):
        file.write_text(json.dumps(stored | damage))
        with pytest.raises(ValueError, match=r"pibt\.json is damaged .*: delete it"):
            run(folder, out, methods=("pibt",), sizes=(2,))


def test_fewer_cases_are_spread_over_all(folder: Path, tmp_path: Path) -> None:
    cells = pogema.plan(Options(folder, methods=("pibt",), sizes=(2,), cases=2, out=tmp_path))
    assert [(case.map_name, case.seed) for cell in cells for case in cell.cases] == [("hall", 0), ("corridor", 0)]
    (cell,) = pogema.plan(Options(folder, methods=("pibt",), sizes=(2,), cases=9, out=tmp_path))
    assert len(cell.cases) == 4


def test_a_policy_is_identified_by_its_weights_and_played_as_by_rollout(folder: Path, tmp_path: Path) -> None:
    weights = tmp_path / "own, mine.safetensors"
    save(load("n4"), weights)
    by_file, by_name = (pogema_methods.method_named(each) for each in (str(weights), "n4,stuck"))
    assert by_file.name == "own, mine stuck,1"
    assert by_name.name == "n4 stuck,1"
    assert by_file.settings == by_name.settings
    assert pogema_methods.method_named("n12-informed,argmax").name == "n12-informed argmax,pibt", "trained under PIBT"
    instances = [case.instance for case in only_set(folder).cases(2)][:2]
    played = by_name.play(instances, 20, 3)
    expected = rollout(load("n4"), instances, execution=Execution(actions="stuck"), seed=3, max_steps=20)
    assert played.success.tolist() == expected.success.tolist()
    assert played.flowtime.tolist() == expected.flowtime.tolist()


def test_pibt_agrees_with_the_planner_and_counts_robots_on_goals_if_it_fails() -> None:
    grid = parse_map("......\n.#..#.\n......")
    easy = Instance(grid, [(0, 0), (2, 5)], [(2, 5), (0, 0)])
    swap = Instance(parse_map("....."), [(0, 0), (0, 1), (0, 4)], [(0, 1), (0, 0), (0, 4)])
    played = pogema_methods.method_named("pibt").play([easy, swap], 30, 0)
    assert played.success.tolist() == [True, False]
    assert played.makespan.tolist() == [played.steps[0], 30]
    assert played.steps[0] < 12
    assert 0 < played.home[1] < 1
    assert played.flowtime[1] >= 60


def test_plans_are_scored_like_rollouts() -> None:
    """Plans and rollouts with the same paths have the same outcomes."""
    grid = parse_map("....\n....")
    instances = [Instance(grid, [(0, 0), (1, 3)], [(0, 3), (1, 0)]), Instance(grid, [(0, 0), (0, 1)], [(0, 1), (0, 0)])]
    for max_steps in (1, 2, 3, 30):
        played: Rollouts = rollout(
            load("n4"), instances, execution=Execution(actions="sampled"), seed=5, max_steps=max_steps
        )
        outcomes = pogema_methods.outcomes_of(instances, [each.paths for each in played.solutions], max_steps)
        assert outcomes.success.tolist() == played.success.tolist()
        assert outcomes.flowtime.tolist() == played.flowtime.tolist()
        assert outcomes.makespan.tolist() == played.makespan.tolist()
    there_and_back = np.array([[(0, 0)], [(0, 1)], [(0, 2)], [(0, 1)], [(0, 1)]])
    alone = Instance(parse_map("..."), [(0, 0)], [(0, 1)])
    for max_steps, flowtime, success in ((1, 1, True), (2, 2, False), (3, 3, True), (9, 3, True)):
        outcomes = pogema_methods.outcomes_of([alone], [there_and_back], max_steps)
        assert (outcomes.flowtime.tolist(), outcomes.success.tolist()) == ([flowtime], [success])


def test_lifelong_play_counts_arrivals_at_the_goals_that_pogema_draws(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shown = run(folder, out, lifelong=True, methods=("pibt", "n4,argmax"), sizes=(2, 3), cases=2)
    assert "01-tiny, 2 cases: throughput" in shown
    assert "Third [1]" in shown
    assert "success" not in shown
    stored = json.loads((out / "lifelong" / "01-tiny" / "N2" / "pibt.json").read_text())
    assert stored["settings"]["max_steps"] == 256
    assert len(stored["arrivals"]) == 2
    assert f"| pibt | {np.mean(stored['arrivals']) / 256:.2f} [" in (out / "lifelong" / "results.md").read_text()


def test_a_robot_alone_goes_from_goal_to_goal_without_a_detour() -> None:
    """The arrivals are those that the distances between the drawn goals allow."""
    hall = parse_pogema_map("\n".join(["......"] * 5))
    for seed in range(5):
        instance, goals = hall.instance(1, seed), hall.goal_sequences(1, seed, 40)
        for name in ("pibt", "greedy"):
            method = pogema_methods.method_named(name)
            assert method.serve is not None
            stops = np.concatenate([instance.starts, instance.goals, goals[0]])
            times = np.abs(np.diff(stops, axis=0)).sum(axis=1).cumsum()
            assert method.serve([instance], [goals], 60, 0) == [(times <= 60).sum()]


@pytest.mark.parametrize("name", ["pibt", "pibt_swap", "rolling,20", "n12-informed"])
def test_teams_that_are_served_together_arrive_as_often_as_alone(name: str) -> None:
    halls = [parse_pogema_map("\n".join(["." * width] * 5)) for width in (4, 7, 5)]
    instances = [hall.instance(3, seed) for seed, hall in enumerate(halls)]
    goals = [hall.goal_sequences(3, seed, 40) for seed, hall in enumerate(halls)]
    method = pogema_methods.method_named(name)
    assert method.serve is not None
    together = method.serve(instances, goals, 40, 0)
    assert together == [method.serve([each], [own], 40, 0)[0] for each, own in zip(instances, goals, strict=True)]
    assert min(together) > 10


def test_rollouts_do_not_depend_on_the_other_cases(folder: Path) -> None:
    instances = [case.instance for case in only_set(folder).cases(3)]
    for name in ("pibt", "greedy", "n4,sampled"):
        play = pogema_methods.method_named(name).play
        together = play(instances, 20, 1).flowtime.tolist()
        assert together == [play([each], 20, 1).flowtime.tolist()[0] for each in instances], name
        assert play(instances, 20, 2).flowtime.tolist() != together, f"{name}: another seed"


def test_lacam_fails_where_it_has_no_plan_or_one_that_is_too_long() -> None:
    blocked = Instance(parse_map("..."), [(0, 0), (0, 1)], [(0, 1), (0, 0)])
    far = Instance(parse_map("......"), [(0, 0)], [(0, 5)])
    played = pogema_methods.method_named("lacam,0.2").play([blocked, far], 4, 0)
    assert played.success.tolist() == [False, False]
    assert played.flowtime.tolist() == [8, 4]
    assert played.home.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--methods", "pibt,fast"], "pibt has no options, got 'pibt,fast'"),
        (["--methods", "lacam,soon"], "the option of lacam is a number of seconds"),
        (["--methods", "lacam,-1"], "lacam needs a positive number of seconds"),
        (["--methods", "n13"], "there is no checkpoint n13"),
        (["--methods", "n4,quick"], "unknown word 'quick' in the execution 'quick'"),
        (["--methods", "n4", "n4,stuck"], "--methods has 'n4 stuck,1' twice"),
        (["--methods", "pibt", "--sets", "09-none"], "has no set '09-none': choose among 01-tiny"),
        (["--methods", "pibt", "--sizes", "0"], "--sizes must be at least 1, got 0"),
        (["--methods", "pibt", "--sizes", "50"], "01-tiny, map hall, seed 0: POGEMA places at most 8 robots"),
        (["--methods", "lacam", "--lifelong"], "lacam plans to the end of an instance, and lifelong play has none"),
        (["--methods", "pibt", "--cases", "0"], "--cases must be at least 1, got 0"),
        (
            ["--methods", "pibt", "--published", "Nobody"],
            "nobody has published a method 'Nobody': choose among Follower, Fourth",
        ),
    ],
)
def test_mistakes_take_one_line(folder: Path, tmp_path: Path, options: list[str], message: str) -> None:
    command = [sys.executable, COMMAND, folder, "--out", tmp_path / "out", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_the_command_plays_and_shows(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, COMMAND, folder, "--out", tmp_path / "out", "--methods", "pibt", "greedy"]
    done = subprocess.run(
        [*command, "--sizes", "2", "--published", "Other [/b]"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "Other [/b] [1]" in done.stdout
    assert "greedy" in done.stdout
    with (folder / "published.csv").open() as file:
        assert len(list(csv.reader(file))) == 4
