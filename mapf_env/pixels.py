"""One state as text or as pixels, for PettingZoo's render modes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mapf_env import svg
from mapf_env.instance import Obstacles

_CELL = 16
_WALL, _FLOOR, _LINE = np.array([(59, 66, 82), (255, 255, 255), (232, 235, 239)], np.uint8)


def text(grid: Obstacles, positions: npt.NDArray[np.integer], goals: npt.NDArray[np.integer]) -> str:
    """The map in lines: # obstacle, . free, a letter for each robot, in lower case for its goal, * a robot on its goal.

    The letters begin anew after the 26th robot.
    """
    cells = np.where(grid, "#", ".")
    letters = np.array([chr(ord("A") + i % 26) for i in range(len(positions))])
    cells[goals[:, 0], goals[:, 1]] = np.char.lower(letters)
    arrived = (positions == goals).all(axis=1)
    cells[positions[:, 0], positions[:, 1]] = np.where(arrived, "*", letters)
    return "\n".join("".join(row) for row in cells)


def picture(
    grid: Obstacles, positions: npt.NDArray[np.integer], goals: npt.NDArray[np.integer]
) -> npt.NDArray[np.uint8]:
    """The map as an RGB picture (16 H, 16 W, 3): obstacles dark, robots discs, goals frames in their robot's colour."""
    height, width = grid.shape
    pixels = np.empty((height, _CELL, width, _CELL, 3), np.uint8)
    pixels[:] = np.where(grid[:, None, :, None, None], _WALL, _FLOOR)
    pixels[:, 0] = np.where(grid[:, :, None, None], pixels[:, 0], _LINE)
    pixels[:, :, :, 0] = np.where(grid[:, None, :, None], pixels[:, :, :, 0], _LINE)
    offset = np.abs(np.arange(_CELL) - (_CELL - 1) / 2)
    disc = offset[:, None] ** 2 + offset**2 <= (_CELL / 2 - 2) ** 2
    reach = np.maximum(offset[:, None], offset)
    frame = (reach <= _CELL / 2 - 2) & (reach > _CELL / 2 - 4)
    colours = [tuple(bytes.fromhex(colour[1:])) for colour in svg.colours(len(positions))]
    for shape, cells in ((frame, goals), (disc, positions)):
        for (row, col), colour in zip(cells.tolist(), colours, strict=True):
            pixels[row, :, col][shape] = colour
    return pixels.reshape(height * _CELL, width * _CELL, 3)
