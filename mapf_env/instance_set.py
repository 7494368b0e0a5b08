"""Sets of instances in one file, with a hash of each, so that different users can check that they have the same ones.

The file is JSON: `{"format": "mapf-instances", "version": 1, "maps": [...], "instances": [...]}`. A map is a list of
its rows as text, `.` free and `@` obstacle. An instance is `{"map": index, "starts": [[row, col], ...], "goals": [...],
"sha256": ...}`. The hash is SHA-256 over the text `H W N`, a line feed, the rows of the map, each with a line feed, and
for each robot `start_row start_col goal_row goal_col` with a line feed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from mapf_env import arguments
from mapf_env.files import PathLike, read_text, write_whole
from mapf_env.instance import Instance, Obstacles, SharedMap

_FORMAT = "mapf-instances"
_FIELDS = ("map", "starts", "goals", "sha256")


def instance_hash(instance: Instance) -> str:
    """Return the SHA-256 of an instance, in hexadecimal digits; equal problems have equal hashes on every machine.

    Raises:
        TypeError: If `instance` is not an `Instance`.
    """
    return _hash(arguments.instance_of(instance, Instance, "instance"))


def save_instances(path: PathLike, instances: Iterable[Instance]) -> None:
    """Write the instances to one file, as a whole or not at all; a map that several share is written once.

    Raises:
        TypeError: If an argument has the wrong type.
        OSError: If the file cannot be written; an existing one is then unchanged.
    """
    maps: dict[SharedMap, int] = {}
    entries = [
        json.dumps(
            {
                "map": maps.setdefault(instance.shared_map, len(maps)),
                "starts": instance.starts.tolist(),
                "goals": instance.goals.tolist(),
                "sha256": _hash(instance),
            },
            separators=(",", ":"),
        )
        for instance in arguments.each_of(instances, Instance, "instances")
    ]
    head = json.dumps({"format": _FORMAT, "version": 1, "maps": [_text(each.grid).split() for each in maps]})
    lines = ",\n".join(entries)
    write_whole(path, f'{head[:-1]}, "instances": [\n{lines}\n]}}\n')


def load_instances(path: PathLike) -> list[Instance]:
    """Read what `save_instances` wrote and check every hash.

    Raises:
        ValueError: If the file is damaged or an instance is not what its hash says; the message names it.
        OSError: If the file cannot be read.
    """
    found = InstanceSet(path)
    for number in range(len(found.maps)):
        found.map(number)
    return [found.instance(number) for number in range(len(found))]


class InstanceSet:
    """A file of `save_instances` whose maps and instances are built on demand.

    Raises:
        ValueError: If it is not a set of instances.
        OSError: If it cannot be read.
    """

    def __init__(self, path: PathLike) -> None:
        self._path = path
        try:
            content = json.loads(read_text(path))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path} is not a set of instances: {error}") from None
        if not isinstance(content, dict) or content.get("format") != _FORMAT or content.get("version") != 1:
            raise ValueError(f'{path} is not a set of instances: expected "format": "{_FORMAT}" and "version": 1')
        maps, entries = content.get("maps"), content.get("instances")
        if not isinstance(maps, list) or not isinstance(entries, list):
            raise ValueError(f'{path} is not a set of instances: expected the lists "maps" and "instances"')
        self.maps: list[Any] = maps
        self._entries: list[Any] = entries
        self._built: dict[int, SharedMap] = {}

    def __len__(self) -> int:
        return len(self._entries)

    def map(self, number: int) -> SharedMap:
        """Return the map of that number.

        Raises:
            ValueError: If it is damaged.
        """
        if number not in self._built:
            self._built[number] = SharedMap.of(_grid(self._path, number, self.maps[number]))
        return self._built[number]

    def instance(self, number: int) -> Instance:
        """Return the instance of that number.

        Raises:
            ValueError: If it is damaged, or is not what its hash says.
        """
        entry: Any = self._entries[number]
        missing = [name for name in _FIELDS if not isinstance(entry, dict) or name not in entry]
        if missing:
            raise ValueError(f"{self._path}, instance {number}: {' and '.join(missing)} missing; write the set again")
        chosen = entry["map"]
        if type(chosen) is not int or not 0 <= chosen < len(self.maps):
            raise ValueError(f"{self._path}, instance {number}: there is no map {chosen!r}")
        shared = self.map(chosen)
        try:
            instance = Instance(shared, entry["starts"], entry["goals"])
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{self._path}, instance {number}: {error}") from error
        if _hash(instance) != entry["sha256"]:
            raise ValueError(f"{self._path}, instance {number}: it is not what its hash says; the file was changed")
        return instance


_BEGUN: WeakKeyDictionary[SharedMap, dict[int, Any]] = WeakKeyDictionary()
"""The hash up to the end of the map, by map and number of robots; the hash of an instance continues from there."""


def _hash(instance: Instance) -> str:
    begun = _BEGUN.setdefault(instance.shared_map, {})
    robots, (height, width) = instance.num_agents, instance.grid.shape
    if robots not in begun:
        begun[robots] = hashlib.sha256(f"{height} {width} {robots}\n{_text(instance.grid)}".encode("ascii"))
    ends = np.concatenate([instance.starts, instance.goals], axis=1).tolist()
    found = begun[robots].copy()
    found.update(
        "".join(f"{row} {col} {goal_row} {goal_col}\n" for row, col, goal_row, goal_col in ends).encode("ascii")
    )
    return found.hexdigest()


def _text(grid: Obstacles) -> str:
    """Return the rows of a map as text, each with a line feed."""
    height, width = grid.shape
    characters = np.full((height, width + 1), ord("\n"), np.uint8)
    characters[:, :width] = np.where(grid, np.uint8(ord("@")), np.uint8(ord(".")))
    return characters.tobytes().decode("ascii")


def _grid(path: PathLike, number: int, rows: Any) -> Obstacles:
    sound = isinstance(rows, list) and rows and all(isinstance(row, str) for row in rows)
    text = "".join(rows) if sound else ""
    if not text or any(len(row) != len(rows[0]) for row in rows) or text.strip(".@"):
        raise ValueError(f"{path}, map {number}: expected rows of equal length of . and @")
    return np.frombuffer(text.encode("ascii"), np.uint8).reshape(len(rows), -1) == ord("@")
