"""The contract of all readers of files: any bytes give an instance, map or paths, or an error that says where.

Run as a script this is a target for coverage-guided fuzzing, which needs `pip install atheris`:
    python tests/readers.py -max_total_time=300
"""

from __future__ import annotations

import importlib
import os
import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

GRID = [[0, 0, 1, 0], [0, 0, 0, 1], [1, 1, 0, 0]]
MAP = b"type octile\nheight 3\nwidth 4\nmap\n..@.\nGS.T\nOW..\n"
SCEN = b"version 1\n0\ta.map\t4\t3\t0\t0\t2\t1\t2.41421356\n1\ta.map\t4\t3\t1\t1\t3\t2\t2.41421356\n"
PATHS = b"Agent 0: (1,0)->(1,1)->(0,1)->\nAgent 1: (2,2)->\n"
LOG = b"agents=2\nsolved=1\nstarts=(0,1),(2,2),\nsolution=\n0:(0,1),(2,2),\n1:(1,1),(2,2),\n"
YAML = b"'one': |-\n  @.!\n  $#.\n# marked\ntwo: |\n    aB.\n    #bA\n"

atheris: Any = importlib.import_module("atheris") if __name__ == "__main__" else None
with atheris.instrument_imports(include=["mapf_env", "experts"]) if atheris else nullcontext():
    import experts
    import mapf_env

Reader = Callable[[Path], Any]
READERS: dict[str, Reader] = {
    "map": mapf_env.load_map,
    "scen": mapf_env.load_scen,
    "json": mapf_env.load_instances,
    "yaml": lambda path: [each.grid for each in mapf_env.load_pogema_maps(path).values()],
    "paths": experts.load_paths,
    "log": experts.load_paths,
}
WHERE = {
    "map": r"line \d+",
    "scen": r"line (\d+|i \+ 2)",
    "yaml": r"line \d+",
    "paths": r"line \d+|holds no paths|table of",
    "log": r"line \d+|holds no paths|table of",
    "json": r"line \d+ column \d+|(map|instance) \d+|expected|position \d+|recursion|digits",
}
"""The place that an error message names, for each kind of file."""


def samples(folder: Path) -> dict[str, bytes]:
    """A sound file of each kind."""
    instance = mapf_env.Instance(GRID, [(0, 0), (1, 1)], [(1, 2), (2, 3)])
    mapf_env.save_instances(folder / "sample", [instance, instance.at([(1, 0), (0, 1)])])
    return {
        "map": MAP,
        "scen": SCEN,
        "json": (folder / "sample").read_bytes(),
        "yaml": YAML,
        "paths": PATHS,
        "log": LOG,
    }


def faults(kind: str, content: bytes, folder: Path) -> list[str]:
    """Return the violations of the contract by the reader of that kind; `folder` is for the file."""
    (folder / "a.map").write_bytes(MAP)
    path = folder / f"read.{kind}"
    path.write_bytes(content)
    try:
        found = READERS[kind](path)
    except (ValueError, FileNotFoundError) as error:
        said = str(error)
        unnamed = [] if str(folder) in said else [f"no file is named: {said}"]
        return unnamed if re.search(WHERE[kind], said) else [*unnamed, f"no place is named: {said}"]
    except Exception as error:
        return [f"{type(error).__name__}: {error}"]
    return [fault for each in (found if isinstance(found, list) else [found]) for fault in unsound(each)]


def unsound(found: Any) -> list[str]:
    """Return the faults of a map, an instance or paths that a reader has accepted."""
    if isinstance(found, mapf_env.Solution):
        return [] if (found.paths >= 0).all() and found.paths.ndim == 3 else ["these are not paths"]
    if isinstance(found, np.ndarray):
        return [] if found.dtype == np.bool_ and found.ndim == 2 and found.size else ["this is not a map"]
    if not isinstance(found, mapf_env.Instance):
        return ["this is not an instance"]
    wrong = unsound(found.grid)
    for name, cells in (("start", found.starts), ("goal", found.goals)):
        places = {tuple(cell) for cell in cells.tolist()}
        height, width = found.grid.shape
        if len(places) < len(cells) or not all(
            0 <= row < height and 0 <= col < width and not found.grid[row, col] for row, col in places
        ):
            wrong.append(f"a {name} is not a cell of its own")
    return wrong


def main() -> None:
    """Fuzz until told to stop; the first byte chooses the kind of file."""
    kinds, folder = sorted(READERS), Path(tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None))

    def test_one_input(data: bytes) -> None:
        if not data:
            return
        found = faults(kinds[data[0] % len(kinds)], data[1:], folder)
        if found:
            raise RuntimeError(f"{kinds[data[0] % len(kinds)]}: {found}")

    corpus = Path(tempfile.mkdtemp())
    for number, (_, content) in enumerate(sorted(samples(folder).items())):
        (corpus / str(number)).write_bytes(bytes([number]) + content)
    atheris.Setup([*sys.argv, str(corpus)], test_one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
