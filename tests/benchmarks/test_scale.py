"""The table of the scale benchmark: what is measured is kept, and what is kept is not measured again."""

from pathlib import Path

import pytest

import scale


def test_measurements_are_kept_in_order_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table, figure = tmp_path / "scale.csv", tmp_path / "scale.png"
    rows = [scale.measure("pibt", 60, 1, 0), scale.measure("environment", 200, 1, 0)]
    scale.write(table, rows)
    assert scale.read(table) == rows[::-1]
    assert [(row.robots, row.height, row.width) for row in rows] == [(60, 25, 25), (200, 46, 46)]
    assert all(row.step_microseconds > 0 and row.peak_mib > 0 for row in rows)

    def measured_again(*_: object) -> None:
        raise AssertionError("all of it is in the table")

    monkeypatch.setattr(scale, "measure", measured_again)
    options = scale.Options(
        robots=(60,), kinds=("pibt", "policy with the map"), most_with_map=50, table=table, figure=figure
    )
    scale.main(options)
    assert scale.read(table) == rows[::-1]
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_a_table_of_another_benchmark_is_refused(tmp_path: Path) -> None:
    table = tmp_path / "other.csv"
    table.write_text("a,b\n1,2\n", encoding="utf-8")
    with pytest.raises(ValueError, match="must have the columns kind, robots"):
        scale.read(table)
