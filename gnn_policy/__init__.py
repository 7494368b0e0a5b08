"""The pupil: a CNN-GNN policy that imitates an expert, its training loop and its evaluation."""

from importlib.util import find_spec

# Looked for, not imported: to play a policy takes no TorchRL, whose import takes as long as all else.
if missing := [name for name in ("torch", "torchrl") if find_spec(name) is None]:
    raise ImportError(
        f'gnn_policy needs the extra "train" (there is no {missing[0]}): '
        'pip install "mapf-env[train]", or in a checkout pip install ".[train]"'
    )

from gnn_policy.checkpoint import load, save
from gnn_policy.execution import Execution
from gnn_policy.network import DecentralizedPolicy, GraphFilter, PolicyConfig, shift_operator
from gnn_policy.robot import Message, Robot
from gnn_policy.rollout import Actor, Rollouts, Teams, rollout

__all__ = [
    "Actor",
    "DecentralizedPolicy",
    "Execution",
    "GraphFilter",
    "Message",
    "PolicyConfig",
    "Robot",
    "Rollouts",
    "Teams",
    "load",
    "rollout",
    "save",
    "shift_operator",
]
