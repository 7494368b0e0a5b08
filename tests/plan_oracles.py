"""Judges of whole plans in plain Python, sharing no code with the source: what is a fault, what is the optimum."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

Cell = tuple[int, int]


def as_cells(array: npt.NDArray[np.int32]) -> list[Cell]:
    return [(int(row), int(col)) for row, col in array]


def neighbours(grid: npt.NDArray[np.bool_], cell: Cell) -> list[Cell]:
    row, col = cell
    around = [(row - 1, col), (row, col - 1), (row + 1, col), (row, col + 1)]
    return [(r, c) for r, c in around if 0 <= r < grid.shape[0] and 0 <= c < grid.shape[1] and not grid[r, c]]


def distances(grid: npt.NDArray[np.bool_], goal: Cell) -> dict[Cell, int]:
    """Steps to `goal` from every cell that reaches it."""
    found, frontier = {goal: 0}, [goal]
    while frontier:
        cell = frontier.pop(0)
        for neighbour in neighbours(grid, cell):
            if neighbour not in found:
                found[neighbour] = found[cell] + 1
                frontier.append(neighbour)
    return found


def faults(
    grid: npt.NDArray[np.bool_],
    starts: npt.NDArray[np.int32],
    goals: npt.NDArray[np.int32],
    paths: npt.NDArray[np.int32],
) -> list[str]:
    """Everything that keeps `paths` (T + 1, N, 2) from being a solution."""
    steps = [as_cells(joint) for joint in paths]
    found = []
    if steps[0] != as_cells(starts):
        found.append("does not begin at the starts")
    if steps[-1] != as_cells(goals):
        found.append("does not end on the goals")
    for time, joint in enumerate(steps):
        for robot, (row, col) in enumerate(joint):
            if not (0 <= row < grid.shape[0] and 0 <= col < grid.shape[1]) or grid[row, col]:
                found.append(f"robot {robot} is in no free cell at time {time}")
        if len(set(joint)) < len(joint):
            found.append(f"vertex conflict at time {time}")
    for time in range(1, len(steps)):
        before, after = steps[time - 1], steps[time]
        for i in range(len(after)):
            if abs(before[i][0] - after[i][0]) + abs(before[i][1] - after[i][1]) > 1:
                found.append(f"robot {i} jumps at time {time}")
            for j in range(i):
                if before[i] == after[j] and before[j] == after[i] and before[i] != before[j]:
                    found.append(f"robots {j} and {i} swap at time {time}")
    return found


def sum_of_costs(paths: npt.NDArray[np.int32]) -> int:
    """For each robot the first time from which it never leaves its last cell, added up."""
    total = 0
    for robot in range(paths.shape[1]):
        path = as_cells(paths[:, robot])
        arrival = len(path) - 1
        while arrival > 0 and path[arrival - 1] == path[-1]:
            arrival -= 1
        total += arrival
    return total


def optimal_cost(
    grid: npt.NDArray[np.bool_], starts: npt.NDArray[np.int32], goals: npt.NDArray[np.int32]
) -> int | None:
    """The least sum of costs by A* over joint states, or None without a solution.

    A state is where the robots are and which of them have retired: a robot on its goal may retire, then it stays for
    ever and pays nothing. All others pay one for every step, waiting on their goal included.
    """
    targets = as_cells(goals)
    to_goal = [distances(grid, goal) for goal in targets]
    everyone = (1 << len(targets)) - 1

    def estimate(cells: tuple[Cell, ...], retired: int) -> int:
        return sum(to_goal[i][cell] for i, cell in enumerate(cells) if not retired >> i & 1)

    def retirements(cells: tuple[Cell, ...], retired: int) -> Iterator[int]:
        able = [i for i, cell in enumerate(cells) if cell == targets[i] and not retired >> i & 1]
        for choice in range(1 << len(able)):
            yield retired | sum(1 << robot for k, robot in enumerate(able) if choice >> k & 1)

    begin = tuple(as_cells(starts))
    best: dict[tuple[tuple[Cell, ...], int], int] = {}
    queue: list[tuple[int, int, tuple[Cell, ...], int]] = []

    def visit(cost: int, cells: tuple[Cell, ...], retired: int) -> None:
        if cost < best.get((cells, retired), cost + 1):
            best[cells, retired] = cost
            heapq.heappush(queue, (cost + estimate(cells, retired), cost, cells, retired))

    for retired in retirements(begin, 0):
        visit(0, begin, retired)
    while queue:
        _, cost, cells, retired = heapq.heappop(queue)
        if retired == everyone:
            return cost
        if cost > best[cells, retired]:
            continue
        paid = len(cells) - retired.bit_count()
        for after in _joint_moves(grid, cells, retired, ()):
            for now_retired in retirements(after, retired):
                visit(cost + paid, after, now_retired)
    return None


def _joint_moves(
    grid: npt.NDArray[np.bool_], cells: Sequence[Cell], retired: int, chosen: tuple[Cell, ...]
) -> Iterator[tuple[Cell, ...]]:
    robot = len(chosen)
    if robot == len(cells):
        yield chosen
        return
    here = cells[robot]
    for target in [here] if retired >> robot & 1 else [here, *neighbours(grid, here)]:
        if target in chosen or any(target == cells[j] and chosen[j] == here for j in range(robot)):
            continue
        yield from _joint_moves(grid, cells, retired, (*chosen, target))
