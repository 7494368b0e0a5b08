"""Read every MovingAI map and scenario of a folder, write each one, and read that again; exit with 1 if one fails.

Without a folder, time many cases on one map of 656x1491 cells, and print the peak memory of the process.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from mapf_env import load_instances, load_map, load_scen, random_instance, save_instances, save_map, save_scen


def round_trip(path: Path, folder: Path) -> int:
    """Read, write and read the file again; the cells of a map or the agents of a scenario."""
    if path.suffix == ".map":
        grid = load_map(path)
        save_map(folder / "a.map", grid)
        if not np.array_equal(load_map(folder / "a.map"), grid):
            raise ValueError(f"{path} is another map after it was written and read")
        return grid.size
    instance = load_scen(path)
    save_map(folder / "a.map", instance.grid)
    save_scen(folder / "a.scen", instance, folder / "a.map")
    save_instances(folder / "a.json", [instance])
    if load_scen(folder / "a.scen") != instance or load_instances(folder / "a.json") != [instance]:
        raise ValueError(f"{path} is another instance after it was written and read")
    return instance.num_agents


def many_cases(folder: Path, height: int = 656, width: int = 1491, sets: int = 100, scenarios: int = 1000) -> None:
    """Print how long it takes to write and read cases of ten robots on one map."""
    rng = np.random.default_rng(0)
    grid = rng.random((height, width)) < 0.2
    instances = [random_instance(grid=grid, num_agents=10, seed=seed) for seed in range(sets)]
    save_map(folder / "a.map", grid)
    for number, instance in enumerate(instances):
        save_scen(folder / f"{number}.scen", instance, folder / "a.map")
    began = time.perf_counter()
    save_instances(folder / "set.json", instances)
    saved = time.perf_counter()
    load_instances(folder / "set.json")
    loaded = time.perf_counter()
    size = (folder / "set.json").stat().st_size / 2**20
    print(f"{sets} instances: saved in {saved - began:.3f} s, loaded in {loaded - saved:.3f} s, {size:.2f} MiB")
    began = time.perf_counter()
    cases = [load_scen(folder / f"{number % sets}.scen") for number in range(scenarios)]
    print(f"{len(cases)} scenarios: loaded in {time.perf_counter() - began:.2f} s")
    if sys.platform != "win32":
        import resource

        unit = 2**20 if sys.platform == "darwin" else 2**10
        print(f"peak memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit:.0f} MiB")


def main() -> None:
    """Go through a folder, or time many cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help="searched with all its subfolders")
    folder = parser.parse_args().folder
    if folder is None:
        with tempfile.TemporaryDirectory() as scratch:
            many_cases(Path(scratch))
        return
    failures = 0
    for suffix, what in ((".map", "cells"), (".scen", "agents")):
        paths, total = sorted(folder.rglob(f"*{suffix}")), 0
        with tempfile.TemporaryDirectory() as scratch:
            for path in paths:
                try:
                    total += round_trip(path, Path(scratch))
                except (OSError, ValueError) as error:
                    failures += 1
                    print(error, file=sys.stderr)
        print(f"{len(paths)} *{suffix} with {total:,} {what}")
    sys.exit(f"{failures} files failed" if failures else 0)


if __name__ == "__main__":
    main()
