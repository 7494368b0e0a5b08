"""Instance sets: they round-trip, a change is noticed, and no file brings anything but a ValueError."""

import hashlib
import json
import pickle
import tracemalloc
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import strategies
from mapf_env import Instance, instance_hash, instance_set, load_instances, save_instances
from mapf_env.instance_set import InstanceSet

SLOW = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)


@given(st.lists(strategies.instances(), max_size=5))
@SLOW
def test_sets_round_trip(tmp_path: Path, instances: list[Instance]) -> None:
    save_instances(tmp_path / "set.json", instances)
    assert load_instances(tmp_path / "set.json") == instances


def test_the_hash_is_the_documented_one() -> None:
    instance = Instance(np.array([[0, 1], [0, 0]], bool), [[0, 0]], [[1, 1]])
    assert instance_hash(instance) == hashlib.sha256(b"2 2 1\n.@\n..\n0 0 1 1\n").hexdigest()


@given(strategies.instances(), strategies.instances())
def test_equal_hashes_mean_equal_problems(one: Instance, other: Instance) -> None:
    assert (instance_hash(one) == instance_hash(other)) == (one == other)


def test_a_change_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "set.json"
    save_instances(path, [Instance(np.zeros((2, 2), bool), [[0, 0]], [[1, 1]])])
    content = json.loads(path.read_text())
    content["instances"][0]["goals"] = [[0, 1]]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="instance 0: it is not what its hash says"):
        load_instances(path)


def test_a_set_is_read_whatever_editor_saved_it(tmp_path: Path) -> None:
    path, instance = tmp_path / "set.json", Instance(np.eye(2, dtype=bool), [[0, 1]], [[0, 1]])
    save_instances(path, [instance])
    text = path.read_text()
    for content in (
        ("\ufeff" + text).encode(),
        text.encode("utf-16"),
        text.replace("\n", "\r\n").encode(),
        json.dumps(json.loads(text), indent=4).encode(),
    ):
        path.write_bytes(content)
        assert load_instances(path) == [instance]


def test_instances_on_one_map_share_it(tmp_path: Path) -> None:
    """One grid, one table of regions and one text for each map, however many instances there are."""
    grid = np.zeros((300, 400), bool)
    instances = [Instance(grid.copy(), [[k, k]], [[k, k + 1]]) for k in range(200)]
    tracemalloc.start()
    save_instances(tmp_path / "set.json", (each for each in instances))
    loaded = load_instances(tmp_path / "set.json")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert loaded == instances
    assert len({id(each.grid) for each in [*loaded, *instances, pickle.loads(pickle.dumps(instances[0]))]}) == 1
    assert len(json.loads((tmp_path / "set.json").read_text())["maps"]) == 1
    assert peak < 8e6, "the text of one map, and a list of instances"


def test_one_instance_of_a_set_is_built_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    instances = [Instance(np.zeros((2, k + 2), bool), [[0, 0]], [[1, k]]) for k in range(5)]
    save_instances(tmp_path / "set.json", instances)
    made: list[int] = []
    monkeypatch.setattr(instance_set, "_grid", lambda *asked: made.append(asked[1]) or np.zeros((2, 5), bool))
    assert InstanceSet(tmp_path / "set.json").instance(3) == instances[3]
    assert made == [3]


@given(st.data())
@SLOW
def test_damaged_files_are_refused_or_read(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "set.json"
    save_instances(path, [Instance(np.zeros((2, 3), bool), [[0, 0], [0, 1]], [[1, 1], [1, 2]])] * 2)
    whole = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(whole) - 1))
        kind = data.draw(st.integers(0, 2))
        if kind == 0:
            whole[at] = data.draw(st.integers(0, 255))
        elif kind == 1:
            del whole[at : at + data.draw(st.integers(1, 30))]
        else:
            whole[at:at] = data.draw(st.binary(max_size=5))
        if not whole:
            break
    path.write_bytes(bytes(whole))
    with suppress(ValueError):
        load_instances(path)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["map", "starts", "goals", "sha256"]), inner)
    ),
    max_leaves=12,
)


@given(json_values, json_values)
@SLOW
def test_any_json_is_refused_or_read(tmp_path: Path, maps: object, instances: object) -> None:
    path = tmp_path / "set.json"
    content = {"format": "mapf-instances", "version": 1, "maps": maps, "instances": instances}
    path.write_text(json.dumps(content))
    with suppress(ValueError):
        load_instances(path)
