"""Reads every MovingAI map and scenario of a folder, writes each anew and reads that; exits with 1 if one fails."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from mapf_env import load_instances, load_map, load_scen, save_instances, save_map, save_scen


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


def main() -> None:
    """Go through a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="searched with all its subfolders")
    folder = parser.parse_args().folder
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
