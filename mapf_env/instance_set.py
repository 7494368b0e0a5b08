"""Sets of instances in one file, with a hash of each, so that everybody can tell that they play the same.

The file is JSON: `{"format": "mapf-instances", "version": 1, "maps": [...], "instances": [...]}`. A map is a list of
its rows as text, `.` free and `@` obstacle. An instance is `{"map": index, "starts": [[row, col], ...], "goals": [...],
"sha256": ...}`. The hash is SHA-256 over the text `H W N`, a line feed, the rows of the map, each with a line feed, and
for each robot `start_row start_col goal_row goal_col` with a line feed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from mapf_env import arguments
from mapf_env.files import PathLike, as_path, write_whole
from mapf_env.instance import Instance, Obstacles

_FORMAT = "mapf-instances"
_FIELDS = ("map", "starts", "goals", "sha256")


def instance_hash(instance: Instance) -> str:
    """The SHA-256 of an instance, in hexadecimal digits; equal problems have equal hashes on every machine.

    Raises:
        TypeError: If it is no instance.
    """
    arguments.instance_of(instance, Instance, "instance")
    height, width = instance.grid.shape
    lines = [f"{height} {width} {instance.num_agents}", *_rows(instance.grid)]
    ends = np.concatenate([instance.starts, instance.goals], axis=1).tolist()
    lines += [" ".join(map(str, robot)) for robot in ends]
    return hashlib.sha256("".join(f"{line}\n" for line in lines).encode()).hexdigest()


def save_instances(path: PathLike, instances: Sequence[Instance]) -> None:
    """Write the instances to one file, as a whole or not at all; a map that several share is written once.

    Raises:
        TypeError: If an argument has the wrong type.
        OSError: If the file cannot be written; an existing one is then unchanged.
    """
    maps: dict[tuple[str, ...], int] = {}
    entries = [
        {
            "map": maps.setdefault(tuple(_rows(instance.grid)), len(maps)),
            "starts": instance.starts.tolist(),
            "goals": instance.goals.tolist(),
            "sha256": instance_hash(instance),
        }
        for instance in arguments.each_of(instances, Instance, "instances")
    ]
    head = json.dumps({"format": _FORMAT, "version": 1, "maps": list(maps)})
    lines = ",\n".join(json.dumps(entry, separators=(",", ":")) for entry in entries)
    write_whole(path, f'{head[:-1]}, "instances": [\n{lines}\n]}}\n')


def load_instances(path: PathLike) -> list[Instance]:
    """Read what `save_instances` wrote and check every hash.

    Raises:
        ValueError: If the file is damaged or an instance is not what its hash says; the message names it.
        OSError: If the file cannot be read.
    """
    try:
        content = json.loads(as_path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no set of instances: {error}") from None
    if not isinstance(content, dict) or content.get("format") != _FORMAT or content.get("version") != 1:
        raise ValueError(f'{path} is no set of instances: expected "format": "{_FORMAT}" and "version": 1')
    maps, entries = content.get("maps"), content.get("instances")
    if not isinstance(maps, list) or not isinstance(entries, list):
        raise ValueError(f'{path} is no set of instances: expected the lists "maps" and "instances"')
    grids = [_grid(path, number, rows) for number, rows in enumerate(maps)]
    return [_instance(path, number, entry, grids) for number, entry in enumerate(entries)]


def _rows(grid: Obstacles) -> list[str]:
    return ["".join(row) for row in np.where(grid, "@", ".")]


def _grid(path: PathLike, number: int, rows: Any) -> Obstacles:
    sound = isinstance(rows, list) and rows and all(isinstance(row, str) for row in rows)
    if not sound or not rows[0] or any(len(row) != len(rows[0]) or set(row) - {".", "@"} for row in rows):
        raise ValueError(f"{path}, map {number}: expected rows of equal length of . and @")
    return np.array([[cell == "@" for cell in row] for row in rows])


def _instance(path: PathLike, number: int, entry: Any, grids: list[Obstacles]) -> Instance:
    missing = [name for name in _FIELDS if not isinstance(entry, dict) or name not in entry]
    if missing:
        raise ValueError(f"{path}, instance {number}: {' and '.join(missing)} missing; write the set anew")
    try:
        chosen = entry["map"]
        if type(chosen) is not int or not 0 <= chosen < len(grids):
            raise ValueError(f"there is no map {chosen!r}")
        instance = Instance(grids[chosen], entry["starts"], entry["goals"])
        if instance_hash(instance) != entry["sha256"]:
            raise ValueError("it is not what its hash says; the file was changed")
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}, instance {number}: {error}") from error
    return instance
