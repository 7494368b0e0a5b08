"""A CNN-GNN policy that imitates an expert, its training loop and its evaluation."""

import os
import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

# Found, not imported: the commands read their arguments before they load a library that takes seconds.
_MISSING = [name for name in ("torch", "torchrl") if find_spec(name) is None]
_ADVICE = (
    'gnn_policy needs the extra "train" (there is no {missing}): '
    'pip install "mapf-env[train]", or in a checkout pip install ".[train]"'
)
if _MISSING and find_spec("onnxruntime") is None:
    raise ImportError(
        _ADVICE.format(missing=_MISSING[0]) + '; to run exported policies on robots: pip install "mapf-env[robot]"'
    )

# OpenMP's threads wait for each other by spinning, which multiplies the time of training as soon as another process
# takes a part of a core. The library reads this once, when torch loads it.
if not {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & os.environ.keys():
    os.environ["GOMP_SPINCOUNT"] = "1000"

if TYPE_CHECKING:
    from gnn_policy.checkpoint import load, save
    from gnn_policy.execution import Execution
    from gnn_policy.layers import Attention, GraphFilter
    from gnn_policy.network import DecentralizedPolicy
    from gnn_policy.policy_config import PolicyConfig
    from gnn_policy.robot import Message, Robot
    from gnn_policy.rollout import Actor, Rollouts, rollout

_MODULES = {
    "Actor": "rollout",
    "Attention": "layers",
    "DecentralizedPolicy": "network",
    "Execution": "execution",
    "GraphFilter": "layers",
    "Message": "robot",
    "PolicyConfig": "policy_config",
    "Robot": "robot",
    "Rollouts": "rollout",
    "load": "checkpoint",
    "rollout": "rollout",
    "save": "checkpoint",
}
"""Each public name and the module that defines it, which is imported when the name is first used."""
_NEEDS_TORCH = frozenset(_MODULES) - {"Execution", "Message", "PolicyConfig", "Robot"}

__all__ = [
    "Actor",
    "Attention",
    "DecentralizedPolicy",
    "Execution",
    "GraphFilter",
    "Message",
    "PolicyConfig",
    "Robot",
    "Rollouts",
    "load",
    "rollout",
    "save",
]


class _Package(ModuleType):
    """This package, whose `rollout` is the function even once the module of that name is imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value.rollout if name == "rollout" and isinstance(value, ModuleType) else value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if _MISSING and name in _NEEDS_TORCH:
        raise ImportError(_ADVICE.format(missing=_MISSING[0]))
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
