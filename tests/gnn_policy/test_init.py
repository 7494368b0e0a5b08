"""Importing gnn_policy without its libraries."""

import os
import subprocess
import sys

import pytest

NAMES = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")

WITHOUT = """
import sys

for library in {libraries}:
    sys.modules[library] = None  # as if it were not installed
try:
    {statement}
except ImportError as refusal:
    print(refusal)
"""


def run_without(libraries, statement):
    program = WITHOUT.format(libraries=libraries, statement=statement)
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("library", ["torch", "torchrl"])
def test_without_the_extra_the_message_names_what_to_install(library):
    for libraries, statement in (
        ([library, "onnxruntime"], "import gnn_policy"),
        ([library], "from gnn_policy import load"),
    ):
        printed = run_without(libraries, statement)
        assert printed.count("\n") == 1
        assert 'pip install "mapf-env[train]"' in printed
        assert library in printed
    assert 'pip install "mapf-env[robot]"' in run_without([library, "onnxruntime"], "import gnn_policy")


def test_a_robot_needs_no_torch():
    statement = "import gnn_policy; print(gnn_policy.Robot.__name__, gnn_policy.Message.__name__)"
    assert run_without(["torch", "torchrl"], statement) == "Robot Message\n"


def test_a_robot_that_runs_a_policy_needs_no_torchrl():
    program = "import sys, gnn_policy; gnn_policy.Robot(gnn_policy.load()); print('torchrl' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


@pytest.mark.parametrize("given", [{}, {"GOMP_SPINCOUNT": "77"}, {"OMP_WAIT_POLICY": "ACTIVE"}])
def test_openmp_waits_without_spinning_unless_the_user_says_how(given):
    program = "import os, gnn_policy; print(*(os.environ.get(n) for n in ('GOMP_SPINCOUNT', 'OMP_WAIT_POLICY')))"
    plain = {name: value for name, value in os.environ.items() if name not in NAMES}
    done = subprocess.run(
        [sys.executable, "-c", program], env={**plain, **given}, capture_output=True, text=True, check=True
    )
    spin, policy = done.stdout.split()
    assert (spin, policy) == (("1000", "None") if not given else tuple(str(given.get(n)) for n in NAMES))


def test_every_public_name_is_defined_in_its_module():
    program = (
        "import sys, gnn_policy\n"
        "assert not {'torch', 'torchrl', 'matplotlib'} & sys.modules.keys()\n"
        "import gnn_policy.metrics\n"  # imports the module `rollout`
        "for name in gnn_policy.__all__:\n"
        "    assert callable(getattr(gnn_policy, name)), name\n"
        "from gnn_policy import *\n"
        "assert rollout is sys.modules['gnn_policy.rollout'].rollout\n"
        "assert not hasattr(gnn_policy, 'nothing')"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_settings_need_no_torch():
    program = (
        "import sys; from gnn_policy import Execution, PolicyConfig; from gnn_policy.config import TrainConfig\n"
        "TrainConfig(policy=PolicyConfig()), Execution(), print({'torch', 'torchrl'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
