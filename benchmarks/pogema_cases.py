"""The sets of POGEMA's benchmark: configuration, instances and what others have published on them.

A set is a folder: `NAME/NAME.yaml` is POGEMA's configuration, `NAME/maps.yaml` has its maps, and `NAME/instances.npz`,
which is optional, the instances to check against. `published.csv`, optional too, lies next to the sets.
"""

from __future__ import annotations

import csv
import re
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapf_env import Instance, PogemaMap, load_pogema_maps

MEASURES = ("CSR", "ISR", "SoC", "makespan", "throughput")
"""The columns of `published.csv` that hold results; a file need not have all of them."""


@dataclass(frozen=True)
class Case:
    """One instance of a set, as POGEMA names it."""

    map_name: str
    seed: int
    instance: Instance


@dataclass(frozen=True, eq=False)
class BenchmarkSet:
    """One set of the benchmark."""

    folder: Path
    maps: Mapping[str, PogemaMap]
    map_names: tuple[str, ...]
    seeds: tuple[int, ...]
    sizes: tuple[int, ...]
    """Robots in a team, in the order of the configuration."""
    max_steps: int
    """T, after which a case has failed."""

    @property
    def name(self) -> str:
        """The name of the folder."""
        return self.folder.name

    @classmethod
    def load(cls, folder: Path) -> BenchmarkSet:
        """Read the maps and the configuration of a set.

        Raises:
            ValueError: If a file is damaged, or the configuration is not one of the benchmark.
            OSError: If a file cannot be read.
        """
        path = folder / f"{folder.name}.yaml"
        found = re.search(r"^environment:\n((?:[ \t].*\n|\n)*)", path.read_text(encoding="utf-8") + "\n", re.MULTILINE)
        if found is None:
            raise ValueError(f"{path} has no block 'environment:'; give a configuration of POGEMA's benchmark")
        block = found.group(1)
        if _values(block, "on_target", path) != ["nothing"]:
            raise ValueError(f"{path}: on_target must be 'nothing', as in POGEMA's MAPF benchmark")
        maps, names = load_pogema_maps(folder / "maps.yaml"), tuple(_values(block, "map_name", path))
        missing = [name for name in names if name not in maps]
        if missing:
            raise ValueError(f"{path} names the map {missing[0]!r}, which {folder / 'maps.yaml'} does not have")
        (max_steps,) = _integers(block, "max_episode_steps", path, least=1)[:1]
        seeds, sizes = _integers(block, "seed", path, least=0), _integers(block, "num_agents", path, least=1)
        return cls(folder, maps, names, seeds, sizes, max_steps)

    def cases(self, num_agents: int) -> list[Case]:
        """Make the instances of one team size, maps in the order of the configuration, and check them if possible.

        Raises:
            ValueError: If a map has no room for the team, or `instances.npz` has other instances.
        """
        cases = [
            Case(name, seed, self._instance(name, num_agents, seed)) for name in self.map_names for seed in self.seeds
        ]
        reference = self.folder / "instances.npz"
        if reference.exists():
            _check(cases, num_agents, reference)
        return cases

    def _instance(self, map_name: str, num_agents: int, seed: int) -> Instance:
        try:
            return self.maps[map_name].instance(num_agents, seed)
        except ValueError as refusal:
            raise ValueError(f"{self.name}, map {map_name}, seed {seed}: {refusal}") from None


def load_sets(folder: Path, names: tuple[str, ...]) -> list[BenchmarkSet]:
    """The sets of these names in the benchmark's folder, all of them if no name is given.

    Raises:
        ValueError: If a set is not there or damaged.
        OSError: If a file cannot be read.
    """
    known = sorted(path.parent.name for path in folder.glob("*/maps.yaml"))
    if not known:
        raise ValueError(
            f"{folder} has no set of POGEMA's benchmark: give a folder with NAME/NAME.yaml and NAME/maps.yaml"
        )
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"{folder} has no set {unknown[0]!r}: choose among {', '.join(known)}")
    return [BenchmarkSet.load(folder / name) for name in names or known]


@dataclass(frozen=True)
class Published:
    """Means that others have published for one set, method and team size."""

    set_name: str
    source: str
    method: str
    num_agents: int
    results: Mapping[str, float]
    """The measures of `MEASURES` that are known."""


def load_published(path: Path) -> list[Published]:
    """Read published results; empty if there is no such file.

    Raises:
        ValueError: If the file is damaged; the message names the line.
    """
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        return [_published(row, f"{path}, line {rows.line_num}") for row in rows]


def _published(row: dict[str | Any, str | Any], where: str) -> Published:
    try:
        results = {name: float(row[name]) for name in MEASURES if row.get(name)}
        return Published(str(row["set"]), str(row["source"]), str(row["method"]), int(row["robots"]), results)
    except (KeyError, ValueError, TypeError) as damage:
        raise ValueError(
            f"{where}: expected set, source, method, robots and some of {', '.join(MEASURES)} "
            f"({type(damage).__name__}: {damage}); correct the line or remove the file"
        ) from None


def _values(block: str, key: str, path: Path) -> list[str]:
    """Return the values of a key of the configuration: one value, or the list of its grid search."""
    found = re.search(
        rf"^[ ]+{key}:[ ]*(?:\n[ ]+grid_search:\s*)?(\[[^\]]*\]|[^\s\[\]{{}}#]+)[ ]*$", block, re.MULTILINE
    )
    values = [value.strip("\"'") for value in re.split(r"[\s,]+", found.group(1).strip("[]"))] if found else []
    values = [value for value in values if value]
    if not values:
        raise ValueError(f"{path}: expected '{key}: VALUE' or '{key}:' with 'grid_search: [...]' under 'environment:'")
    return values


def _integers(block: str, key: str, path: Path, *, least: int) -> tuple[int, ...]:
    values = _values(block, key, path)
    for value in values:
        if not re.fullmatch("[0-9]{1,9}", value) or int(value) < least:
            raise ValueError(f"{path}: {key} must be whole numbers from {least}, got {value[:40]!r}")
    return tuple(map(int, values))


def _check(cases: list[Case], num_agents: int, path: Path) -> None:
    """Compare the instances with those of a file; a team size that it does not have is not checked."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            if f"N{num_agents}_starts" not in stored:
                return
            keys = ("map", "seed", "shape", "grids", "starts", "goals")
            columns = [stored[f"N{num_agents}_{key}"] for key in keys]
    except (ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as damage:
        raise ValueError(f"{path} is damaged or of another kind ({damage}): restore or remove it") from None
    if {len(column) for column in columns} != {len(cases)}:
        raise ValueError(f"{path} has other cases of {num_agents} robots than the configuration: restore or remove it")
    for case, differing in zip(cases, _differences(cases, columns), strict=True):
        if differing:
            raise ValueError(
                f"{path} has another {differing} for map {case.map_name}, seed {case.seed} and {num_agents} robots: "
                "maps, configuration and instances do not belong together, or NumPy shuffles in another way here"
            )


def _differences(cases: list[Case], columns: list[np.ndarray]) -> Iterator[str]:
    """Return the differences of each case; empty where there are none."""
    for case, name, seed, shape, grid, starts, goals in zip(cases, *columns, strict=True):
        found = case.instance
        height, width = found.grid.shape
        pairs = {
            "map name": str(name) == case.map_name,
            "seed": int(seed) == case.seed,
            "size": tuple(shape) == (height, width),
            "map": np.array_equal(grid[:height, :width], found.grid),
            "start": np.array_equal(starts, found.starts),
            "goal": np.array_equal(goals, found.goals),
        }
        yield next((word for word, equal in pairs.items() if not equal), "")
