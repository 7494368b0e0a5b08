"""A smoke test for an environment with nothing but `pip install mapf-env`; run as a script, outside the repository."""

import subprocess
import sys

import numpy as np
import pettingzoo
from pettingzoo.test import parallel_api_test

import experts
import mapf_env

parallel_api_test(pettingzoo.make("parallel", "mapf/grid-v0"), num_cycles=200)

instance = mapf_env.random_instance(num_agents=10, seed=7)
result = experts.solve(instance)
assert result.solution is not None
assert not result.solution.violations(instance)

env = mapf_env.parallel_env(num_agents=10)
env.reset(seed=3, options={"instance": instance})
for actions in result.solution.actions:
    _, _, _, _, infos = env.step({f"agent_{i}": int(action) for i, action in enumerate(actions)})
    assert not any(info["replaced"] for info in infos.values())
assert not env.agents
assert np.array_equal(env.positions, instance.goals)

advice = ""
try:
    import gnn_policy  # noqa: F401
except ImportError as missing:
    advice = str(missing)
assert 'pip install "mapf-env[train]"' in advice, advice
assert "torch" not in sys.modules

command = [sys.executable, "-c", "import sys; from mapf_env.console import main; sys.exit(main())"]
assert subprocess.run([*command, "--help"], check=False).returncode == 0
refused = subprocess.run([*command, "play", "a.map"], capture_output=True, text=True, check=False)
assert refused.returncode == 2, refused
assert 'pip install "mapf-env[train]"' in refused.stderr
assert refused.stderr.count("\n") == 1, refused.stderr
print("bare installation: environment and experts run, torch is not there")
