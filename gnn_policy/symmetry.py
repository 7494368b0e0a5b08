"""The rotations and reflections of a grid world: one symmetry turns maps, positions and moves alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mapf_env import MOVES

_TRANSFORMS = np.array(
    [np.linalg.matrix_power([[0, -1], [1, 0]], g % 4) @ [[1, 0], [0, 1 - 2 * (g // 4)]] for g in range(8)]
)
"""(8, 2, 2) what each symmetry does to a (row, col) difference: quarter turns, then the same after a reflection."""

ACTIONS: npt.NDArray[np.int8] = np.array(
    [[(move @ turn.T == MOVES).all(axis=1).argmax() for move in MOVES] for turn in _TRANSFORMS], dtype=np.int8
)
"""(8, 5) the action that each action becomes."""


def symmetries(height: int, width: int) -> npt.NDArray[np.intp]:
    """The symmetries that keep the map's shape: all eight of a square, four of a rectangle."""
    return np.arange(8) if height == width else np.array([0, 2, 4, 6])


def turn_maps(grids: npt.NDArray[Any], symmetry: int) -> npt.NDArray[Any]:
    """Grids (..., H, W) under one symmetry of theirs."""
    height, width = grids.shape[-2:]
    rows, cols = np.mgrid[:height, :width]
    turned = np.empty_like(grids)
    cells = turn_cells(np.stack([rows, cols], -1), np.array(symmetry), height, width)
    turned[..., cells[..., 0], cells[..., 1]] = grids
    return turned


def turn_cells(
    cells: npt.NDArray[np.integer], symmetry: npt.NDArray[np.integer], height: int, width: int
) -> npt.NDArray[np.int32]:
    """Cells (..., 2) of a height x width map; `symmetry` is broadcast over their leading axes."""
    # Twice the difference to the centre of the map keeps the numbers whole.
    centre = np.array([height - 1, width - 1])
    turned = np.einsum("...ij,...j->...i", _TRANSFORMS[symmetry], 2 * cells - centre)
    return ((turned + centre) // 2).astype(np.int32)
