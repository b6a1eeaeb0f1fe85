"""Mutual nearest neighbours with Lowe's ratio.

For descriptors a_i and b_j of uint8 the squared distance  |a_i|² + |b_j|² − 2 a_i·b_j  takes one matrix product.
With 128 dimensions no dot product exceeds 128 · 255² < 2²³: in float32 the product is *exact*, so the result depends
neither on the BLAS library nor on its threads, and ties are true ties, which the lower index wins.

The ratio is taken of Euclidean distances. For neighbours as near as matches are it equals the ratio of angles, which
COLMAP uses, to within a per cent.

Images with many features are searched through an index (see `cells`), whose distances are exact as well. Binary
descriptors are compared by their different bits (see `binary`), and corners of a video by their numbers.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Num, UInt8

from sfm.core.errors import ConfigError
from sfm.core.scene import DescriptorKind, Features, Matches
from sfm.matching import _kernels
from sfm.matching.binary import Nearest, nearest_bits
from sfm.matching.cells import Cells, SearchableFeatures

_BLOCK_ROWS = 256
"""Rows of the table of distances at a time: 12 MB for 12,000 features, which stays in the cache of a core."""
_DESCRIPTOR_NORM = {DescriptorKind.SIFT: 512.0, DescriptorKind.LEARNED: 256.0}
_EXACT_BELOW = 2**24


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatchingConfig:
    """Which nearest neighbours are matches."""

    max_ratio: float = 0.8
    """Largest ratio of the distances to the nearest and to the second nearest feature; Lowe's value. 1 lets every
    unique nearest neighbour pass."""

    max_distance: float = 0.7
    """Largest distance, for descriptors of unit length. COLMAP's value; only rows far from all others feel it."""

    max_bits: float = 0.3
    """Largest share of different bits, for binary descriptors. Those of different places differ in nearly a half, with
    a spread of a tenth."""

    mutual: bool = True
    """Each of the two features must be the other's match. Without it image 1 chooses alone, and several of its
    features may match the same one."""

    exact_below: int = 1000
    """Features an image below which all are compared with all; above, only those in cells of similar ones (see
    `cells`), which misses one match in 50 and takes a tenth of the time at 12,000."""

    cells_searched: int = 6
    """Cells in which the match of a feature is looked for. With 10, one match in 150 is missed, for half as much time
    again."""

    hashed_above: int = 50000
    """Binary features an image above which only those that share a hash are compared (see `binary`)."""

    lightglue: str = ""
    """ONNX file of LightGlue, for features of the network that it was trained with; empty for nearest neighbours."""

    min_score: float = 0.1
    """Least score of a match by LightGlue; its authors' value."""

    guided: bool = False
    """Matches once more along the epipolar lines of a verified pair, and verifies again: more matches of what repeats
    (1,215 instead of 609 on a pair of Herz-Jesus-P8, 377 instead of 298 on one of lund; a quarter of a second a pair
    of 8,000 features). Users of COLMAP report that global mapping gets worse by it."""

    guided_error_px: float = 4.0
    """Largest distance from the epipolar line in px, for `guided`."""

    def __post_init__(self) -> None:
        if self.guided_error_px <= 0:
            raise ConfigError(f"guided_error_px must be above 0, got {self.guided_error_px}")
        if not 0 < self.max_bits <= 1:
            raise ConfigError(f"max_bits must be in (0, 1], got {self.max_bits}")
        if self.hashed_above < 0:
            raise ConfigError(f"hashed_above must not be negative, got {self.hashed_above}")
        if self.exact_below < 0:
            raise ConfigError(f"exact_below must not be negative, got {self.exact_below}")
        if self.cells_searched < 1:
            raise ConfigError(f"cells_searched must be at least 1, got {self.cells_searched}")
        if not 0 < self.max_ratio <= 1:
            raise ConfigError(f"max_ratio must be in (0, 1], got {self.max_ratio}")
        if self.max_distance <= 0:
            raise ConfigError(f"max_distance must be above 0, got {self.max_distance}")


def match_features(
    features1: Features | SearchableFeatures,
    features2: Features | SearchableFeatures,
    config: MatchingConfig = MatchingConfig(),
) -> Matches:
    """Matches of two images, sorted by the index in image 1.

    Where an image has many pairs, `SearchableFeatures` of it spare preparing its descriptors for each.

    Raises:
        ValueError: the descriptors differ in kind or length, or are too long for exact arithmetic.
    """
    image1, image2 = _searchable(features1), _searchable(features2)
    check_descriptors(image1, image2)
    match image1.kind:
        case DescriptorKind.FOLLOWED:
            return _same_corners(image1.descriptors, image2.descriptors)
        case DescriptorKind.BINARY:
            found = nearest_bits(image1.words, image2.words, config.hashed_above)
        case DescriptorKind.SIFT | DescriptorKind.LEARNED:
            found = _two_nearest(image1, image2, config)
    return accepted_matches(found, image1.kind, image1.descriptors.shape[1], config)


