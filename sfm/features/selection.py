"""Which of the keypoints that were found are kept: those that a mask allows, and of too many the best."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import BoolArray, Indices, Points2D
from sfm.features.config import FeatureConfig
from sfm.features.keypoints import Keypoints, in_reading_order, strongest

_PER_CELL = 24
"""Features that a cell of the even spreading holds on average."""


class Selector:
    """The choice for one image, and the count of what it has seen.

    Attributes:
        found, masked: keypoints of the last call, and those of them that the mask has taken away.
    """

    def __init__(
        self,
        config: FeatureConfig,
        reduced_size: tuple[int, int],
        mask: BoolArray | None,
        full_from_reduced: tuple[float, float],
    ) -> None:
        self.found = self.masked = 0
        self._config, self._size = config, reduced_size
        self._mask, self._full_from_reduced = mask, full_from_reduced

    def __call__(self, keypoints: Keypoints) -> np.ndarray:
        """Rows that are worth a description, ascending."""
        allowed = np.arange(len(keypoints))
        if self._mask is not None:
            allowed = np.flatnonzero(inside(self._mask, keypoints.points2D * self._full_from_reduced))
        self.found, self.masked = len(keypoints), len(keypoints) - len(allowed)
        limit = self._config.max_features
        if self._config.spreading == "even":
            return allowed[spread(keypoints[allowed], limit, *self._size)]
        return allowed[strongest(keypoints[allowed], limit)]


def inside(mask: BoolArray, points2D: Points2D) -> BoolArray:
    """Whether the pixel in which a point lies is True in `mask` (H, W); points beyond the border take its value."""
    columns, rows = (
        np.clip(np.floor(points2D[:, axis]).astype(np.int64), 0, mask.shape[1 - axis] - 1) for axis in (0, 1)
    )
    return mask[rows, columns]


def spread(keypoints: Keypoints, limit: int, width: int, height: int) -> Indices:
    """Rows of `limit` keypoints, the strongest of each of the square cells of an image; ascending.

    All cells give their strongest first, then all their second, and so on; where the last round has too many, the
    strongest of it are taken. So a cell has the same number as every other that is rich enough.
    """
    if len(keypoints) <= limit:
        return np.arange(len(keypoints))
    side = np.sqrt(width * height * _PER_CELL / limit)
    columns, rows = np.floor(keypoints.points2D / side).astype(np.int64).T
    cells = rows * (int(width / side) + 1) + columns
    order = in_reading_order(keypoints)
    order = order[np.lexsort((-keypoints.responses[order], cells[order]))]
    starts = np.flatnonzero(np.r_[True, np.diff(cells[order]) != 0])
    round_of = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    first = np.lexsort((-keypoints.responses[order], round_of))[:limit]
    return np.sort(order[first])
