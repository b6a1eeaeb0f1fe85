"""Verified geometry of image pairs."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType

import numpy as np
from jaxtyping import Int32

from sfm.core.arrays import Matrix3, Value, readonly
from sfm.core.geometry.rigid import Rigid3


class PairKind(IntEnum):
    """What explains a pair's matches; the values are COLMAP's configuration numbers."""

    DEGENERATE = 1
    CALIBRATED = 2
    UNCALIBRATED = 3
    PLANAR = 4
    PANORAMIC = 5
    PLANAR_OR_PANORAMIC = 6
    WATERMARK = 7


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class TwoViewGeometry(Value):
    """The geometry of images i < j and the matches that agree with it.

    Attributes:
        matches: (M, 2) the inlier matches, columns as in `Matches`.
        cam2_from_cam1: relative pose with a translation of unit length (zero for a panoramic pair); None where
            the kind does not define one.
        E, F, H: the matrices that were estimated, x2ᵀ E x1 = 0 on normalised, x2ᵀ F x1 = 0 and x2 ~ H x1 on pixel
            coordinates; None where not.
        tri_angle: median triangulation angle of the inliers in radians; 0 where there is no pose.
    """

    kind: PairKind
    matches: Int32[np.ndarray, "M 2"]
    cam2_from_cam1: Rigid3 | None = None
    E: Matrix3 | None = None
    F: Matrix3 | None = None
    H: Matrix3 | None = None
    tri_angle: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "matches", readonly(self.matches, (None, 2), np.int32))
        for name in ("E", "F", "H"):
            matrix = getattr(self, name)
            if matrix is not None:
                object.__setattr__(self, name, readonly(matrix, (3, 3)))

    def __len__(self) -> int:
        return len(self.matches)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ViewGraph(Value):
    """`pairs[i, j]`, i < j image ids: what both mappers start from. Iteration is in sorted order of the keys."""

    pairs: Mapping[tuple[int, int], TwoViewGeometry]

    def __post_init__(self) -> None:
        if any(i >= j for i, j in self.pairs):
            raise ValueError("a pair's first image id must be below its second")
        object.__setattr__(self, "pairs", MappingProxyType(dict(sorted(self.pairs.items()))))

    def __len__(self) -> int:
        return len(self.pairs)
