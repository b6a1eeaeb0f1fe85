"""Keypoints with descriptors, and matches between them."""

from __future__ import annotations

import dataclasses
from enum import IntEnum

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from sfm.core.arrays import Points2D, Value, readonly


class DescriptorKind(IntEnum):
    """How descriptors are compared; the values are the numbers in the type column of a database.

    COLMAP knows 0, and has no name for the others: it reads them, but does not match them for its own.
    """

    SIFT = 0
    """By Euclidean distance; rows have length 512."""
    BINARY = 100
    """By the number of different bits, eight a column."""
    LEARNED = 101
    """By Euclidean distance; rows minus 128 have length 256."""
    FOLLOWED = 102
    """Equal or not: the number of a corner that is followed through a video, four bytes, the lowest first."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Features(Value):
    """The features of one image, a row each.

    Attributes:
        points2D: keypoints in px of the image at full size, (0.5, 0.5) the centre of the first pixel.
        scales: σ of the keypoint in px, 0 where the detector knows none.
        orientations: radians, from x to y.
        descriptors: (N, 128) uint8, √(L1-normalised) × 512 for SIFT; (N, B) bytes for binary ones.
        kind: of the descriptors. Only those of one kind can be compared.
    """

    points2D: Points2D
    scales: Float32[np.ndarray, " N"]
    orientations: Float32[np.ndarray, " N"]
    descriptors: UInt8[np.ndarray, "N D"]
    kind: DescriptorKind = DescriptorKind.SIFT

    def __post_init__(self) -> None:
        n = len(self.points2D)
        object.__setattr__(self, "points2D", readonly(self.points2D, (n, 2)))
        object.__setattr__(self, "scales", readonly(self.scales, (n,), np.float32))
        object.__setattr__(self, "orientations", readonly(self.orientations, (n,), np.float32))
        object.__setattr__(self, "descriptors", readonly(self.descriptors, (n, None), np.uint8))

    def __len__(self) -> int:
        return len(self.points2D)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Matches(Value):
    """Matches between two images: `indices[:, 0]` are features of image 1, `indices[:, 1]` of image 2."""

    indices: Int32[np.ndarray, "M 2"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "indices", readonly(self.indices, (None, 2), np.int32))

    def __len__(self) -> int:
        return len(self.indices)
