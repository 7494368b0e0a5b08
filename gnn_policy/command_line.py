"""Shared parts of the commands: errors in one line with exit status 2, and a check of the device before the work."""

from __future__ import annotations

import ast
import inspect
import os
import sys
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, get_type_hints

from gnn_policy.cli_errors import DEBUG, cli_errors

if TYPE_CHECKING:
    from gnn_policy.network import DecentralizedPolicy

C = TypeVar("C")


def run_command(
    parse: Callable[[Sequence[str]], C], work: Callable[[C], int | None], arguments: Sequence[str] | None = None
) -> int:
    """Parse the arguments of a command, do its work and return its exit status, with errors as in `cli_errors`.

    Args:
        parse: Makes a command of its arguments; may end the process, as for `--help`.
        work: Does what the command asks for and returns the exit status; None means 0. If code that it calls ends the
            process with status 0, such as a user's module with `sys.exit()`, that is an error: the work is not done.
        arguments: The arguments; `sys.argv[1:]` if not given.
    """
    given = sys.argv[1:] if arguments is None else arguments
    with cli_errors(debug=DEBUG in given):
        command = parse(given)
        try:
            return work(command) or 0
        except SystemExit as end:
            if end.code in (0, None):
                raise RuntimeError(
                    "code that this command called ended the process before the work was done: "
                    "remove sys.exit() and SystemExit from your own module"
                ) from end
            raise


def parse_options(kind: type[C], arguments: Sequence[str], **settings: Any) -> C:
    """Parse the options of a dataclass with tyro; an option's help is its field's docstring as one paragraph.

    Args:
        kind: The dataclass.
        arguments: The arguments of the command.
        settings: Keyword arguments of `tyro.cli`.
    """
    import tyro

    _flow_help(kind)
    return tyro.cli(kind, args=arguments, **settings)


def _flow_help(kind: type) -> None:
    """Annotate the fields of a dataclass and of those within it with their docstrings; tyro keeps their line breaks."""
    import tyro

    for each in kind.__mro__[:-1]:
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(each))).body
        assignments = pairwise(body.body if isinstance(body, ast.ClassDef) else [])
        hints = get_type_hints(each, include_extras=True)
        for before, after in assignments:
            match before, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    flowing = tyro.conf.arg(help=" ".join(text.split()))
                    each.__annotations__[name] = Annotated[hints[name], flowing]
        for inner in get_type_hints(each).values():
            if is_dataclass(inner):
                _flow_help(cast(type, inner))


def on_device(policy: DecentralizedPolicy, device: str) -> DecentralizedPolicy:
    """Move the policy to a device of PyTorch's, such as "cuda"; "auto" is the fastest one available.

    Under torchrun each process takes the GPU of its number on the machine (LOCAL_RANK).

    Raises:
        ValueError: If the device does not exist, or holds no numbers, as "meta".
    """
    import torch

    if device == "auto":
        accelerator = torch.accelerator.current_accelerator(check_available=True)
        device = "cpu" if accelerator is None else accelerator.type
    if device == "cuda":
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
    try:
        torch.ones(1, device=device).cpu()
        return policy.to(device)
    except (RuntimeError, AssertionError, ImportError) as refusal:
        why = (str(refusal).splitlines() or [type(refusal).__name__])[0]
        raise ValueError(f"the network cannot be placed on device {device!r}: {why}") from refusal
