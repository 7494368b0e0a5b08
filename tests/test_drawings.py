"""The drawings of the docs are those of their script, and show what they say."""

import csv
import importlib.util
from dataclasses import fields
from pathlib import Path

import pytest

from gnn_policy.failures import failure
from gnn_policy.learning_curve import Round
from gnn_policy.recipes import RECIPES

HOME = Path(__file__).parents[1] / "docs" / "drawings"
spec = importlib.util.spec_from_file_location("draw", HOME / "draw.py")
assert spec is not None
assert spec.loader is not None
draw = importlib.util.module_from_spec(spec)
spec.loader.exec_module(draw)


def test_the_files_match_the_script() -> None:
    drawn = draw.drawings()
    assert {path.stem for path in HOME.glob("*.svg")} == set(drawn)
    for name, picture in drawn.items():
        assert (HOME / f"{name}.svg").read_text(encoding="utf-8") == picture, "run docs/drawings/draw.py"


@pytest.mark.parametrize("name", draw.failures())
def test_a_failure_is_of_its_kind(name: str) -> None:
    assert failure(*draw.failures()[name]) == name.replace("_", " ")


def test_every_drawing_is_shown() -> None:
    pages = "".join(
        (HOME.parent / name).read_text(encoding="utf-8")
        for name in ("how_it_works.md", "why_teams_fail.md", "real_robots.md")
    )
    drawings = {path.name for path in HOME.glob("*.svg")}
    assert drawings
    assert drawings == {name for name in drawings if f"](drawings/{name})" in pages}


def test_the_learning_curve_of_the_docs_belongs_to_the_recipe_of_its_caption() -> None:
    text = (HOME.parent / "tutorials" / "learning_curve.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    quick = RECIPES["quick"]
    assert set(rows[0]) == {field.name for field in fields(Round)}
    assert [int(row["updates"]) for row in rows] == [
        (r + 1) * (quick.updates_per_round or 0) for r in range(quick.rounds)
    ]
    assert (HOME.parent / "tutorials" / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