def accepted_matches(found: Nearest, kind: DescriptorKind, width: int, config: MatchingConfig) -> Matches:
    """The nearest neighbours that `config` lets pass.

    Args:
        found: squared Euclidean distances, or numbers of bits where the descriptors are binary.
        width: columns of the descriptors.
    """
    if kind == DescriptorKind.BINARY:
        ratio, largest = config.max_ratio, config.max_bits * 8 * width
    else:
        ratio, largest = config.max_ratio**2, (config.max_distance * _DESCRIPTOR_NORM[kind]) ** 2
    best1, second1, index1, best2, second2, index2 = found
    rows = np.flatnonzero(_accepted(best1, second1, ratio, largest))
    if config.mutual:
        accepted2 = _accepted(best2, second2, ratio, largest)
        partners = index1[rows]
        rows = rows[accepted2[partners] & (index2[partners] == rows)]
    return Matches(np.stack([rows, index1[rows]], axis=1).astype(np.int32))


def _same_corners(descriptors1: UInt8[np.ndarray, "N 4"], descriptors2: UInt8[np.ndarray, "M 4"]) -> Matches:
    """The corners that both frames have; no frame has one twice."""
    numbers = (np.ascontiguousarray(rows).view("<u4").ravel() for rows in (descriptors1, descriptors2))
    _, rows1, rows2 = np.intersect1d(*numbers, assume_unique=True, return_indices=True)
    order = np.argsort(rows1)
    return Matches(np.stack([rows1[order], rows2[order]], axis=1).astype(np.int32))


def _searchable(features: Features | SearchableFeatures) -> SearchableFeatures:
    return features if isinstance(features, SearchableFeatures) else SearchableFeatures(features)


def check_descriptors(image1: Features | SearchableFeatures, image2: Features | SearchableFeatures) -> None:
    """Raises ValueError where descriptors cannot be compared with each other, or not exactly."""
    if image1.kind != image2.kind:
        raise ValueError(f"descriptors must be of one kind, got {image1.kind.name} and {image2.kind.name}")
    lengths = image1.descriptors.shape[1], image2.descriptors.shape[1]
    if lengths[0] != lengths[1]:
        raise ValueError(f"descriptors must have the same length, got {lengths[0]} and {lengths[1]}")
    if image1.kind in _DESCRIPTOR_NORM and 2 * lengths[0] * 255**2 >= _EXACT_BELOW:
        raise ValueError(f"descriptors may have up to 128 dimensions, got {lengths[0]}")


def _accepted(
    best: Num[np.ndarray, " N"], second: Num[np.ndarray, " N"], ratio: float, largest: float
) -> Bool[np.ndarray, " N"]:
    """Distances to the nearest and the second nearest that make a match; beyond all limits where there is none."""
    return (best < ratio * second.astype(np.float64)) & (best <= largest)


def _two_nearest(image1: SearchableFeatures, image2: SearchableFeatures, config: MatchingConfig) -> Nearest:
    if len(image1) * len(image2) < max(1, config.exact_below**2):
        return _nearest_of_all(image1.descriptors, image2.descriptors)
    return _nearest_in_cells(image1.cells, image2.cells, config.cells_searched)


def _nearest_of_all(descriptors1: np.ndarray, descriptors2: np.ndarray) -> Nearest:
    a, b = (descriptors.astype(np.float32) for descriptors in (descriptors1, descriptors2))
    squared1, squared2 = (np.einsum("ij,ij->i", x, x) for x in (a, b))
    found = (*_nothing_found(len(a)), *_nothing_found(len(b)))
    for start in range(0, len(a), _BLOCK_ROWS):
        dots = a[start : start + _BLOCK_ROWS] @ b.T
        _kernels.scan_block(dots, start, squared1, squared2, *found)
    return found


def _nearest_in_cells(a: Cells, b: Cells, count: int) -> Nearest:
    """Each descriptor of `a` meets those in its nearest cells of `b`; for both directions, that is the table.

    Rows are counted in the order of the cells on both sides until the end, so that neighbours in a loop are
    neighbours in memory.
    """
    cells = b.nearest(a.descriptors, count)
    starts, order = np.empty_like(b.starts), np.empty(cells.size, np.int32)
    _kernels.group(cells.ravel(), starts, order)
    seekers = order // cells.shape[1]
    rows = np.empty((int(np.diff(starts).max()), a.descriptors.shape[1]), np.float32)
    found = (*_nothing_found(len(a.order)), *_nothing_found(len(b.order)))
    for k in range(len(b.starts) - 1):
        mine, first, last = seekers[starts[k] : starts[k + 1]], int(b.starts[k]), int(b.starts[k + 1])
        if len(mine) and first < last:
            _kernels.gather(a.descriptors, mine, rows)
            dots = rows[: len(mine)] @ b.descriptors[first:last].T
            _kernels.scan_cell(dots, mine, first, a.squared, b.squared, *found)
    return *_by_feature(found[:3], a.order, b.order), *_by_feature(found[3:], b.order, a.order)


def _by_feature(found: tuple[np.ndarray, ...], order: np.ndarray, other_order: np.ndarray) -> tuple[np.ndarray, ...]:
    """From the order of cells to that of features, for the rows and for the indices that they hold."""
    best, second, index = found
    by_feature = tuple(np.empty_like(column) for column in found)
    by_feature[0][order], by_feature[1][order] = best, second
    by_feature[2][order] = np.where(index >= 0, other_order[index], -1)
    return by_feature


def _nothing_found(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.full(count, np.inf, np.float32), np.full(count, np.inf, np.float32), np.full(count, -1, np.int32)
