"""Policies on disk: one safetensors file that carries its own configuration."""

from __future__ import annotations

import json
from dataclasses import asdict
from hashlib import blake2b
from pathlib import Path

import safetensors
import safetensors.torch
import torch

from gnn_policy.config import TrainConfig
from gnn_policy.network import DecentralizedPolicy, PolicyConfig
from mapf_env.files import PathLike, replacing

FORMAT = "mapf-env policy 1"
DUST = 1e-15
"""No weight that a policy is saved with is smaller, but for zero."""
WEIGHTS = Path(__file__).with_name("weights")
"""The policies that come with the package, and their card, README.md."""
PACKAGED = WEIGHTS / "n12.safetensors"
"""The one that is taken where none is given."""


class CheckpointError(ValueError):
    """A file that is no policy of this package; the message says which and why."""


def save(policy: DecentralizedPolicy, path: PathLike, **about: str) -> None:
    """Write the weights and the configuration of `policy` to one file, replacing it as a whole or not at all.

    Args:
        policy: The policy.
        path: A file, by convention ending in `.safetensors`.
        about: Notes that travel with the weights, as the command that trained them.

    Raises:
        TypeError: If it is another network, which `load` could not build.
    """
    if not isinstance(policy, DecentralizedPolicy):
        raise TypeError(
            f"save writes a DecentralizedPolicy, got {type(policy).__name__}: give its state_dict to torch.save"
        )
    metadata = {**about, "format": FORMAT, "policy": json.dumps(asdict(policy.config))}
    weights = {name: _without_dust(tensor).contiguous() for name, tensor in policy.state_dict().items()}
    with replacing(path) as draft:
        draft.write_bytes(safetensors.torch.save(weights, metadata))


def _without_dust(tensor: torch.Tensor) -> torch.Tensor:
    """Zero for what is too small to show in any sum.

    Weight decay brings the weights of units that are never active down to denormal numbers, with which a CPU computes
    several times slower.
    """
    return torch.where(tensor.abs() < DUST, 0, tensor) if tensor.is_floating_point() else tensor


def load(path: PathLike = PACKAGED) -> DecentralizedPolicy:
    """A policy in evaluation mode.

    A policy that has an encoder or a graph layer of your own imports the module that its configuration names.

    Args:
        path: A file, a run folder of `gnn_policy.train`, or the name of a policy that comes with the package: by the
            robots of its training teams "n4", "n6", "n8", "n10", "n12", or "n12-informed", which sees the cost to go.

    Raises:
        FileNotFoundError: If there is none.
        CheckpointError: If the file is damaged, of another program or of another architecture.
    """
    metadata, weights = _read(path)
    try:
        policy = DecentralizedPolicy(PolicyConfig(**json.loads(metadata["policy"])))
        policy.load_state_dict(weights)
    except (KeyError, TypeError, ValueError, RuntimeError) as mismatch:
        why = " ".join(f"{type(mismatch).__name__}: {mismatch}".split())
        raise CheckpointError(f"the weights in {file_of(path)} do not fit their configuration ({why})") from None
    return policy.eval()


def about(path: PathLike) -> dict[str, str]:
    """The notes that were saved with the policy at `path`; raises as `load` does."""
    return _read(path)[0]


def trained_with(path: PathLike) -> TrainConfig:
    """The settings of its training as the policy at `path` tells them, else the defaults; raises as `load` does."""
    settings = about(path).get("training")
    return TrainConfig() if settings is None else TrainConfig.from_json(settings)


def fingerprint(policy: DecentralizedPolicy) -> str:
    """A hash of the configuration and the weights."""
    hashed = blake2b(json.dumps(asdict(policy.config)).encode(), digest_size=8)
    for name, tensor in policy.state_dict().items():
        hashed.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
    return hashed.hexdigest()


def file_of(path: PathLike) -> Path:
    """The file that `load` reads for a path or name; it need not exist."""
    given = Path(path)
    if given.is_dir():
        return given / "best.safetensors"
    packaged = WEIGHTS / f"{given}.safetensors"
    return packaged if given.name == str(given) and not given.exists() and packaged.is_file() else given


def _read(path: PathLike) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    file = file_of(path)
    if not file.is_file():
        names = ", ".join(sorted(each.stem for each in WEIGHTS.glob("*.safetensors")))
        raise FileNotFoundError(
            f"there is no checkpoint {file}: give a .safetensors file, a run folder of training, or one of {names}"
        )
    try:
        with safetensors.safe_open(file, "pt") as stored:
            metadata: dict[str, str] = stored.metadata() or {}
        weights = safetensors.torch.load_file(file)
    except safetensors.SafetensorError as damage:
        raise CheckpointError(
            f"{file} is damaged or no safetensors file ({damage}): restore or train it anew"
        ) from None
    if metadata.get("format") != FORMAT:
        raise CheckpointError(
            f"{file} is no policy of this package (format {metadata.get('format')!r}, expected {FORMAT!r}): "
            "give a file that gnn_policy.save wrote"
        )
    return metadata, weights
