"""A policy as ONNX parts and a manifest, and the comparison of what they compute with torch."""

from __future__ import annotations

import json
import logging
import warnings
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gnn_policy.checkpoint import fingerprint
from gnn_policy.convolution import StridedConvolution
from gnn_policy.layers import Links
from gnn_policy.network import DecentralizedPolicy
from gnn_policy.robot.exported import FORMAT, INPUTS, LINKS, MANIFEST, ExportedPolicy, digest, part_names
from gnn_policy.robot.message import Message, Precision
from gnn_policy.robot.parts import Heard
from gnn_policy.torch_parts import message_layer
from mapf_env.files import PathLike, replacing, require_outputs, write_whole

TOLERANCE = 1e-4
"""By how much of the greatest value (at least 1) the results of ONNX Runtime and torch may differ."""
_OPSET = 18
_MOST_LINKS = 4096
_LINKS = 3
"""Links of the example that is traced."""


def export(policy: DecentralizedPolicy, folder: PathLike) -> dict[str, Any]:
    """Write the parts of a policy as ONNX and a manifest; return the manifest.

    Args:
        policy: The policy, on the CPU.
        folder: Where to; made if missing.

    Raises:
        ValueError: If its graph layer does not work by messages, or a weight is not finite.
        ImportError: If the extra `export` is missing.
        OSError: If a file cannot be written.
    """
    config, rounds = policy.config, policy.parts().rounds
    folder, names = Path(folder), part_names(rounds)
    folder.mkdir(parents=True, exist_ok=True)
    require_outputs([folder / MANIFEST, *(folder / f"{name}.onnx" for name in names)], [])
    plain = _with_plain_convolutions(policy)
    width, state = 0, ()
    links = torch.rand(_LINKS) + 0.5, torch.rand(_LINKS, config.num_edge_features)
    view = torch.rand(1, config.num_channels, config.fov_side, config.fov_side)
    given: tuple[Tensor, ...] = (view, torch.rand(1, config.num_robot_features), *links)
    contents: dict[str, bytes] = {}
    with torch.no_grad():
        for name in names:
            part, _, number = name.partition("_")
            if part != "encoder":
                own = [f"state_{each}" for each in range(len(state))]
                inputs = [*own, "heard", *LINKS] if part == "combine" else own
                given = (*state, torch.rand(_LINKS, width), *links) if part == "combine" else state
            else:
                inputs = [*map(str, INPUTS)]
            module = _Part(plain, part, int(number or 0))
            contents[name] = _onnx(module, given, inputs)
            result = module(*given)
            if part == "message":
                width = result.shape[1]
            elif part != "head":
                state = result
    precisions: tuple[Precision, ...] = ("float32", "float16", "int8")
    manifest = {
        "format": FORMAT,
        "fingerprint": fingerprint(policy),
        "policy": asdict(config),
        "execution": asdict(policy.execution),
        "view": list(view.shape[1:]),
        "scalars": config.num_robot_features,
        "edge_attr": config.num_edge_features,
        "rounds": rounds,
        "message": width,
        "message_bytes": {each: Message.size(width, each) if rounds else 0 for each in precisions},
        "parts": {name: digest(contents[name]) for name in names},
    }
    for name, content in contents.items():
        with replacing(folder / f"{name}.onnx") as draft:
            draft.write_bytes(content)
    write_whole(folder / MANIFEST, json.dumps(manifest, indent=2) + "\n")
    return manifest


