"""The tables of settings in docs/environment.md are complete."""

import inspect
import re
from dataclasses import fields
from pathlib import Path

from mapf_env import BatchedEnv, EnvConfig, GridEnv

PAGE = (Path(__file__).parents[1] / "docs" / "environment.md").read_text(encoding="utf-8")
SHARED, OF_ONE_INTERFACE = PAGE.split("## Settings")[1].split("\n## ")[0].split("### For single interfaces")


def listed(part: str) -> dict[str, str]:
    """The names in the tables of a part of the page, and their defaults."""
    found: dict[str, str] = {}
    for names, defaults in re.findall(r"^\| (`\w+`(?:, `\w+`)*) \| ([^|]+) \|", part, re.MULTILINE):
        shown = [default.strip("` ").strip('"') for default in defaults.split(",")]
        found |= dict(zip(re.findall(r"\w+", names), shown, strict=True))
    return found


def test_every_setting_is_listed_with_its_default() -> None:
    assert listed(SHARED) == {field.name: str(field.default) for field in fields(EnvConfig)}


def test_settings_of_one_interface_are_listed_with_their_defaults() -> None:
    taken = {
        name: getattr(parameter.default, "name", str(parameter.default))
        for interface in (GridEnv, BatchedEnv)
        for name, parameter in inspect.signature(interface).parameters.items()
        if parameter.default is not parameter.empty
    }
    assert listed(OF_ONE_INTERFACE) == taken
