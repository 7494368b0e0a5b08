"""The table of lifelong play."""

import re
from pathlib import Path

import numpy as np
import pytest

import lifelong
import oracles
from mapf_env import random_map, save_map


def test_later_goals_are_cells_that_the_robot_can_reach() -> None:
    grid = random_map(height=9, width=9, density=0.4, seed=3)
    instance, goals = lifelong.problem(grid, 5, 40, 0)
    assert goals.shape == (5, 40, 2)
    for start, own in zip(oracles.cells(instance.starts), goals, strict=True):
        assert {*oracles.cells(own)} <= {*oracles.distances(grid, start)}
    again, same = lifelong.problem(grid, 5, 40, 0)
    assert (again, same.tolist()) == (instance, goals.tolist())


def test_each_map_and_method_has_a_throughput(tmp_path: Path, capsys, monkeypatch) -> None:
    save_map(tmp_path / "hall.map", np.zeros((6, 6), bool))
    monkeypatch.setattr(lifelong, "MOVINGAI", {"hall": 3})
    monkeypatch.setattr(lifelong, "RANDOM", {"rooms": lifelong.RANDOM["rooms"]})
    lifelong.main(lifelong.Options(tmp_path, methods=("pibt", "rolling,20"), cases=2, steps=30))
    head, _, rooms, hall = [line for line in capsys.readouterr().out.splitlines() if line]
    assert head == "| map, robots | pibt | rolling,20 |"
    cell = r"(\d\.\d\d) \[[-\d.]+, [\d.]+\], [\d.]+ ms"
    for name, row in (("rooms, 64", rooms), ("hall, 3", hall)):
        found = re.fullmatch(rf"\| {name} \| {cell} \| {cell} \|", row)
        assert found is not None, row
        assert min(map(float, found.groups())) > 0.3


def test_numbers_that_make_no_table_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 1, got 0 and 256"):
        lifelong.main(lifelong.Options(cases=0))
    with pytest.raises(ValueError, match="lacam plans to the end"):
        lifelong.main(lifelong.Options(methods=("lacam",), cases=1, steps=1))
