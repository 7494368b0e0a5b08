"""An exported policy: a folder with a manifest and its parts as ONNX, run by ONNX Runtime."""

from __future__ import annotations

import json
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from gnn_policy.execution import Execution
from gnn_policy.policy_config import PolicyConfig
from gnn_policy.robot.parts import Features, Heard, State
from mapf_env.files import PathLike, read_bytes

FORMAT = "mapf-env robot 1"
MANIFEST = "manifest.json"
LINKS = ("link_weight", "link_attr")
INPUTS = ("seen", "known", *LINKS)
"""Inputs of the encoder; the later parts read `state_0`, `state_1`, ... and, to combine, `heard` and `LINKS`."""
_MOST_ROUNDS = 64


def part_names(rounds: int) -> list[str]:
    """Return the names of the parts of a policy with that many rounds; part `x` lies in the file `x.onnx`."""
    numbered = [f"{part}_{number}" for number in range(rounds) for part in ("message", "combine")]
    return ["encoder", *numbered, "head"]


def digest(content: bytes) -> str:
    """Return the hash of a part's file that the manifest gives."""
    return blake2b(content, digest_size=16).hexdigest()


class ExportedPolicy:
    """The parts of a policy as `gnn_policy.robot.parts.Parts` describes them, each a session of one thread.

    Names of files are not read from the manifest, and each file must have the hash that it gives.

    Args:
        folder: What `python -m gnn_policy.export` wrote.

    Raises:
        OSError: If a file is missing.
        ValueError: If the manifest or a part is damaged.
    """

    def __init__(self, folder: PathLike) -> None:
        self.folder = Path(folder)
        file = self.folder / MANIFEST
        try:
            self.manifest = manifest = _json_object(_read(file))
            if manifest["format"] != FORMAT:
                raise ValueError(f"its format is {manifest['format']!r}, expected {FORMAT!r}")
            self.config = PolicyConfig(**_lists_as_tuples(manifest["policy"]))
            self.execution = Execution(**manifest["execution"])
            self.rounds = manifest["rounds"]
            self.fingerprint = str(manifest["fingerprint"])
            if type(self.rounds) is not int or not 0 <= self.rounds <= _MOST_ROUNDS:
                raise ValueError(f"rounds must lie in 0..{_MOST_ROUNDS}, got {self.rounds!r}")
            hashes = {name: str(manifest["parts"][name]) for name in part_names(self.rounds)}
        except (KeyError, TypeError, ValueError, RecursionError) as damage:
            why = f"it has no {damage}" if isinstance(damage, KeyError) else str(damage)
            raise ValueError(f"{file} is not the manifest of an exported policy ({why}): export it again") from damage
        self._sessions = {name: self._session(name, expected) for name, expected in hashes.items()}
        self._inputs = {name: [each.name for each in part.get_inputs()] for name, part in self._sessions.items()}

    def parts(self) -> ExportedPolicy:
        """Return itself: it is what a `Robot` runs."""
        return self

    def encode(self, view: Features, scalars: Features, links: Heard) -> State:
        """Return the first state of the graph layer."""
        return self._run("encoder", dict(zip(INPUTS, (view[None], scalars[None], *links), strict=True)))

    def send(self, state: State, number: int) -> Features:
        """Return the message (G,) of round `number`."""
        return self._run(f"message_{number}", _named(state))[0][0]

    def combine(self, state: State, messages: Features, links: Heard, number: int) -> State:
        """Return the state after round `number`."""
        return self._run(
            f"combine_{number}", {**_named(state), "heard": messages, **dict(zip(LINKS, links, strict=True))}
        )

    def decide(self, state: State) -> Features:
        """Return the logits (5,)."""
        return self._run("head", _named(state))[0][0]

    def _run(self, name: str, given: dict[str, Any]) -> State:
        # The exporter drops inputs that a part does not use.
        results = self._sessions[name].run(None, {each: given[each] for each in self._inputs[name]})
        return tuple(np.asarray(each) for each in results)

    def _session(self, name: str, expected: str) -> onnxruntime.InferenceSession:
        file = self.folder / f"{name}.onnx"
        content = _read(file)
        if digest(content) != expected:
            raise ValueError(f"{file} is damaged: its hash is not the manifest's; export the policy again")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as refusal:  # the library has no base class for its errors
            raise ValueError(f"{file} cannot be run by ONNX Runtime {onnxruntime.__version__}: {refusal}") from refusal


def _named(state: State) -> dict[str, np.ndarray]:
    return {f"state_{number}": part for number, part in enumerate(state)}


def _read(file: Path) -> bytes:
    if not file.is_file():
        raise FileNotFoundError(f"there is no {file}: give a folder that `python -m gnn_policy.export` wrote")
    return read_bytes(file)


def _json_object(content: bytes) -> dict[str, Any]:
    found = json.loads(content)
    if not isinstance(found, dict):
        raise TypeError(f"it is not an object but {type(found).__name__}")
    return found


def _lists_as_tuples(settings: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
