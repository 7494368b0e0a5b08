import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import experts
from experts.command import main
from mapf_env import Instance, Solution, load_scen, random_instance, save_instances, save_map, save_scen


@pytest.fixture
def scen(tmp_path: Path) -> Path:
    instance = random_instance(height=8, width=8, num_agents=6, seed=1)
    save_map(tmp_path / "small.map", instance.grid)
    save_scen(tmp_path / "small.scen", instance, tmp_path / "small.map")
    return tmp_path / "small.scen"


@pytest.mark.parametrize("solver", ["ecbs", "lacam", "prioritised", "pibt"])
def test_solve_then_check(scen: Path, solver: str, capsys: pytest.CaptureFixture[str]) -> None:
    paths, picture = scen.with_name("paths.txt"), scen.with_name("plan.svg")
    assert main(["solve", str(scen), "--solver", solver, "--paths", str(paths), "--animation", str(picture)]) == 0
    printed = dict(
        line.split(maxsplit=1) for line in capsys.readouterr().out.replace("lower bound", "bound").split("\n")[:-1]
    )
    assert printed["status"] == "solved"
    assert int(printed["cost"]) == experts.load_paths(paths).sum_of_costs >= int(printed["bound"])
    assert picture.read_text().startswith("<svg")
    assert main(["check", str(paths), "--scen", str(scen)]) == 0
    assert capsys.readouterr().out.startswith("valid: 6 robots")


def test_w_is_that_of_the_solver(scen: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for solver in ("ecbs", "lacam"):
        for given in ([], ["--w", "1.1"]):
            assert main(["solve", str(scen), "--solver", solver, *given]) == 0
    costs = [line.split()[1] for line in capsys.readouterr().out.splitlines() if line.startswith("cost")]
    instance = load_scen(scen)
    alone = [
        experts.solve(instance),
        experts.solve(instance, w=1.1),
        experts.lacam(instance),
        experts.lacam(instance, w=1.1),
    ]
    assert costs == [str(each.cost) for each in alone]
    assert costs[2] != costs[3]


def test_some_robots_of_a_scenario_and_random_ones_on_a_map(scen: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", str(scen), "--agents", "2", "--w", "1"]) == 0
    paths = scen.with_name("paths.txt")
    random = [str(scen.with_suffix(".map")), "--agents", "4", "--seed", "3"]
    assert main(["solve", *random, "--paths", str(paths)]) == 0
    assert main(["check", str(paths), "--scen", random[0], "--seed", "3"]) == 0
    assert main(["check", str(paths), "--scen", random[0], "--seed", "4"]) == 1
    assert "starts at" in capsys.readouterr().out


def test_an_instance_of_a_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    instances = [random_instance(height=8, width=8, num_agents=5, seed=seed) for seed in range(3)]
    several, paths = str(tmp_path / "several.json"), str(tmp_path / "paths.txt")
    save_instances(several, instances)
    for index, given in enumerate([[], ["--index", "1"], ["--index", "2"]]):
        assert main(["solve", several, *given, "--w", "1", "--paths", paths]) == 0
        assert experts.load_paths(paths).violations(instances[index]) == []
        assert main(["check", paths, "--scen", several, *given]) == 0
    assert main(["check", paths, "--scen", several]) == 1
    assert main(["solve", several, "--index", "1", "--agents", "3", "--paths", paths]) == 0
    first = Instance(instances[1].grid, instances[1].starts[:3], instances[1].goals[:3])
    assert experts.load_paths(paths).violations(first) == []
    capsys.readouterr()
    for given, message in [
        (["--index", "3"], "holds 3 instances, counted from 0: there is no --index 3"),
        (["--index", "-1"], "there is no --index -1"),
        (["--agents", "6"], "6 agents asked for, but instance 0"),
        (["--agents", "0"], "give --agents in 1..5"),
        (["--map", "x.map"], "--map goes with a scenario only"),
    ]:
        assert main(["solve", several, *given]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1


def test_an_invalid_plan_is_named(scen: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = scen.with_name("paths.txt")
    main(["solve", str(scen), "--paths", str(paths)])
    lines = paths.read_text().splitlines()
    lines[1] = "Agent 1: (0,0)->(5,5)->"
    paths.write_text("\n".join(lines))
    capsys.readouterr()
    assert main(["check", str(paths), "--scen", str(scen)]) == 1
    assert "agent 1 jumps in step 0" in capsys.readouterr().out


def test_no_plan_is_status_1(scen: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corridor = Instance(np.zeros((1, 4), bool), [(0, 0), (0, 3)], [(0, 3), (0, 0)])
    save_map(scen.with_name("corridor.map"), corridor.grid)
    save_scen(scen, corridor, scen.with_name("corridor.map"))
    assert main(["solve", str(scen)]) == 1
    assert "infeasible" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (["solve", "nowhere.scen"], "nowhere.scen"),
        (["solve", "{scen}", "--w", "0.5"], "w must be a finite number"),
        (["solve", "{scen}", "--solver", "lacam", "--w", "0.5"], "w must be a finite number"),
        (["solve", "{scen}", "--solver", "pibt", "--w", "1"], "the solver 'pibt' has no w"),
        (["solve", "{scen}", "--agents", "99"], "99 agents asked for"),
        (["solve", "{map}"], "give --agents N"),
        (["solve", "{scen}", "--index", "1"], "--index goes with a set of instances"),
        (["solve", "{map}", "--map", "{map}", "--agents", "2"], "--map goes with a scenario only"),
        (["check", "{scen}", "--scen", "{scen}"], "line 1: expected 'Agent 0:"),
    ],
)
def test_errors_are_one_line(scen: Path, line: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([part.format(scen=scen, map=scen.with_suffix(".map")) for part in line]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("line", [[], ["solve"], ["solve", "x.scen", "--solver", "best"], ["dance"]])
def test_bad_options_are_one_line(line: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(line)
    assert capsys.readouterr().err.count("\n") == 1


def test_it_is_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "experts", "--help"], capture_output=True, text=True, check=True)
    assert "solve" in done.stdout
    assert "check" in done.stdout


def test_path_files_round_trip(tmp_path: Path) -> None:
    plan = experts.solve(random_instance(num_agents=12, seed=0)).solution
    assert plan is not None
    experts.save_paths(tmp_path / "paths.txt", plan)
    np.testing.assert_array_equal(experts.load_paths(tmp_path / "paths.txt").paths, plan.paths)
    experts.save_paths(tmp_path / "paths.txt", Solution(np.array([[[3, 4]]])))
    assert (tmp_path / "paths.txt").read_text() == "Agent 0: (3,4)->\n"


@pytest.mark.parametrize("text", ["", "Agent 1: (0,0)->", "Agent 0: (0,0)->(1", "Agent 0: (a,b)", "Agent 0:"])
def test_damaged_path_files(tmp_path: Path, text: str) -> None:
    (tmp_path / "paths.txt").write_text(text)
    with pytest.raises(ValueError, match=r"paths\.txt"):
        experts.load_paths(tmp_path / "paths.txt")
