"""Settings in dataclasses, checked by their annotations: also files, which no type checker reads, give them."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from mapf_env.arguments import flag, integer, number


def check_types(settings: Any) -> None:
    """Check each field of a dataclass against its annotation.

    Raises:
        TypeError: If a field has another type; it names the field.
        ValueError: If a field must be one of several words and is not.
    """
    hints = _hints(type(settings))
    for each in fields(settings):
        _check(getattr(settings, each.name), hints[each.name], each.name)


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _check(value: Any, hint: Any, name: str) -> None:
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if value is None and NoneType in parts:
            return
        (hint,) = (part for part in parts if part is not NoneType)
        _check(value, hint, name)
    elif origin is Literal:
        if not any(value == part and type(value) is type(part) for part in parts):
            raise ValueError(f"{name} must be one of {', '.join(map(str, parts))}, got {value!r}")
    elif origin is tuple:
        if not isinstance(value, tuple):
            raise TypeError(f"{name} must be a tuple, got {value!r}")
        for item in value:
            _check(item, parts[0], name)
    elif hint is bool:
        flag(value, name)
    elif hint is int:
        integer(value, name)
    elif hint is float:
        number(value, name)
    elif not isinstance(value, hint):
        raise TypeError(f"{name} must be of type {hint.__name__}, got {value!r}")
