"""Importing the pupil where its libraries are missing."""

import subprocess
import sys

import pytest

WITHOUT = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "{library}":
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
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
