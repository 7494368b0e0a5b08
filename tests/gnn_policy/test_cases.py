"""Cases: reproducible, the three splits without a common map, the same maps for teams of every size."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

import oracles
from gnn_policy.cases import Cases, Family, cases_of_files, make_cases
from mapf_env import Instance, random_instance, save_instances, save_map, save_scen

PLAIN = Family(height=(12, 12), width=(9, 9), num_agents=(4, 4), density=(0.2, 0.2))
SETTINGS = {"seed": 3, "maps": 40, "cases_per_map": 2, "families": [PLAIN]}
SPLITS = ("train", "validation", "test")
MIXED = [
    Family(height=(10, 14), width=(8, 16), num_agents=(3, 9), density=(0.1, 0.3), share=2.0),
    Family(style="walls", height=(12, 20), width=(12, 20), num_agents=(2, 5), density=(0.1, 0.2)),
    Family(
        style="maze", height=(9, 21), width=(9, 21), num_agents=(2, 6), corridor_width=(1, 2), loops=(0, 0.5), share=0.5
    ),
    Family(style="room", height=(12, 18), width=(12, 18), num_agents=(2, 6), room_size=(3, 6), share=0.5),
    Family(
        style="warehouse",
        height=(16, 24),
        width=(16, 30),
        num_agents=(8, 24),
        shelf_length=(3, 9),
        shelf_depth=(1, 3),
        corridor_width=(1, 3),
    ),
    Family(style="empty", height=(4, 4), width=(3, 8), num_agents=(1, 6), share=1.0),
]


def maps_of(cases: Cases) -> list[bytes]:
    return [each.grid.tobytes() for each in cases.instances]


def digest(cases: Cases) -> str:
    hashed = hashlib.blake2b(digest_size=8)
    for each in cases.instances:
        hashed.update(each.grid.tobytes() + each.starts.tobytes() + each.goals.tobytes())
    return hashed.hexdigest()


@pytest.mark.parametrize(
    ("changes", "styles", "split", "expected"),
    [
        ({}, ["cells"], "train", "9a901fb47fcd90fa"),
        ({}, ["cells"], "validation", "e91644c738792a83"),
        ({}, ["cells"], "test", "fe576655d4803f07"),
        ({"seed": 2**40, "num_agents": (9, 9)}, ["cells"], "train", "0a41e7512f046f3d"),
        ({"maps": 41}, ["cells", "walls"], "test", "87d8f99bba4a15bc"),
        (
            {"height": (20, 20), "width": (24, 24)},
            ["maze", "room", "warehouse", "empty", "walls"],
            "train",
            "e4ba34d101e0a274",
        ),
    ],
)
def test_settings_without_ranges_give_the_cases_that_the_published_policies_were_trained_on(
    changes, styles, split, expected
):
    """The hashes are from the version that made the packaged policies, which had no families."""
    of_maps = {name: value for name, value in changes.items() if name in SETTINGS}
    of_family = {name: value for name, value in changes.items() if name not in SETTINGS}
    families = [replace(PLAIN, style=style, **of_family) for style in styles]
    assert digest(make_cases(split, **{**SETTINGS, **of_maps, "families": families})) == expected


@pytest.mark.parametrize("families", [[PLAIN], [replace(PLAIN, style="walls")], MIXED[:4]])
def test_no_two_splits_or_seeds_share_a_random_map(families):
    seen = set()
    for seed in (0, 1, 2**40):
        for split in SPLITS:
            cases = make_cases(split, **{**SETTINGS, "families": families, "seed": seed})
            grids = {(grid.shape, grid.tobytes()) for grid in cases.grids}
            assert len(grids) == SETTINGS["maps"]
            assert not grids & seen
            seen |= grids


def test_cases_of_lifelong_families_are_told_apart():
    walls, lifelong = replace(PLAIN, style="walls"), replace(PLAIN, task="lifelong")
    cases = make_cases("train", **{**SETTINGS, "families": [walls, lifelong]})
    by_task = cases.by_task()
    assert set(by_task) == {"one_shot", "lifelong"}
    for number, (task, own) in enumerate(by_task.items()):
        assert own.grids is cases.grids
        assert (own.family_of == number).all()
        assert (own.lifelong == (task == "lifelong")).all()
        mine = cases.family_of == number
        assert own.instances == [case for case, chosen in zip(cases.instances, mine, strict=True) if chosen]
        assert np.array_equal(own.map_of, cases.map_of[mine])
    assert set(make_cases("train", **{**SETTINGS, "families": [walls]}).by_task()) == {"one_shot"}


def test_maps_take_turns_among_families_of_equal_shares():
    walls, cells = (replace(PLAIN, style=style) for style in ("walls", "cells"))
    both = maps_of(make_cases("train", **{**SETTINGS, "families": [walls, cells]}))
    of_walls, of_cells = (maps_of(make_cases("train", **{**SETTINGS, "families": [each]})) for each in (walls, cells))
    assert set(of_walls).isdisjoint(of_cells)
    assert both[0::4] + both[1::4] == of_walls[0::4] + of_walls[1::4]
    assert both[2::4] + both[3::4] == of_cells[2::4] + of_cells[3::4]
    assert maps_of(make_cases("train", **{**SETTINGS, "maps": 1, "families": [walls, cells]})) == of_walls[:2]


@pytest.mark.parametrize("shares", [(2, 1, 0.5, 0.5, 1, 1), (1, 1, 1, 1, 1, 1), (0.001, 5, 1, 1, 1, 3)])
def test_after_any_number_of_maps_every_family_has_its_share(shares):
    families = [replace(each, share=float(share)) for each, share in zip(MIXED, shares, strict=True)]
    cases = make_cases("train", **{**SETTINGS, "maps": 60, "families": families})
    wanted = np.array(shares) / sum(shares)
    turns = cases.family_of[:: SETTINGS["cases_per_map"]]
    for count in range(1, 61):
        given = np.bincount(turns[:count], minlength=len(shares))
        assert (np.abs(given - wanted * count) <= 1 + 1e-9).all(), count


def test_families_draw_sizes_densities_and_teams_within_their_ranges():
    cases = make_cases("train", **{**SETTINGS, "maps": 300, "cases_per_map": 3, "families": MIXED})
    assert len(cases) == 900
    assert len(cases.grids) == 300
    for family_number, family in enumerate(MIXED):
        own = np.flatnonzero(cases.family_of == family_number)
        assert len(own)
        instances = [cases.instances[i] for i in own]
        heights, widths = (sorted({each.grid.shape[axis] for each in instances}) for axis in (0, 1))
        robots = sorted({each.num_agents for each in instances})
        for found, (least, most) in ((heights, family.height), (widths, family.width), (robots, family.num_agents)):
            assert (found[0] >= least) & (found[-1] <= most)
        if family.style in ("cells", "walls"):
            shares = [each.grid.mean() for each in instances]
            assert min(shares) >= family.density[0] - 1e-9
            assert max(shares) <= family.density[1] + 0.5 / min(each.grid.size for each in instances) + 1e-9
            assert max(shares) - min(shares) > 0.5 * (family.density[1] - family.density[0]), "the range is used"
    # Both ends of a range are drawn, if there are enough maps.
    first = [each for each, family in zip(cases.instances, cases.family_of, strict=True) if family == 0]
    assert {each.grid.shape[0] for each in first} == set(range(10, 15))
    assert {each.num_agents for each in first} == set(range(3, 10))


def test_parts_of_mazes_rooms_and_warehouses_lie_within_their_ranges():
    def drawn(family):
        return [family.draw(seed) for seed in range(200)]

    for style, parts in (
        ("maze", ("corridor_width", "loops")),
        ("room", ("room_size",)),
        ("warehouse", ("shelf_length", "shelf_depth", "corridor_width")),
    ):
        family = Family(
            style=style,  # pyright: ignore[reportArgumentType]
            height=(5, 30),
            corridor_width=(2, 4),
            loops=(0.25, 0.75),
            room_size=(3, 8),
            shelf_length=(4, 9),
            shelf_depth=(1, 3),
        )
        for name in parts:
            values = [getattr(made, name) for _, _, _, made in drawn(family)]
            least, most = getattr(family, name)
            if isinstance(least, int):
                assert set(values) == set(range(least, most + 1)), name
            else:
                assert least <= min(values) < least + 0.1, name
                assert most - 0.1 < max(values) <= most, name
        assert all(density == 0 for _, _, density, _ in drawn(family)), "these styles have their own obstacles"


def test_a_team_that_would_crowd_a_map_is_made_smaller_but_not_below_the_least():
    crowded = Family(style="empty", height=(4, 4), width=(3, 8), num_agents=(1, 30))
    cases = make_cases("train", **{**SETTINGS, "maps": 80, "families": [crowded]})
    sizes = [(each.num_agents, each.grid.size) for each in cases.instances]
    assert all(robots <= cells // 2 for robots, cells in sizes)
    assert any(robots == cells // 2 for robots, cells in sizes)
    full = replace(crowded, num_agents=(9, 9))
    assert {each.num_agents for each in make_cases("train", **{**SETTINGS, "families": [full]}).instances} == {9}


def test_every_case_of_every_family_is_a_problem_with_a_way_for_each_robot():
    cases = make_cases("validation", **{**SETTINGS, "families": MIXED})
    for number, case in enumerate(cases.instances):
        assert np.array_equal(case.grid, cases.grids[cases.map_of[number]])
        for start, goal in zip(oracles.cells(case.starts), oracles.cells(case.goals), strict=True):
            assert start in oracles.distances(case.grid, goal)
            assert start != goal


def test_equal_settings_give_equal_cases():
    for families in ([PLAIN], MIXED):
        one, two = (make_cases("test", **{**SETTINGS, "families": families}) for _ in range(2))
        assert one.instances == two.instances
        assert one.map_of.tolist() == two.map_of.tolist()


def test_cases_come_map_after_map_and_all_differ():
    cases = make_cases("train", **SETTINGS)
    assert len(cases) == 80
    assert len(set(cases.instances)) == 80
    assert cases.map_of.tolist() == [number // 2 for number in range(80)]
    grids = maps_of(cases)
    assert grids[0::2] == grids[1::2]
    for case in cases.instances:
        assert case.num_agents == 4
        assert case.grid.shape == (12, 9)
        assert case.grid.sum() == round(0.2 * 12 * 9)
        assert not (case.starts == case.goals).all(axis=1).any()


@pytest.mark.parametrize("families", [[PLAIN], MIXED])
def test_teams_of_all_sizes_meet_the_same_maps(families):
    grids = [
        maps_of(make_cases("test", **{**SETTINGS, "families": [replace(each, num_agents=(n, n)) for each in families]}))
        for n in (1, 2, 5)
    ]
    assert grids[0] == grids[1] == grids[2]


@pytest.mark.parametrize("families", [[PLAIN], MIXED])
def test_more_maps_or_cases_keep_the_first_ones(families):
    settings = {**SETTINGS, "families": families}
    few = make_cases("test", **settings).instances
    assert make_cases("test", **{**settings, "maps": 50}).instances[:80] == few
    more = make_cases("test", **{**settings, "cases_per_map": 3}).instances
    assert [more[3 * (i // 2) + i % 2] for i in range(80)] == few


@pytest.mark.parametrize(
    "wrong",
    [
        {"maps": 0},
        {"cases_per_map": 0},
        {"families": []},
        {"families": [replace(PLAIN, density=(1.0, 1.0))]},
        {"families": [replace(PLAIN, density=(0.99, 0.99))]},
        {"families": [replace(PLAIN, num_agents=(100, 100))]},
        {"families": [PLAIN, replace(PLAIN, num_agents=(100, 200))]},
    ],
)
def test_settings_without_room_are_refused(wrong):
    with pytest.raises(ValueError, match=r"\w+ \w+"):
        make_cases("train", **{**SETTINGS, **wrong})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("height", (9, 8)),
        ("height", (0, 8)),
        ("width", (5,)),
        ("width", (5, 6, 7)),
        ("num_agents", (0, 4)),
        ("density", (0.3, 0.2)),
        ("density", (-0.1, 0.2)),
        ("density", (0.1, 1.1)),
        ("loops", (0.0, float("nan"))),
        ("corridor_width", (0, 1)),
        ("room_size", (4, 3)),
        ("shelf_length", (0, 0)),
        ("shelf_depth", (-1, 2)),
        ("share", 0.0),
        ("share", float("inf")),
        ("style", "forest"),
    ],
)
def test_a_family_out_of_range_is_refused_by_the_name_of_its_setting(name, value):
    with pytest.raises(ValueError, match=name):
        Family(**{name: value})


@pytest.mark.parametrize(("name", "value"), [("height", 8), ("height", (8.5, 9.0)), ("density", ("0.1", "0.2"))])
def test_a_family_of_wrong_types_is_refused_by_the_name_of_its_setting(name, value):
    with pytest.raises(TypeError, match=name):
        Family(**{name: value})


def test_the_maps_of_one_run_are_of_the_seed_and_not_of_the_cases():
    alone = make_cases("train", **{**SETTINGS, "cases_per_map": 1}).instances
    assert np.array_equal(alone[7].grid, make_cases("train", **SETTINGS).instances[14].grid)


def of_files(split: str, *files: object, **settings: int) -> Cases:
    chosen = {"seed": 5, "cases_per_map": 4, "num_agents": 3, **settings}
    return cases_of_files(split, [str(each) for each in files], **chosen)  # pyright: ignore[reportArgumentType]


def identity(case: Instance) -> tuple[bytes, bytes, bytes]:
    return case.grid.tobytes(), case.starts.tobytes(), case.goals.tobytes()


@pytest.mark.parametrize("count", [3, 12, 25])
def test_files_of_three_maps_or_more_are_split_by_map(tmp_path, count):
    for number in range(count):
        save_map(tmp_path / f"{number:02}.map", random_instance(height=7, width=8, density=0.2, seed=number).grid)
    splits = {split: of_files(split, tmp_path) for split in SPLITS}
    grids = {split: {case.grid.tobytes() for case in cases.instances} for split, cases in splits.items()}
    held_out = max(count // 10, 1)
    assert [len(grids[split]) for split in SPLITS] == [count - 2 * held_out, held_out, held_out]
    assert len(set.union(*grids.values())) == count, "no map is in two splits, none is left out"
    for cases in splits.values():
        assert len(cases) == 4 * len({case.grid.tobytes() for case in cases.instances})
        assert len(set(map(identity, cases.instances))) == len(cases)
        for case, number in zip(cases.instances, cases.map_of, strict=True):
            assert np.array_equal(case.grid, cases.grids[number])
            assert case.num_agents == 3


def test_one_map_is_shared_by_the_splits_but_no_starts_and_goals(tmp_path):
    save_map(tmp_path / "own.map", random_instance(height=7, width=8, density=0.2, seed=1).grid)
    splits = [of_files(split, tmp_path / "own.map") for split in SPLITS]
    drawn = [set(map(identity, cases.instances)) for cases in splits]
    assert [len(each) for each in drawn] == [4, 4, 4]
    assert len(set.union(*drawn)) == 12
    assert of_files("train", tmp_path / "own.map").instances == splits[0].instances
    assert of_files("train", tmp_path / "own.map", seed=6).instances != splits[0].instances


def test_instances_on_one_map_are_split_by_starts_and_goals(tmp_path):
    grid = random_instance(height=9, width=9, density=0.1, seed=0).grid
    instances = [random_instance(grid=grid, num_agents=2 + seed % 3, seed=seed) for seed in range(20)]
    save_instances(tmp_path / "set.json", instances)
    found = [of_files(split, tmp_path / "set.json").instances for split in SPLITS]
    assert [len(each) for each in found] == [16, 2, 2]
    assert [*found[0], *found[1], *found[2]] == instances


def test_scenarios_of_one_folder_meet_on_their_map(tmp_path):
    grid = random_instance(height=9, width=9, density=0.1, seed=0).grid
    save_map(tmp_path / "own.map", grid)
    instances = [random_instance(grid=grid, num_agents=3, seed=seed) for seed in range(3)]
    for number, each in enumerate(instances):
        save_scen(tmp_path / f"{number}.scen", each, tmp_path / "own.map")
    found = [of_files(split, tmp_path).instances for split in SPLITS]
    assert found == [[instances[0]], [instances[1]], [instances[2]]]


def test_files_that_leave_a_split_without_a_case_are_refused_with_what_to_give(tmp_path):
    save_instances(tmp_path / "two.json", [random_instance(height=5, width=5, num_agents=2, seed=0)])
    with pytest.raises(ValueError, match=r"two\.json leave no case for the train split: give more instances, or maps"):
        of_files("train", tmp_path / "two.json")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="empty has no maps"):
        of_files("train", tmp_path / "empty")
    (tmp_path / "broken.map").write_text("type octile\n")
    with pytest.raises(ValueError, match=r"broken\.map"):
        of_files("train", tmp_path / "broken.map")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.map"):
        of_files("train", tmp_path / "nowhere.map")
    save_map(tmp_path / "tiny.map", np.zeros((1, 3), bool))
    with pytest.raises(ValueError, match="agents"):
        of_files("train", tmp_path / "tiny.map", num_agents=9)
