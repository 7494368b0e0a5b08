"""The command that reads a folder of MovingAI files counts what it reads and fails where a file does."""

import subprocess
import sys
from pathlib import Path

from mapf_env import random_instance, save_map, save_scen

COMMAND = Path(__file__).parents[2] / "benchmarks" / "load_files.py"


def run(folder: Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, COMMAND, folder], capture_output=True, text=True, timeout=60)


def test_sound_files_pass_and_a_damaged_one_fails(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    instance = random_instance(height=5, width=6, num_agents=4, seed=0)
    save_map(tmp_path / "deep" / "one.map", instance.grid)
    save_scen(tmp_path / "one.scen", instance, tmp_path / "deep" / "one.map")
    done = run(tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["1 *.map with 30 cells", "1 *.scen with 4 agents"]
    (tmp_path / "two.map").write_text("type octile\nheight 1\nwidth 2\nmap\n.x\n")
    done = run(tmp_path)
    assert done.returncode == 1
    assert "two.map, line 5, column 2: unknown character 'x'" in done.stderr
    assert "1 files failed" in done.stderr


def test_many_cases_on_one_map_are_timed() -> None:
    program = f"import sys; sys.path.insert(0, {str(COMMAND.parent)!r}); import load_files; from pathlib import Path\n"
    program += "import tempfile\nwith tempfile.TemporaryDirectory() as folder:\n"
    program += "    load_files.many_cases(Path(folder), height=40, width=50, sets=3, scenarios=7)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert "3 instances: saved in" in done.stdout
    assert "7 scenarios: loaded in" in done.stdout
