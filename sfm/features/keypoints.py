"""What detectors find, before it becomes the features of an image."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float32, UInt8

from sfm.core.arrays import Indices, Points2D
from sfm.core.scene import DescriptorKind, Features


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Places in the image that a detector was given, a row each.

    Attributes:
        points2D: px, (0.5, 0.5) the centre of the first pixel.
        scales: σ in px.
        orientations: radians, from x to y.
        responses: how strong they are; the greater the better, in a unit of the detector's own.
    """

    points2D: Points2D
    scales: Float32[np.ndarray, " N"]
    orientations: Float32[np.ndarray, " N"]
    responses: Float32[np.ndarray, " N"]

    def __len__(self) -> int:
        return len(self.points2D)

    def __getitem__(self, rows: Indices) -> Keypoints:
        return Keypoints(self.points2D[rows], self.scales[rows], self.orientations[rows], self.responses[rows])


Selection: TypeAlias = Callable[[Keypoints], np.ndarray]
"""Which rows of the keypoints that were found are worth a description, ascending."""
Described: TypeAlias = tuple[Keypoints, UInt8[np.ndarray, "N D"]]
"""Keypoints, and the descriptor of each."""


def in_reading_order(keypoints: Keypoints) -> Indices:
    """Rows in the order of (y, x, scale, orientation)."""
    x, y = keypoints.points2D.T
    return np.lexsort((keypoints.orientations, keypoints.scales, x, y))


def strongest(keypoints: Keypoints, limit: int) -> Indices:
    """Rows of the `limit` strongest, ascending; of equals, those that come first in reading order."""
    if len(keypoints) <= limit:
        return np.arange(len(keypoints))
    weakest = np.partition(keypoints.responses, -limit)[-limit]
    rows, equals = np.flatnonzero(keypoints.responses > weakest), np.flatnonzero(keypoints.responses == weakest)
    first = equals[in_reading_order(keypoints[equals])[: limit - len(rows)]]
    return np.sort(np.concatenate([rows, first]))


def joined(parts: Sequence[Keypoints]) -> Keypoints:
    """The rows of all parts, one after the other."""
    columns = zip(*((p.points2D, p.scales, p.orientations, p.responses) for p in parts), strict=True)
    return Keypoints(*(np.concatenate(column) for column in columns))


def as_features(
    keypoints: Keypoints,
    descriptors: UInt8[np.ndarray, "N D"],
    kind: DescriptorKind,
    full_from_reduced: tuple[float, float],
) -> Features:
    """Features in px of the full image, in reading order.

    Coordinates are rounded to float32: what a COLMAP database gives back is what was in memory.

    Args:
        full_from_reduced: quotients of the widths and of the heights, full by reduced.
    """
    points2D = (keypoints.points2D * full_from_reduced).astype(np.float32).astype(np.float64)
    scales = (keypoints.scales * np.mean(full_from_reduced)).astype(np.float32)
    full = Keypoints(points2D, scales, keypoints.orientations, keypoints.responses)
    order = in_reading_order(full)
    return Features(points2D[order], scales[order], keypoints.orientations[order], descriptors[order], kind)
