"""Solvers and parts of a network that users bring along, imported by name where the user asks for them."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterable
from typing import Any


def import_by_name(name: str, what: str, known: Iterable[str]) -> Callable[..., Any]:
    """Import the function or class that `name` stands for.

    Args:
        name: As "module:name", of a module that can be imported.
        what: The part's purpose, for messages.
        known: The names of those that come with the package, for messages.

    Raises:
        ValueError: If it cannot be imported, or cannot be called.
    """
    wanted = f"{what} must be one of {', '.join(known)}, or one of your own as 'module:name'"
    if ":" not in name:
        raise ValueError(f"{wanted}; got {name!r}")
    try:
        part: Any = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as missing:
        raise ValueError(f"{wanted}; {name!r} cannot be found: {missing}") from missing
    except (Exception, SystemExit) as failure:  # whatever the module does while it is imported
        raise ValueError(
            f"{wanted}; the import of {name!r} fails with {type(failure).__name__}: {failure}"
        ) from failure
    if not callable(part):
        raise ValueError(f"{wanted}; {name!r} is not a function or class but {type(part).__name__}")
    return part
