"""`mapf-env COMMAND` runs the command of the package that offers it."""

import subprocess
import sys
from pathlib import Path

import pytest

from mapf_env import console, random_instance, save_map, save_scen


def test_solve_is_the_solvers_own_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    instance = random_instance(height=8, width=8, num_agents=3, seed=0)
    scenario = tmp_path / "a.scen"
    save_map(tmp_path / "a.map", instance.grid)
    save_scen(scenario, instance, tmp_path / "a.map")
    assert console.main(["solve", str(scenario)]) == 0
    assert "cost" in capsys.readouterr().out
    assert console.main(["solve", str(tmp_path / "none.scen")]) == 2


def test_help_lists_the_commands_and_a_wrong_one_names_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert console.main(["--help"]) == 0
    told = capsys.readouterr().out
    for name in ("play", "solve", "train", "evaluate", "export", "report"):
        assert f"\n  {name}" in told
        assert console.PURPOSES[name] in told
        assert console.main(["nonsense"]) == 2
        assert name in capsys.readouterr().err
    assert "gnn_policy." not in told
    assert console.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("mapf-env 0.")


@pytest.mark.parametrize("name", ["play", "solve", "train", "evaluate", "export", "report"])
def test_help_and_errors_of_a_command_show_the_name_that_it_was_called_by(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        console.main([name, "--help"])
    assert capsys.readouterr().out.startswith(f"usage: mapf-env {name} ")
    with pytest.raises(SystemExit) as end:
        console.main([name, "--no-such-option"])
    assert end.value.code == 2
    refused = capsys.readouterr().err
    assert f"mapf-env {name} --help" in refused
    assert "python -m" not in refused


def test_an_error_of_solve_begins_with_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert console.main(["solve", "none.scen"]) == 2
    assert capsys.readouterr().err.startswith("mapf-env solve: ")


@pytest.mark.parametrize("name", ["play", "train", "evaluate", "export", "report"])
def test_without_torch_a_command_says_what_to_install(name: str) -> None:
    code = (
        "import importlib.util as u, sys; found, hidden = u.find_spec, ('torch', 'onnxruntime')\n"
        "u.find_spec = lambda name, *rest: None if name in hidden else found(name, *rest)\n"
        f"from mapf_env import console; sys.exit(console.main([{name!r}, '--help']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert 'pip install "mapf-env[train]"' in done.stderr
