"""Errors of the commands in one line with exit status 2; commands of robots need it without torch and tyro."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

DEBUG = "--debug"


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
