"""Parts that users bring along: solvers and networks of their own, by the names under which they can be imported."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterable
from typing import Any


def own_part(name: str, what: str, known: Iterable[str]) -> Callable[..., Any]:
    """The function or class that `name` stands for.

    Args:
        name: As "module:name", of a module that can be imported.
        what: What the part is, for messages.
        known: The names of those that come with the package, for messages.

    Raises:
        ValueError: If there is none.
    """
    wanted = f"{what} must be one of {', '.join(known)}, or one of your own as 'module:name'"
    if ":" not in name:
        raise ValueError(f"{wanted}; got {name!r}")
    try:
        part: Any = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as missing:
        raise ValueError(f"{wanted}; {name!r} cannot be found: {missing}") from None
    if not callable(part):
        raise ValueError(f"{wanted}; {name!r} is no function or class but {type(part).__name__}")
    return part
