"""The rotations and reflections of a grid: one symmetry turns maps, positions and moves alike."""

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


def turn_map(grid: npt.NDArray[Any], symmetry: int) -> npt.NDArray[Any]:
    """Return a grid (H, W) under one symmetry: (H, W), or (W, H) after a quarter turn."""
    height, width = grid.shape
    cells = np.moveaxis(np.indices((height, width)), 0, -1)
    turned_cells = turn_cells(cells, np.array(symmetry), np.array([height, width]))
    turned = np.empty((width, height) if symmetry % 2 else (height, width), grid.dtype)
    turned[turned_cells[..., 0], turned_cells[..., 1]] = grid
    return turned


def turn_cells(
    cells: npt.NDArray[np.integer], symmetry: npt.NDArray[np.integer], shape: npt.NDArray[np.integer]
) -> npt.NDArray[np.int32]:
    """Return cells (..., 2) of maps under symmetries (...), where `shape` (..., 2) has the maps' heights and widths."""
    # Twice the difference to the centre of the map keeps the numbers whole.
    centre = shape.astype(np.int64) - 1
    turned_centre = np.where((symmetry % 2 == 1)[..., None], centre[..., ::-1], centre)
    turned = np.einsum("...ij,...j->...i", _TRANSFORMS[symmetry], 2 * cells.astype(np.int64) - centre)
    return ((turned + turned_centre) // 2).astype(np.int32)


def turn_actions(actions: npt.NDArray[np.integer], symmetry: npt.NDArray[np.integer]) -> npt.NDArray[np.int8]:
    """Return actions (...) under symmetries (...); -1, where there is none, stays."""
    return np.where(actions < 0, -1, ACTIONS[symmetry, actions]).astype(np.int8)
