"""Laws of instance sets: they round-trip, a change is noticed, and no file brings anything but a ValueError."""

import hashlib
import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import strategies
from mapf_env import Instance, instance_hash, load_instances, save_instances

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
