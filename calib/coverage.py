"""Which parts of the image have shown a corner, counted by cells of a grid."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from calib.refine import Calibration
from sfm.core.arrays import Points2D

CELLS = 12
"""Of the image's width; as many as fit of its height."""


def coverage(found: Calibration, across: int = CELLS) -> Bool[np.ndarray, "Y X"]:
    """Cells of the image in which there is a corner."""
    width, height = found.camera.width, found.camera.height
    down = max(1, round(across * height / width))
    cells = np.zeros(across * down, bool)
    cells[cells_of(found.observations.points2D, width, height, across)] = True
    return cells.reshape(down, across)


def cells_of(points2D: Points2D, width: int, height: int, across: int = CELLS) -> np.ndarray:
    """(n,) numbers of cells, row by row."""
    down = max(1, round(across * height / width))
    x = np.clip((points2D[:, 0] / width * across).astype(int), 0, across - 1)
    y = np.clip((points2D[:, 1] / height * down).astype(int), 0, down - 1)
    return y * across + x