def _onnx(module: nn.Module, given: tuple[Tensor, ...], inputs: list[str]) -> bytes:
    """Return a part as ONNX; arrays of links may have any length."""
    linked = {"heard", *LINKS}
    count = torch.export.Dim("links", min=0, max=_MOST_LINKS)
    shapes = tuple({0: count} if name in linked else {} for name in inputs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter's own parts and names of axes
        for library in ("torch.onnx", "onnxscript", "onnx_ir"):
            logging.getLogger(library).setLevel(logging.ERROR)
        program = torch.onnx.export(
            module,
            given,
            dynamo=True,
            input_names=inputs,
            dynamic_shapes=(shapes,),
            opset_version=_OPSET,
            verbose=False,
        )
    if program is None:
        raise RuntimeError("torch.onnx.export returned no program")
    return program.model_proto.SerializeToString()


def compare(policy: DecentralizedPolicy, folder: PathLike, *, bags: int = 20, seed: int = 0) -> float:
    """Compare an exported policy with torch on robots that see and hear noise.

    Each robot hears between 0 and 8 others, of whom some messages are lost, and views are noise, which is harder than
    what robots see: nothing is zero.

    Args:
        policy: The policy.
        folder: The export of it.
        bags: How many robots.
        seed: Seed of the noise.

    Returns:
        The greatest difference between messages and logits.

    Raises:
        ValueError: If it exceeds 1e-4 of the greatest value, or the export is of another policy.
    """
    exported = ExportedPolicy(folder)
    if exported.fingerprint != fingerprint(policy):
        raise ValueError(f"{folder} is the export of another policy: export again")
    config, rng, worst = policy.config, np.random.default_rng(seed), 0.0
    low, high = config.channel_low[:, None, None], config.channel_high[:, None, None]
    for number in range(bags):
        count = number % 9
        view = rng.uniform(low, high, (config.num_channels, config.fov_side, config.fov_side)).astype(np.float32)
        scalars = rng.uniform(*config.robot_feature_bounds).astype(np.float32)
        attr = rng.uniform(*config.edge_feature_bounds, (count, config.num_edge_features)).astype(np.float32)
        weight = rng.uniform(0.2, 1, count).astype(np.float32)
        came = [rng.random(count) < 0.8 for _ in range(exported.rounds)]
        results = []
        noise = rng.standard_normal((exported.rounds, count, exported.manifest["message"])).astype(np.float32)
        for parts in (policy.parts(), exported):
            state = parts.encode(view, scalars, Heard(weight, attr))
            computed = [*state]
            for k, some in enumerate(came):
                computed.append(parts.send(state, k))
                state = parts.combine(state, noise[k][some], Heard(weight[some], attr[some]), k)
            results.append([*computed, parts.decide(state)])
        for ours, theirs in zip(*results, strict=True):
            difference = float(np.abs(ours - theirs).max(initial=0)) / max(1.0, float(np.abs(ours).max(initial=0)))
            if not difference <= TOLERANCE:
                raise ValueError(
                    f"ONNX Runtime and torch differ by {difference:.1e} of the greatest value, more than {TOLERANCE}: "
                    "do not use this export, and report it with the versions of torch and onnxruntime"
                )
            worst = max(worst, difference)
    return worst


class _Part(nn.Module):
    """One part of a policy for one robot, over plain tensors, as the exporter wants it."""

    def __init__(self, policy: DecentralizedPolicy, part: str, number: int) -> None:
        super().__init__()
        self.policy, self.part, self.number = policy.eval(), part, number
        self.eval()

    def forward(self, *given: Tensor) -> Any:
        """Compute a message (1, G), logits (1, 5), or a state; what is given is named by `_onnx`."""
        layer = message_layer(self.policy)
        if self.part == "encoder":
            view, scalars, weight, attr = given
            return layer.start(self.policy.extract(view, scalars), _links(weight, attr))
        if self.part == "message":
            return layer.send(given, self.number)
        if self.part == "combine":
            *own, heard, weight, attr = given
            state = tuple(own)
            return layer.combine(state, layer.receive(state, heard, _links(weight, attr), self.number), self.number)
        return self.policy.decide(layer.finish(given))


def _links(weight: Tensor, attr: Tensor) -> Links:
    return Links(torch.zeros(weight.shape[0], dtype=torch.int64), weight, attr)


def _with_plain_convolutions(policy: DecentralizedPolicy) -> DecentralizedPolicy:
    """Return a copy on the CPU whose strided convolutions are the library's, which has ONNX for them."""
    copy = deepcopy(policy).cpu().eval()
    for module in list(copy.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, StridedConvolution):
                width, channels = child.weight.shape[:2]
                plain = nn.Conv2d(channels, width, 3, stride=2, padding=1)
                plain.load_state_dict(child.state_dict())
                setattr(module, name, plain)
    return copy
