"""Mutual nearest neighbours with Lowe's ratio.

For descriptors a_i and b_j of uint8 the squared distance  |a_i|² + |b_j|² − 2 a_i·b_j  takes one matrix product.
With 128 dimensions no dot product exceeds 128 · 255² < 2²³: in float32 the product is *exact*, so the result depends
neither on the BLAS library nor on its threads, and ties are true ties, which the lower index wins.

The ratio is taken of Euclidean distances. For neighbours as near as matches are it equals the ratio of angles, which
COLMAP uses, to within a per cent.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float32

from sfm.core.errors import ConfigError
from sfm.core.scene import Features, Matches
from sfm.matching import _kernels

_BLOCK_ROWS = 256
"""Rows of the table of distances at a time: 12 MB for 12,000 features, which stays in the cache of a core."""
_DESCRIPTOR_NORM = 512.0
_EXACT_BELOW = 2**24


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatchingConfig:
    """Which nearest neighbours are matches."""

    max_ratio: float = 0.8
    """Largest ratio of the distances to the nearest and to the second nearest feature; Lowe's value. 1 lets every
    unique nearest neighbour pass."""

    max_distance: float = 0.7
    """Largest distance, for descriptors of unit length. COLMAP's value; only rows far from all others feel it."""

    mutual: bool = True
    """Each of the two features must be the other's match. Without it image 1 chooses alone, and several of its
    features may match the same one."""

    def __post_init__(self) -> None:
        if not 0 < self.max_ratio <= 1:
            raise ConfigError(f"max_ratio must be in (0, 1], got {self.max_ratio}")
        if self.max_distance <= 0:
            raise ConfigError(f"max_distance must be above 0, got {self.max_distance}")


def match_features(features1: Features, features2: Features, config: MatchingConfig = MatchingConfig()) -> Matches:
    """Matches of two images, sorted by the index in image 1.

    Raises:
        ValueError: the descriptors differ in length, or are too long for exact arithmetic.
    """
    best1, second1, index1, best2, second2, index2 = _two_nearest(features1, features2)
    accepted1 = _accepted(best1, second1, config)
    if config.mutual:
        accepted2 = _accepted(best2, second2, config)
        rows = np.flatnonzero(accepted1)
        partners = index1[rows]
        rows = rows[accepted2[partners] & (index2[partners] == rows)]
    else:
        rows = np.flatnonzero(accepted1)
    return Matches(np.stack([rows, index1[rows]], axis=1).astype(np.int32))


def _accepted(
    best: Float32[np.ndarray, " N"], second: Float32[np.ndarray, " N"], config: MatchingConfig
) -> Bool[np.ndarray, " N"]:
    """Squared distances to the nearest and the second nearest that make a match; infinite where there is none."""
    limit = (config.max_distance * _DESCRIPTOR_NORM) ** 2
    return (best < config.max_ratio**2 * second.astype(np.float64)) & (best <= limit)


def _two_nearest(features1: Features, features2: Features) -> tuple[np.ndarray, ...]:
    """Squared distance to the nearest, to the second nearest, and index of the nearest, for both directions."""
    if features1.descriptors.shape[1] != features2.descriptors.shape[1]:
        lengths = features1.descriptors.shape[1], features2.descriptors.shape[1]
        raise ValueError(f"descriptors must have the same length, got {lengths[0]} and {lengths[1]}")
    if 2 * features1.descriptors.shape[1] * 255**2 >= _EXACT_BELOW:
        raise ValueError(f"descriptors may have up to 128 dimensions, got {features1.descriptors.shape[1]}")
    a, b = (features.descriptors.astype(np.float32) for features in (features1, features2))
    squared1, squared2 = (np.einsum("ij,ij->i", x, x) for x in (a, b))
    state = (*_nothing_found(len(a)), *_nothing_found(len(b)))
    for start in range(0, len(a), _BLOCK_ROWS):
        dots = a[start : start + _BLOCK_ROWS] @ b.T
        _kernels.scan_block(dots, start, squared1, squared2, *state)
    return state


def _nothing_found(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.full(count, np.inf, np.float32), np.full(count, np.inf, np.float32), np.full(count, -1, np.int32)
