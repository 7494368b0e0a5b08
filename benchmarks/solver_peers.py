"""Solvers from PyPI to compare with ours: w9-pathfinding (optimal CBS) and pymapf (weighted CBS).

They live in a virtual environment of their own, in which this file runs as a script: problems in as JSON, results out.
Swaps are forbidden, which w9-pathfinding does not do by itself; set-up is part of the time, as it is of ours.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from peer_venv import peer_python

if TYPE_CHECKING:
    from mapf_env import Instance

PACKAGES = ("w9-pathfinding==0.1.3", "pymapf==0.9.0")

Row = tuple[str, list[float], list[int | None]]
"""A solver's name, its milliseconds and its costs, None where it found nothing."""


def python() -> Path:
    """The interpreter of the peers' environment, which is made if it does not exist.

    Raises:
        subprocess.CalledProcessError: If they cannot be installed.
        OSError: If no environment can be made.
    """
    return peer_python("solver-peers-venv", PACKAGES, ["w9_pathfinding", "pymapf"])


def measure(interpreter: Path, instances: list[Instance], time_limit: float) -> list[Row]:
    """Both peers on the instances, in a process of their own."""
    problems = [
        {"grid": each.grid.astype(int).tolist(), "starts": each.starts.tolist(), "goals": each.goals.tolist()}
        for each in instances
    ]
    question = json.dumps({"problems": problems, "time_limit": time_limit})
    command = [str(interpreter), str(Path(__file__).resolve())]
    answer = subprocess.run(command, input=question, capture_output=True, text=True, check=True).stdout
    return [(name, times, costs) for name, times, costs in json.loads(answer.splitlines()[-1])]


def w9(problem: dict[str, Any], time_limit: float) -> list[list[Any]] | None:
    """Optimal CBS; its nodes are (x, y)."""
    from w9_pathfinding.envs import Grid  # pyright: ignore[reportMissingImports]
    from w9_pathfinding.mapf import CBS  # pyright: ignore[reportMissingImports]

    grid = Grid([[-1 if blocked else 1 for blocked in row] for row in problem["grid"]], edge_collision=True)
    flip = [[(col, row) for row, col in problem[key]] for key in ("starts", "goals")]
    try:
        return CBS(grid).mapf(*flip, max_length=200, max_time=time_limit) or None
    except RuntimeError:
        return None


def pymapf(problem: dict[str, Any], time_limit: float) -> list[list[Any]] | None:
    """CBS with weight 1.2."""
    from pymapf import Agent, GridMap, MAPFProblem, WeightedCBS  # pyright: ignore[reportMissingImports]

    pairs = zip(problem["starts"], problem["goals"], strict=True)
    agents = [Agent(str(i), tuple(start), tuple(goal)) for i, (start, goal) in enumerate(pairs)]
    solver = WeightedCBS(weight=1.2, max_expansions=10**6, time_limit=time_limit)
    solution = solver.solve(MAPFProblem(GridMap(problem["grid"]), agents))
    return None if solution is None else [list(path) for path in solution.paths.values()]


def cost(paths: list[list[Any]] | None) -> int | None:
    """The sum of costs: a robot pays until it stays for good."""
    if paths is None:
        return None
    total = 0
    for path in paths:
        arrival = len(path) - 1
        while arrival > 0 and tuple(path[arrival - 1]) == tuple(path[-1]):
            arrival -= 1
        total += arrival
    return total


def main() -> None:
    question = json.loads(sys.stdin.read())
    peers: dict[str, Callable[[dict[str, Any], float], list[list[Any]] | None]] = {
        "w9-pathfinding, CBS": w9,
        "pymapf, weighted CBS 1.2": pymapf,
    }
    rows: list[Row] = []
    for name, solve in peers.items():
        times: list[float] = []
        costs: list[int | None] = []
        for problem in question["problems"]:
            begin = time.perf_counter()
            paths = solve(problem, question["time_limit"])
            times.append((time.perf_counter() - begin) * 1e3)
            costs.append(cost(paths))
        rows.append((name, times, costs))
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
