import subprocess
import sys
import tracemalloc
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


def test_a_plan_without_a_proof_is_printed_and_written_with_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem, paths, picture = (str(tmp_path / name) for name in ("crowd.json", "paths.txt", "plan.svg"))
    crowd = random_instance(num_agents=30, density=0.3, seed=0)
    save_instances(problem, [crowd])
    limited = ["--w", "1.01", "--node-limit", "50", "--paths", paths, "--animation", picture]
    assert main(["solve", problem, *limited]) == 1
    printed = capsys.readouterr().out
    result = experts.solve(crowd, w=1.01, node_limit=50)
    assert printed.splitlines()[:4] == [
        "status       node_limit",
        "proof        none, the cost is above w times the lower bound",
        f"cost         {result.cost}",
        f"lower bound  {result.lower_bound}",
    ]
    assert experts.load_paths(paths).sum_of_costs == result.cost
    assert Path(picture).read_text().startswith("<svg")
    assert main(["check", paths, "--scen", problem]) == 0
    assert main(["solve", problem, "--time-limit", "inf"]) == 0
    assert "proof" not in capsys.readouterr().out


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


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "MemoryError (there is not enough memory)"),
        (MemoryError("Unable to allocate 64 GiB"), "MemoryError: Unable to allocate 64 GiB (there is"),
        (RecursionError("too\ndeep"), "RecursionError: too deep (--debug shows where)"),
        (RuntimeError("no such device"), "RuntimeError: no such device"),
        (KeyError("x"), "KeyError: 'x' (--debug"),
        (UnicodeDecodeError("utf-8", b"x", 0, 1, "bad"), "codec can't decode"),
    ],
)
def test_any_error_is_one_line_and_status_2(
    scen: Path,
    error: Exception,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("experts.command.load_problem", fail)
    for line in (["solve", str(scen)], ["check", str(scen.with_name("paths.txt")), "--scen", str(scen)]):
        scen.with_name("paths.txt").write_text("Agent 0: (0,0)->")
        assert main(line) == 2
        printed = capsys.readouterr().err
        assert said in printed
        assert printed.count("\n") == 1
        assert main([*line, "--debug"]) == 2
        assert "Traceback" in capsys.readouterr().err


def test_outputs_are_checked_before_the_work(scen: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = scen.parent
    for given, said in (
        (["--paths", str(folder)], "is a folder"),
        (["--animation", str(folder / "no" / "a.svg")], "make the folder"),
        (["--paths", str(scen)], "small.scen would overwrite the input"),
        (["--map", str(folder / "small.map"), "--animation", str(folder / "small.map")], "would overwrite the input"),
        (["--paths", str(folder / "a"), "--animation", str(folder / "a")], "a would overwrite the output"),
    ):
        before = {each: each.read_bytes() for each in folder.iterdir()}
        assert main(["solve", str(scen), *given]) == 2
        printed = capsys.readouterr()
        assert printed.out == "", "nothing was solved"
        assert said in printed.err
        assert printed.err.count("\n") == 1
        assert {each: each.read_bytes() for each in folder.iterdir()} == before


@pytest.mark.skipif(sys.platform == "win32", reason="links and pipes of POSIX")
def test_outputs_go_through_links_and_into_devices(scen: Path) -> None:
    real, link = scen.with_name("real"), scen.with_name("link")
    real.write_text("old")
    link.symlink_to(real)
    assert main(["solve", str(scen), "--paths", str(link), "--animation", "/dev/null"]) == 0
    assert link.is_symlink()
    assert real.read_text().startswith("Agent 0:")
    line = [sys.executable, "-m", "experts", "solve", str(scen), "--paths", "/dev/stdout"]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    assert "status       solved" in done.stdout
    assert done.stdout.endswith(real.read_text())


def test_a_closed_pipe_gives_no_traceback(scen: Path) -> None:
    line = f"{sys.executable} -m experts solve {scen} --paths /dev/stdout | true"
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=True)
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_a_crowd_is_checked_quickly_and_in_few_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cells = np.argwhere(np.ones((60, 100)))
    save_instances(tmp_path / "set.json", [Instance(np.zeros((60, 100), bool), cells, cells)])
    (tmp_path / "paths").write_text("".join(f"Agent {i}: (0,0)->(0,0)->\n" for i in range(6000)))
    assert main(["check", str(tmp_path / "paths"), "--scen", str(tmp_path / "set.json")]) == 1
    lines = capsys.readouterr().out.splitlines()
    count = 2 * 5999 + 2 * 6000 * 5999 // 2
    assert lines[-2:] == [f"and {count - 20} more", f"invalid: {count} violations"]
    assert len(lines) == 22


def test_one_long_path_among_many_short_ones_needs_little_memory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """400,000 steps of one robot, and one of 19,999 others, once took 12 GB and ended in a traceback."""
    paths = tmp_path / "paths"
    long = "Agent 0: " + "(0,0)->(0,1)->" * 200_000
    paths.write_text(long + "\n" + "".join(f"Agent {i}: (1,{i})->\n" for i in range(1, 20_000)))
    tracemalloc.start()
    assert main(["check", str(paths), "--scen", str(tmp_path / "none.json")]) == 2
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    printed = capsys.readouterr().err
    assert "20000 lines of up to 400000 cells make a table of 8000000000 cells" in printed
    assert printed.count("\n") == 1
    assert peak < 150e6
    paths.write_text(long + "\n" + "".join(f"Agent {i}: (1,{i})->\n" for i in range(1, 10)))
    assert experts.load_paths(paths).paths.shape == (400_000, 10, 2)


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


PATHS = "Agent 0: (1,0)->(1,1)->(0,1)->\nAgent 1: (2,2)->\n"
LACAM = """agents=2
map_file=small.map
solver=planner
solved=1
soc=2
starts=(0,1),(2,2),
goals=(1,0),(2,2),
solution=
0:(0,1),(2,2),
1:(1,1),(2,2),
2:(1,0),(2,2),
"""


@pytest.mark.parametrize(
    "text",
    [
        PATHS,
        PATHS.replace(",", ", "),
        PATHS.replace("(", " ( ").replace(")", " ) ").replace(":", " : "),
        PATHS.replace("->\n", "\n"),
        PATHS.replace("\n", " \t\n\n"),
        PATHS.replace("\n", "\r\n"),
        "\ufeff" + PATHS,
        PATHS.replace("Agent ", "agent"),
        LACAM,
        LACAM.replace(",", ", "),
        LACAM.replace("\n", " \r\n\r\n"),
        "\ufeff" + LACAM.rstrip("\n"),
        LACAM.replace("),\n", ")\n"),
        LACAM[LACAM.index("solution") :],
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_dialects_of_path_files(tmp_path: Path, text: str, encoding: str) -> None:
    (tmp_path / "paths.txt").write_bytes(text.encode(encoding))
    found = experts.load_paths(tmp_path / "paths.txt").paths
    assert found.tolist() == [[[1, 0], [2, 2]], [[1, 1], [2, 2]], [[0, 1], [2, 2]]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the file holds no paths"),
        ("Agent 1: (0,0)->", "line 1: expected agent 0, got 1"),
        ("\nAgent 0: (0,0)->(1", r"line 2: expected 'Agent 0:.* got 'Agent 0: \(0,0\)->\(1'"),
        ("Agent 0: (a,b)", "line 1: expected"),
        ("Agent 0:", "line 1: expected"),
        ("Agent 0: (0,-1)->", "line 1: expected"),
        ("Agent 0: (0,0)->(1234567890,0)", "line 1: expected"),
        ("Agent 0: (0,0)->\n(0,1)->", "line 2: expected"),
        ("solved=0\nsolution=\n", "the file holds no paths"),
        (LACAM.replace("1:(1,1)", "3:(1,1)"), "line 10: expected time 1, got 3"),
        (LACAM.replace("1:(1,1),(2,2)", "1:(1,1)"), "line 10: 1 cells, but time 0 has 2"),
        (LACAM.replace("1:(1,1)", "1:(1;1)"), "line 10: expected '0:"),
        (LACAM.replace("solution=", "solutions"), "line 1: expected 'Agent 0:"),
    ],
)
def test_damaged_path_files(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "paths.txt").write_text(text)
    with pytest.raises(ValueError, match=rf"paths\.txt.*{said}"):
        experts.load_paths(tmp_path / "paths.txt")
