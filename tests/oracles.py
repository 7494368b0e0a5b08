"""Slow oracles in plain Python, written from the definitions; they share no code with the code under test.

A cell is a tuple (row, col), a map a set of free cells or an (H, W) bool array, a team a list of cells.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

Cell = tuple[int, int]
Grid = npt.NDArray[np.bool_]

UP, LEFT, DOWN, RIGHT, IDLE = range(5)
STEP: dict[int, Cell] = {UP: (-1, 0), LEFT: (0, -1), DOWN: (1, 0), RIGHT: (0, 1), IDLE: (0, 0)}


def cells(array: Iterable[Iterable[int]]) -> list[Cell]:
    """The rows of an (N, 2) array as cells."""
    return [(int(row), int(col)) for row, col in array]


def moved(cell: Cell, action: int) -> Cell:
    """Return the cell to which `action` leads from `cell`."""
    return cell[0] + STEP[action][0], cell[1] + STEP[action][1]


def free_cells(grid: Grid) -> set[Cell]:
    """Return the free cells of the map."""
    height, width = grid.shape
    return {(row, col) for row in range(height) for col in range(width) if not grid[row, col]}


def distances(grid: Grid, source: Cell) -> dict[Cell, int]:
    """Steps from `source` to each cell that can be reached, by breadth-first search."""
    free, steps, queue = free_cells(grid), {source: 0}, deque([source])
    while queue:
        here = queue.popleft()
        for action in (UP, LEFT, DOWN, RIGHT):
            there = moved(here, action)
            if there in free and there not in steps:
                steps[there] = steps[here] + 1
                queue.append(there)
    return steps


def regions(grid: Grid) -> list[set[Cell]]:
    """The connected free regions, the largest first."""
    left, found = free_cells(grid), []
    while left:
        region = set(distances(grid, min(left)))
        left -= region
        found.append(region)
    return sorted(found, key=len, reverse=True)


def faults(grid: Grid, before: Sequence[Cell], after: Sequence[Cell]) -> list[str]:
    """All that is wrong with one executed joint step: jumps, walls, vertex and swap conflicts."""
    free, found = free_cells(grid), []
    for robot, (here, there) in enumerate(zip(before, after, strict=True)):
        if abs(here[0] - there[0]) + abs(here[1] - there[1]) > 1:
            found.append(f"robot {robot} jumps from {here} to {there}")
        if there not in free:
            found.append(f"robot {robot} enters {there}")
    found += [f"{count} robots at {cell}" for cell, count in Counter(after).items() if count > 1]
    mover = {(here, there) for here, there in zip(before, after, strict=True) if here != there}
    found += [f"a swap of {here} and {there}" for here, there in mover if (there, here) in mover]
    return found


def shield_faults(grid: Grid, before: Sequence[Cell], wanted: Sequence[int], executed: Sequence[int]) -> list[str]:
    """All that is wrong with what the paper's shield made of `wanted`.

    It may only turn actions into idle; what it executes has no fault; both robots of a swap stay; and whoever was
    stopped had a reason: the map, a swap, or another robot in the wanted cell afterwards.
    """
    free = free_cells(grid)
    aims = [moved(cell, action) for cell, action in zip(before, wanted, strict=True)]
    after = [moved(cell, action) for cell, action in zip(before, executed, strict=True)]
    exchanges = {(here, there) for here, there in zip(before, aims, strict=True) if here != there}
    found = faults(grid, before, after)
    for robot, aim in enumerate(aims):
        swaps = (aim, before[robot]) in exchanges
        stopped = executed[robot] != wanted[robot]
        if stopped and executed[robot] != IDLE:
            found.append(f"robot {robot} was turned from {wanted[robot]} to {executed[robot]}")
        if swaps and executed[robot] != IDLE:
            found.append(f"robot {robot} of a swap moves")
        if stopped and aim in free and not swaps and aim not in after:
            found.append(f"robot {robot} was stopped though {aim} stays empty")
    return found


def harmless(grid: Grid, before: Sequence[Cell], actions: Sequence[int]) -> list[int]:
    """`actions` with every robot that takes part in a fault made idle, until none is left."""
    chosen = list(actions)
    free = free_cells(grid)
    while True:
        after = [moved(cell, action) for cell, action in zip(before, chosen, strict=True)]
        count = Counter(after)
        movers = {(here, there) for here, there in zip(before, after, strict=True) if here != there}
        guilty = [
            robot
            for robot, (here, there) in enumerate(zip(before, after, strict=True))
            if chosen[robot] != IDLE and (there not in free or count[there] > 1 or (there, here) in movers)
        ]
        if not guilty:
            return chosen
        for robot in guilty:
            chosen[robot] = IDLE


def pibt(
    grid: Grid,
    team: Sequence[Cell],
    order: Sequence[int],
    wishes: Sequence[Sequence[int]],
    goals: Sequence[Cell] | None = None,
) -> list[int]:
    """The joint action of PIBT as the paper has it (Okumura et al. 2022, algorithm 1).

    `order` names the robots, the most important first; `wishes[i]` are the five actions, the most wanted first. With
    `goals` robots swap (Okumura 2023, "Improving LaCAM ...", section on the swap technique).
    """
    free, chosen = free_cells(grid), dict[int, int]()

    def planned(robot: int, pusher: int | None) -> bool:
        wanted = [action for action in wishes[robot] if moved(team[robot], action) in free]
        partner = None
        if goals is not None:
            partner = swap_partner(grid, team, goals, robot, moved(team[robot], wanted[0]), chosen)
        if partner is not None:
            wanted.reverse()
        for rank, action in enumerate(wanted):
            there = moved(team[robot], action)
            taken = any(moved(team[other], chosen[other]) == there for other in chosen)
            if there not in free or taken or (pusher is not None and there == team[pusher]):
                continue
            chosen[robot] = action
            in_the_way = [other for other, cell in enumerate(team) if cell == there and other not in chosen]
            if not in_the_way or planned(in_the_way[0], robot):
                left = team[robot]
                left_free = all(moved(team[other], chosen[other]) != left for other in chosen)
                if rank == 0 and partner is not None and partner not in chosen and left_free:
                    chosen[partner] = next(a for a in STEP if moved(team[partner], a) == left)
                return True
            del chosen[robot]
        chosen[robot] = IDLE
        return False

    for robot in order:
        if robot not in chosen:
            planned(robot, None)
    return [chosen[robot] for robot in range(len(team))]


def swap_partner(
    grid: Grid, team: Sequence[Cell], goals: Sequence[Cell], robot: int, target: Cell, chosen: dict[int, int]
) -> int | None:
    """The robot that has to change places with `robot`, which wants to enter `target`, if there is one and it can."""
    free, here = free_cells(grid), team[robot]
    to_goal = [distances(grid, goal) for goal in goals]

    def around(cell: Cell) -> list[Cell]:
        return [there for action in range(4) if (there := moved(cell, action)) in free]

    def far(who: int, cell: Cell) -> float:
        return to_goal[who].get(cell, float("inf"))

    def onward(back: Cell, front: Cell) -> list[Cell]:
        """Return the cells to which a robot that came to `front` from `back` can continue."""
        blocked = {cell for cell in around(front) if len(around(cell)) == 1 and cell in team}
        blocked = {cell for cell in blocked if goals[team.index(cell)] == cell}
        return [cell for cell in around(front) if cell != back and cell not in blocked]

    def required(pusher: int, puller: int, back: Cell, front: Cell) -> bool:
        while far(pusher, front) < far(pusher, back):
            ways = onward(back, front)
            if len(ways) > 1:
                return False
            if not ways:
                break
            back, front = front, ways[0]
        stays = far(pusher, back) == 0 or far(pusher, front) < far(pusher, back)
        return far(puller, back) < far(puller, front) and stays

    def possible() -> bool:
        back, front = target, here
        while front != target:
            ways = onward(back, front)
            if len(ways) != 1:
                return len(ways) > 1
            back, front = front, ways[0]
        return False

    if target == here:
        return None
    if target in team and team.index(target) not in chosen:
        ahead = team.index(target)
        if required(robot, ahead, here, target) and possible():
            return ahead
    for side in around(here):
        if side != target and side in team and required(team.index(side), robot, here, target) and possible():
            return team.index(side)
    return None


def field_of_view(grid: Grid, positions: Sequence[Cell], goals: Sequence[Cell], robot: int, radius: int) -> Grid:
    """Return the view of `robot`, (3, 2 * radius + 3, 2 * radius + 3): obstacles, own goal, robots.

    The window of 2 * radius + 1 cells a side lies inside a ring of one cell. Outside the map is obstacle. A goal in
    the window stands at its place; any other is projected on the ring along the line to it, half rounded to even.
    """
    free, (row, col) = free_cells(grid), positions[robot]
    centre = radius + 1
    view = np.zeros((3, 2 * centre + 1, 2 * centre + 1), bool)
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            cell = (row + down, col + right)
            view[0, centre + down, centre + right] = cell not in free
            view[2, centre + down, centre + right] = cell in positions
    down, right = goals[robot][0] - row, goals[robot][1] - col
    if max(abs(down), abs(right)) > radius:
        shrink = Fraction(centre, max(abs(down), abs(right)))
        down, right = round(down * shrink), round(right * shrink)
    view[1, centre + down, centre + right] = True
    return view


def communication_graph(positions: Sequence[Cell], radius: float) -> npt.NDArray[np.float32]:
    """(N, N), 1 where two different robots are strictly closer than `radius`."""
    robots = range(len(positions))
    hears = [[i != j and math.dist(positions[i], positions[j]) < radius for j in robots] for i in robots]
    return np.array(hears, np.float32)


def arrival(path: Sequence[Cell]) -> int:
    """The time from which a robot stays in the last cell of its path."""
    time = len(path) - 1
    while time > 0 and path[time - 1] == path[-1]:
        time -= 1
    return time


def mixed(seed: int, counter: int) -> int:
    """The draw number `counter` of SplitMix64 from `seed`."""
    word = (seed + (counter + 1) * 0x9E3779B97F4A7C15) % 2**64
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 % 2**64
    word = (word ^ word >> 27) * 0x94D049BB133111EB % 2**64
    return word ^ word >> 31


def track_of_a_replay(track: dict[str, Any]) -> list[list[list[int]]]:
    """Cells of each robot at each time, read from the data of a replay page."""
    times = [[list(cell) for cell in track["starts"]]]
    for step, letters in enumerate(track["moves"]):
        jumps = {robot: change for robot, *change in track["jumps"].get(str(step), [])}
        assert set(jumps) == {robot for robot, letter in enumerate(letters) if letter == "j"}
        changes = [{"u": (-1, 0), "l": (0, -1), "d": (1, 0), "r": (0, 1), "w": (0, 0)}.get(each) for each in letters]
        times.append(
            [
                [row + down, col + right]
                for robot, ((row, col), change) in enumerate(zip(times[-1], changes, strict=True))
                for down, right in [jumps[robot] if change is None else change]
            ]
        )
    return times
