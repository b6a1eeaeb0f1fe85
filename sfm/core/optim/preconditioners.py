"""Matrices M ≈ S that are easy to solve with, for conjugate gradients: cluster Jacobi.

Of S are kept the blocks of pairs within *clusters*, sets of rows that are strongly coupled among themselves;
`SparseCholesky` factors the pattern that `restricted_pattern` leaves. Clusters of one row each are block Jacobi.

A few terms of the power series of S⁻¹ on top halve the steps, but each term costs a product with S, of which conjugate
gradients make more by themselves: on streets of 1,000 images they took twice the time.

Reference:
    Kushal & Agarwal, Visibility based preconditioning for bundle adjustment, CVPR 2012.
    Weber, Demmel, Chan & Cremers, Power bundle adjustment for large-scale 3D reconstruction, CVPR 2023 (the series).
"""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray
from sfm.core.optim import _iterative_kernels as kernels
from sfm.core.optim.block_pattern import BlockPattern


def clusters_of(pattern: BlockPattern, weights: FloatArray, largest: int) -> np.ndarray:
    """The cluster (N,) of each row, of at most `largest` rows: strong couplings first, sets are joined by them.

    Args:
        weights: (B,) how strongly the rows of each block are coupled, such as the points that two images share;
            those on the diagonal do not count, nor do couplings of weight 0.
    """
    rows = np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))
    pairs = np.flatnonzero((rows != pattern.columns) & (weights > 0))
    order = pairs[np.argsort(-weights[pairs], kind="stable")]
    sets = kernels.join_pairs(rows, pattern.columns, order, pattern.rows, largest)
    return np.unique(sets, return_inverse=True)[1]


def restricted_pattern(pattern: BlockPattern, clusters: np.ndarray) -> tuple[BlockPattern, np.ndarray]:
    """The pattern of pairs within one cluster, and the numbers (B',) of its blocks in the whole pattern."""
    rows = np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))
    within = clusters[rows] == clusters[pattern.columns]
    counts = np.bincount(rows[within], minlength=pattern.rows)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return BlockPattern(offsets, pattern.columns[within]), np.flatnonzero(within)
