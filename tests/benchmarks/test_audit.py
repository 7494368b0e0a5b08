"""The audit finds wrong steps and passes right ones."""

from typing import Any

import numpy as np
import pytest

from audit import Options, audit_step, main

UP, LEFT, DOWN, RIGHT, IDLE = range(5)
RING = [(0, 0), (0, 1), (1, 1), (1, 0)]


def audited(before: Any, wanted: Any, after: Any, replaced: Any, grid: Any = ((0, 0, 0), (0, 0, 1))) -> tuple[int, int]:
    """Collisions and other faults of one step of one team."""
    tally = audit_step(
        np.array([grid], bool), np.array([before]), np.array([wanted]), np.array([after]), np.array([replaced])
    )
    return tally.collisions, tally.other_faults


@pytest.mark.parametrize(
    ("before", "wanted", "after", "replaced", "expected"),
    [
        ([(0, 0)], [RIGHT], [(0, 1)], [False], (0, 0)),
        ([(0, 0), (0, 1)], [RIGHT, RIGHT], [(0, 1), (0, 2)], [False, False], (0, 0)),
        (RING, [RIGHT, DOWN, LEFT, UP], [*RING[1:], RING[0]], [False] * 4, (0, 0)),
        ([(0, 0), (0, 1)], [RIGHT, LEFT], [(0, 0), (0, 1)], [True, True], (0, 0)),
        ([(0, 0), (0, 1)], [RIGHT, LEFT], [(0, 1), (0, 0)], [False, False], (1, 0)),
        ([(0, 0), (0, 2)], [RIGHT, LEFT], [(0, 1), (0, 1)], [False, False], (1, 0)),
        ([(0, 0), (0, 1)], [RIGHT, IDLE], [(0, 1), (0, 1)], [False, False], (1, 0)),
        ([(0, 0), (0, 2)], [RIGHT, LEFT], [(0, 0), (0, 2)], [True, True], (0, 2)),
        ([(0, 0)], [RIGHT], [(0, 0)], [True], (0, 1)),
        ([(0, 0)], [RIGHT], [(1, 0)], [True], (0, 2)),
        ([(0, 2)], [DOWN], [(1, 2)], [False], (0, 1)),
        ([(0, 0)], [UP], [(-1, 0)], [False], (0, 1)),
        ([(0, 0)], [UP], [(0, 0)], [True], (0, 0)),
        ([(0, 0)], [UP], [(0, 0)], [False], (0, 1)),
        ([(0, 0)], [RIGHT], [(0, 1)], [True], (0, 1)),
    ],
)
def test_the_audit_counts_faults(
    before: Any, wanted: Any, after: Any, replaced: Any, expected: tuple[int, int]
) -> None:
    assert audited(before, wanted, after, replaced) == expected


def test_the_audit_plays_teams_of_any_size(capsys: pytest.CaptureFixture[str]) -> None:
    """With 100,000 robots the dense graph of an observation would take 40 GB."""
    assert main(Options(steps=100_000, robots=(100_000,))) == 0
    assert "1000x1000" in capsys.readouterr().out


def test_the_audit_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(Options(steps=20_000, robots_at_once=64)) == 0
    assert "replaced" in capsys.readouterr().out
