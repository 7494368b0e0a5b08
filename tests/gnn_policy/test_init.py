"""Importing the pupil where its libraries are missing."""

import subprocess
import sys

import pytest

WITHOUT = """
import sys

sys.modules["{library}"] = None  # as if it were not installed
try:
    import gnn_policy
except ImportError as refusal:
    print(refusal)
"""


@pytest.mark.parametrize("library", ["torch", "torchrl"])
def test_without_the_extra_the_message_says_what_to_install(library):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT.format(library=library)], capture_output=True, text=True, check=True
    )
    assert done.stdout.count("\n") == 1
    assert 'pip install "mapf-env[train]"' in done.stdout
    assert library in done.stdout


def test_a_robot_that_runs_a_policy_needs_no_torchrl():
    program = "import sys, gnn_policy; gnn_policy.Robot(gnn_policy.load()); print('torchrl' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
