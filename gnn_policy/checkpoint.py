"""Policies on disk: one safetensors file with its configuration and execution; torch comes with the weights only."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import asdict, replace
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import safetensors

from gnn_policy.config import TrainConfig
from gnn_policy.execution import Execution
from gnn_policy.policy_config import PolicyConfig
from mapf_env.files import PathLike, replacing

if TYPE_CHECKING:
    import torch

    from gnn_policy.network import DecentralizedPolicy

T = TypeVar("T")

FORMAT = "mapf-env policy 2"
DUST = 1e-15
"""Saved weights smaller than this are set to zero."""
WEIGHTS = Path(__file__).with_name("weights")
"""The policies that come with the package, and their card, README.md."""
PACKAGED = WEIGHTS / "general.safetensors"
"""The default policy."""


class CheckpointError(ValueError):
    """A file that is not a policy of this package; the message says which and why."""


def save(policy: DecentralizedPolicy, path: PathLike, **about: str) -> None:
    """Write the weights and the configuration of `policy` to one file, replacing it as a whole or not at all.

    Equal weights, configuration and notes give equal bytes.

    Args:
        policy: The policy.
        path: A file, by convention ending in `.safetensors`.
        about: Notes that travel with the weights, such as the command that trained them.

    Raises:
        TypeError: If it is another network, which `load` could not build.
        ValueError: If a weight is not a finite number.
    """
    import safetensors.torch

    from gnn_policy.finite import require_finite
    from gnn_policy.network import DecentralizedPolicy

    if not isinstance(policy, DecentralizedPolicy):
        raise TypeError(
            f"save writes a DecentralizedPolicy, got {type(policy).__name__}: give its state_dict to torch.save"
        )
    require_finite(policy.state_dict())
    metadata = {
        **about,
        "format": FORMAT,
        "policy": json.dumps(asdict(policy.config)),
        "execution": json.dumps(asdict(policy.execution)),
    }
    weights = {name: _without_dust(tensor).contiguous() for name, tensor in policy.state_dict().items()}
    with replacing(path) as draft:
        draft.write_bytes(_with_sorted_metadata(safetensors.torch.save(weights, metadata)))


def _with_sorted_metadata(content: bytes) -> bytes:
    """The same safetensors file with its metadata in alphabetical order; the library's order is random."""
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + content[8 + length :]


def _without_dust(tensor: torch.Tensor) -> torch.Tensor:
    """Replace weights that are too small to show in any sum by zero.

    Weight decay brings the weights of units that are never active down to denormal numbers, with which a CPU computes
    several times slower.
    """
    import torch

    return torch.where(tensor.abs() < DUST, 0, tensor) if tensor.is_floating_point() else tensor


def load(path: PathLike = PACKAGED, *, plugins: Collection[str] = ()) -> DecentralizedPolicy:
    """Return a policy in evaluation mode.

    Args:
        path: A file, a run folder of `gnn_policy.train`, or the name of a policy that comes with the package:
            "general", for any map and crowds of robots, which knows the map; the paper's models, by the robots of their
            training teams "n4", "n6", "n8", "n10" and "n12", which know no map; and "n12-informed", which does.
        plugins: The encoders and graph layers of your own, as "module:Class", that the file may import. Their modules
            run as your code: name only those that you trust.

    Raises:
        FileNotFoundError: If there is no such file.
        CheckpointError: If the file is damaged, comes from another program, does not fit its configuration, has weights
            that are not finite, or wants a part that `plugins` does not name.
        TypeError: If `plugins` is one name and not a collection of names.
    """
    import safetensors.torch

    from gnn_policy.finite import require_finite
    from gnn_policy.network import DecentralizedPolicy

    if isinstance(plugins, str):
        raise TypeError(f"plugins must be a collection of names, got {plugins!r}: write ({plugins!r},)")
    file, (metadata, shapes), execution = file_of(path), _read_header(path), executed_as(path)
    try:
        config = PolicyConfig(**_json_object(metadata["policy"]))
    except (KeyError, TypeError, ValueError, RecursionError) as wrong:
        raise _misfit(file, wrong) from wrong
    for setting, name in config.plugins.items():
        if name not in plugins:
            raise CheckpointError(
                f"{file} wants to import its {setting} {name!r} from the module {name.partition(':')[0]!r}: if you "
                f'trust that module, ask for it by plugins=("{name}",), or by --plugins {name} on the command line'
            )
    try:
        _require_shapes(config, shapes)
        policy = DecentralizedPolicy(config, execution)
        policy.load_state_dict(safetensors.torch.load_file(file))
        require_finite(policy.state_dict())
    except safetensors.SafetensorError as damage:
        raise _damaged(file, damage) from damage
    except (KeyError, TypeError, ValueError, RuntimeError) as mismatch:
        raise _misfit(file, mismatch) from mismatch
    return policy.eval()


