"""Cases: reproducible, the three splits without a common map, the same maps for teams of every size."""

import numpy as np
import pytest

from gnn_policy.cases import make_cases

SETTINGS = {
    "seed": 3,
    "maps": 40,
    "cases_per_map": 2,
    "num_agents": 4,
    "height": 12,
    "width": 9,
    "density": 0.2,
    "styles": ["cells"],
}
SPLITS = ("train", "validation", "test")


def maps_of(cases):
    return [each.grid.tobytes() for each in cases]


@pytest.mark.parametrize("style", ["cells", "walls"])
def test_no_two_splits_or_seeds_share_a_map(style):
    seen = set()
    for seed in (0, 1, 2**40):
        for split in SPLITS:
            grids = set(maps_of(make_cases(split, **{**SETTINGS, "styles": [style], "seed": seed})))
            assert len(grids) == SETTINGS["maps"]
            assert not grids & seen
            seen |= grids


def test_maps_take_turns_among_the_styles():
    both = maps_of(make_cases("train", **{**SETTINGS, "styles": ["walls", "cells"]}))
    walls, cells = (maps_of(make_cases("train", **{**SETTINGS, "styles": [style]})) for style in ("walls", "cells"))
    assert set(walls).isdisjoint(cells)
    assert both[0::4] + both[1::4] == walls[0::4] + walls[1::4]
    assert both[2::4] + both[3::4] == cells[2::4] + cells[3::4]
    assert maps_of(make_cases("train", **{**SETTINGS, "maps": 1, "styles": ["walls", "cells"]})) == walls[:2]


def test_equal_settings_give_equal_cases():
    assert make_cases("test", **SETTINGS) == make_cases("test", **SETTINGS)


def test_cases_come_map_after_map_and_all_differ():
    cases = make_cases("train", **SETTINGS)
    assert len(cases) == 80
    assert len(set(cases)) == 80
    grids = maps_of(cases)
    assert grids[0::2] == grids[1::2]
    for case in cases:
        assert case.num_agents == 4
        assert case.grid.shape == (12, 9)
        assert case.grid.sum() == round(0.2 * 12 * 9)
        assert not (case.starts == case.goals).all(axis=1).any()


def test_teams_of_all_sizes_meet_the_same_maps():
    grids = [maps_of(make_cases("test", **{**SETTINGS, "num_agents": n})) for n in (1, 2, 9)]
    assert grids[0] == grids[1] == grids[2]


def test_more_maps_or_cases_keep_the_first_ones():
    few = make_cases("test", **SETTINGS)
    assert make_cases("test", **{**SETTINGS, "maps": 50})[:80] == few
    more = make_cases("test", **{**SETTINGS, "cases_per_map": 3})
    assert [more[3 * (i // 2) + i % 2] for i in range(80)] == few


@pytest.mark.parametrize(
    "wrong",
    [{"maps": 0}, {"cases_per_map": 0}, {"density": 1.0}, {"density": 0.99}, {"num_agents": 100}, {"styles": []}],
)
def test_settings_without_room_are_refused(wrong):
    with pytest.raises(ValueError, match=r"\w+ \w+"):
        make_cases("train", **{**SETTINGS, **wrong})


def test_the_maps_of_one_run_are_of_the_seed_and_not_of_the_cases():
    alone = make_cases("train", **{**SETTINGS, "cases_per_map": 1})
    assert np.array_equal(alone[7].grid, make_cases("train", **SETTINGS)[14].grid)
