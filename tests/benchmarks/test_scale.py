"""The table of the scale benchmark: what is measured is kept, and what is kept is not measured again."""

from pathlib import Path

import pytest

import scale


def test_measurements_are_kept_in_order_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table, figure = tmp_path / "scale.csv", tmp_path / "scale.png"
    rows = [scale.measure("pibt", 60, 1, 0, 1), scale.measure("environment", 200, 1, 0, 1)]
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


def test_every_bar_is_judged_by_its_measurements() -> None:
    def row(kind: str, robots: int, **figures: float) -> scale.Row:
        sound = {"reset_seconds": 0.1, "step_microseconds": 1.0, "step_seconds": 0.01, "bytes_per_robot": 1.0}
        memory = {"peak_mib": 9_000.0, "first_mib": 5_000.0, "last_mib": 5_001.0}
        return scale.Row(kind, robots, 9, 9, 100, **(sound | memory | figures))

    sound = [
        row("environment", 1_000),
        row("environment", 100_000, step_microseconds=1.5),
        row("policy", 1_000),
        row("policy with the map", 1_000, step_seconds=0.019),
        row("policy with the map", 10_000, step_seconds=0.9),
        row("policy", 1_000_000),
    ]
    wrong = [
        row("environment", 1_000),
        row("environment", 100_000, step_microseconds=1.6),
        row("policy", 1_000, step_seconds=0.021),
        row("policy with the map", 1_000, step_seconds=0.03),
        row("policy with the map", 10_000, step_seconds=1.1),
        row("policy", 1_000_000, peak_mib=12_000.0),
    ]
    for rows, answer in ((sound, "yes"), (wrong, "no"), ([], "")):
        assert list(scale.bars(rows).columns[2].cells) == [answer] * 5
    assert "policy, 1,000,000 robots" in str(list(scale.bars(sound[:-1]).columns[1].cells)[-1])
