"""Shared parts of the commands: errors in one line with exit status 2, and a check of the device before the work."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from gnn_policy.network import DecentralizedPolicy

C = TypeVar("C")
DEBUG = "--debug"


def run_command(
    parse: Callable[[Sequence[str]], C], work: Callable[[C], None], arguments: Sequence[str] | None = None
) -> None:
    """Parse the arguments of a command and do its work, with errors as in `cli_errors`.

    Args:
        parse: Makes a command of its arguments; may end the process, as for `--help`.
        work: Does what the command asks for. If code that it calls ends the process with status 0, such as a module of
            the user's own with `sys.exit()`, that is an error: the work has not been done.
        arguments: The arguments; `sys.argv[1:]` if not given.
    """
    given = sys.argv[1:] if arguments is None else arguments
    with cli_errors(debug=DEBUG in given):
        command = parse(given)
        try:
            work(command)
        except SystemExit as end:
            if end.code in (0, None):
                raise RuntimeError(
                    "code that this command called ended the process before the work was done: "
                    "remove sys.exit() and SystemExit from your own module"
                ) from end
            raise


@contextmanager
def cli_errors(*, debug: bool = False) -> Iterator[None]:
    """Report any error in one line on stderr with exit status 2, and Ctrl-C with status 130.

    Args:
        debug: Print the traceback of an error first.
    """
    try:
        yield
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        raise SystemExit(130) from None
    except Exception as error:
        if debug:
            traceback.print_exc()
        print(f"error: {_one_line(error)}", file=sys.stderr)
        raise SystemExit(2) from None


def _one_line(error: Exception) -> str:
    """The message of an error; where the user's input may not be the cause, with its type and how to see more."""
    text = " ".join(str(error).split())
    if isinstance(error, ValueError | TypeError | OSError) and text:
        return text
    if isinstance(error, MemoryError):
        text = f"not enough memory ({text or 'MemoryError'}): ask for fewer or smaller maps, teams or batches"
    elif isinstance(error, RecursionError):
        text = f"too deeply nested ({text})"
    else:
        text = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return f"{text} ({DEBUG} shows the traceback)"


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
