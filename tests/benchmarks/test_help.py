"""Commands that nothing else starts at least begin, and say what they do."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.parametrize("name", ["cluster", "crowds", "memory", "replay", "scale", "solvers", "speed", "training"])
def test_each_command_explains_itself(name: str) -> None:
    command = [sys.executable, BENCHMARKS / f"{name}.py", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout
