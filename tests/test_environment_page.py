"""The table of settings in docs/environment.md is complete."""

import re
from dataclasses import fields
from pathlib import Path

from mapf_env import EnvConfig

PAGE = (Path(__file__).parents[1] / "docs" / "environment.md").read_text(encoding="utf-8")


def test_every_setting_is_listed_with_its_default() -> None:
    listed: dict[str, str] = {}
    for names, defaults in re.findall(
        r"^\| (`\w+`(?:, `\w+`)*) \| ([^|]+) \|", PAGE.split("## Settings")[1], re.MULTILINE
    ):
        shown = [default.strip("` ").strip('"') for default in defaults.split(",")]
        listed |= dict(zip(re.findall(r"\w+", names), shown, strict=True))
    assert listed == {field.name: str(field.default) for field in fields(EnvConfig)}