def _require_shapes(config: PolicyConfig, found: dict[str, tuple[int, ...]]) -> None:
    """Compare the tensors of a file with its configuration before memory is allocated.

    The user's own parts are left to `load_state_dict`.

    Raises:
        ValueError: If a tensor is missing or has another shape.
    """
    import torch

    from gnn_policy.network import DecentralizedPolicy

    own = tuple(f"{'encoder' if setting == 'encoder' else 'graph_layer'}." for setting in config.plugins)
    built_in = {"encoder": "lean", "graph_layer": "filter"}
    known = replace(config, **{setting: built_in[setting] for setting in config.plugins})
    with torch.device("meta"):
        expected = DecentralizedPolicy(known).state_dict()
    for name, tensor in expected.items():
        if not name.startswith(own) and found.get(name) != tuple(tensor.shape):
            raise ValueError(f"{name} should have shape {tuple(tensor.shape)}, the file has {found.get(name)}")
    if strange := [name for name in found if name not in expected and not name.startswith(own)]:
        raise ValueError(f"the file has the unknown tensor {strange[0]}")


def about(path: PathLike) -> dict[str, str]:
    """Return the notes that were saved with the policy at `path`.

    Raises:
        FileNotFoundError: If there is no such file.
        CheckpointError: If the file is damaged or comes from another program.
    """
    return _read_header(path)[0]


def trained_with(path: PathLike) -> TrainConfig:
    """Return the settings that the policy at `path` was trained with, or the defaults if it does not say.

    Settings of newer versions, which this one does not know, are left out.

    Raises:
        FileNotFoundError: If there is no such file.
        CheckpointError: If the file is damaged, or a setting has a wrong type or value.
    """
    settings = about(path).get("training")
    if settings is None:
        return TrainConfig()
    try:
        return TrainConfig.from_toml(settings, ignore_unknown=True)
    except ValueError as wrong:
        raise CheckpointError(f"{file_of(path)}: the settings of its training are damaged: {wrong}") from wrong


def config_of(path: PathLike) -> PolicyConfig:
    """Return the configuration of the policy at `path`.

    Raises:
        FileNotFoundError: If there is no such file.
        CheckpointError: If the file is damaged or comes from another program.
    """
    return _described(path, "policy", PolicyConfig, "its configuration is damaged")


def executed_as(path: PathLike) -> Execution:
    """Return how the policy at `path` is executed unless a caller says otherwise.

    Raises:
        FileNotFoundError: If there is no such file.
        CheckpointError: If the file is damaged or comes from another program.
    """
    return _described(path, "execution", Execution, "how to execute the policy is not readable")


def _described(path: PathLike, name: str, kind: type[T], fault: str) -> T:
    """Return a part of the metadata as a dataclass of this kind."""
    try:
        return kind(**_json_object(about(path)[name]))
    except (KeyError, TypeError, ValueError, RecursionError) as wrong:
        raise _misfit(file_of(path), wrong, fault) from wrong


def fingerprint(policy: DecentralizedPolicy) -> str:
    """Return a hash of the configuration and the weights."""
    hashed = blake2b(json.dumps(asdict(policy.config)).encode(), digest_size=8)
    for name, tensor in policy.state_dict().items():
        hashed.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
    return hashed.hexdigest()


def file_of(path: PathLike) -> Path:
    """Return the file that `load` reads for a path or name; it need not exist."""
    given = Path(path)
    if given.is_dir():
        return given / "best.safetensors"
    packaged = WEIGHTS / f"{given}.safetensors"
    return packaged if given.name == str(given) and not given.exists() and packaged.is_file() else given


def _read_header(path: PathLike) -> tuple[dict[str, str], dict[str, tuple[int, ...]]]:
    """The metadata of a policy and the shapes of its tensors, which the library has compared with the file's length."""
    file = file_of(path)
    if not file.is_file():
        names = ", ".join(sorted(each.stem for each in WEIGHTS.glob("*.safetensors")))
        raise FileNotFoundError(
            f"there is no checkpoint {file}: give a .safetensors file, a run folder of training, or one of {names}"
        )
    try:
        with safetensors.safe_open(file, "np") as stored:
            metadata: dict[str, str] = stored.metadata() or {}
            shapes = {name: tuple(stored.get_slice(name).get_shape()) for name in stored.keys()}  # noqa: SIM118
    except safetensors.SafetensorError as damage:
        raise _damaged(file, damage) from damage
    if metadata.get("format") != FORMAT:
        raise CheckpointError(
            f"{file} is not a policy of this package (format {metadata.get('format')!r}, expected {FORMAT!r}): "
            "give a file that gnn_policy.save wrote"
        )
    return metadata, shapes


def _json_object(text: str) -> dict[str, Any]:
    found = json.loads(text)
    if not isinstance(found, dict):
        raise TypeError(f"the settings are not an object but {type(found).__name__}")
    return found


def _misfit(
    file: Path, mismatch: Exception, what: str = "the weights do not fit their configuration"
) -> CheckpointError:
    why = " ".join(f"{type(mismatch).__name__}: {mismatch}".split())
    return CheckpointError(f"{file}: {what} ({why})")


def _damaged(file: Path, damage: Exception) -> CheckpointError:
    return CheckpointError(f"{file} is damaged or not a safetensors file ({damage}): restore it or train again")
