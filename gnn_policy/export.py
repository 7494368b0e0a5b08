"""`python -m gnn_policy.export NAME --out FOLDER`: a policy as ONNX parts and a manifest, for robots without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from gnn_policy.command_line import parse_options, run_command
from mapf_env.arguments import integer

PROG = "python -m gnn_policy.export"


@dataclass(frozen=True)
class Command:
    """Export a policy for robots without torch, and compare what ONNX Runtime computes with torch."""

    policy: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """A run folder of training, a .safetensors file, or the name of a policy that comes with the package."""
    out: Path
    """The folder, made if missing; files of earlier exports in it are replaced."""
    bags: int = 20
    """Number of random bags of robots that are compared."""
    seed: int = 0
    """Random seed for the bags."""
    plugins: tuple[str, ...] = ()
    """Encoders and graph layers of your own, as "module:Class", that the policy's file may import."""
    debug: bool = False
    """Print the traceback of an error."""


def parse(arguments: Sequence[str], prog: str = PROG) -> Command:
    """The command that the arguments ask for."""
    return parse_options(Command, arguments, prog=prog)


def main(arguments: Sequence[str] | None = None, *, prog: str = PROG) -> int:
    """Run the command and return its exit status."""
    return run_command(partial(parse, prog=prog), _export, arguments)


def _export(command: Command) -> None:
    from gnn_policy import checkpoint
    from gnn_policy.onnx_export import compare, export

    integer(command.bags, "--bags", 1)
    policy = checkpoint.load(command.policy, plugins=command.plugins)
    manifest = export(policy, command.out)
    worst = compare(policy, command.out, bags=command.bags, seed=command.seed)
    print(
        f"{command.out}: {len(manifest['parts'])} parts, {manifest['rounds']} rounds, messages of "
        f"{manifest['message_bytes']['float32']} bytes; differs from torch by {worst:.1e} at most"
    )


if __name__ == "__main__":
    raise SystemExit(main())
