"""One state as text or as pixels, for the render modes of PettingZoo and Gymnasium."""

from __future__ import annotations

import sys
import time
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from mapf_env import arguments, svg
from mapf_env.batched_env import BatchedEnv
from mapf_env.instance import Obstacles

RenderMode = Literal["ansi", "rgb_array", "human"]
RENDER_MODES: tuple[RenderMode, ...] = get_args(RenderMode)
_CELL = 16
_WALL, _FLOOR, _LINE = np.array([(59, 66, 82), (255, 255, 255), (232, 235, 239)], np.uint8)


class Screen:
    """Shows the first team of a batch in a render mode; without a mode it shows nothing.

    Args:
        mode: "ansi" returns text, "rgb_array" a picture (H', W', 3), "human" prints the text. In a terminal each state
            then replaces the one before.
        fps: States that a terminal shows in a second.

    Raises:
        ValueError: If the mode is unknown.
    """

    def __init__(self, mode: RenderMode | None, fps: float) -> None:
        if mode is not None:
            arguments.choice(mode, RENDER_MODES, "render_mode")
        self._mode, self._fps, self._lines = mode, fps, 0

    def show(self, batch: BatchedEnv) -> str | npt.NDArray[np.uint8] | None:
        """Return or print the current state.

        Raises:
            RuntimeError: Before the first reset.
        """
        if self._mode is None:
            return None
        if not batch.began:
            raise RuntimeError("there is nothing to render before the first reset: call reset()")
        state = batch.grids[0], batch.positions[0], batch.goals[0]
        if self._mode == "rgb_array":
            return picture(*state)
        shown = text(*state)
        if self._mode == "ansi":
            return shown
        if sys.stdout.isatty() and self._lines:
            time.sleep(1 / self._fps)
            print(f"\x1b[{self._lines}F\x1b[J", end="")  # up to the first line of the picture before, and clear
        elif self._lines:
            print()  # an empty line between states in a pipe or a file
        print(shown, flush=True)
        self._lines = shown.count("\n") + 1
        return None


def text(grid: Obstacles, positions: npt.NDArray[np.integer], goals: npt.NDArray[np.integer]) -> str:
    """Return the map as lines of text.

    # is an obstacle, . free, a letter a robot, in lower case its goal, and * a robot on its goal.
    The letters repeat after the 26th robot.
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
    """Return the map as an RGB picture (16 H, 16 W, 3): robots are discs, goals frames in their robot's colour."""
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
