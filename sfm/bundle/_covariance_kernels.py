"""Covariances of points from those of what sees them; the mathematics is in `covariance`."""

from __future__ import annotations

import numba as nb
import numpy as np

from sfm.core.optim._block_kernels import WIDTH, set_coupling


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _find(columns, first, last, column):
    """Where `column` is among the ascending `columns[first:last]`; `last` where it is not."""
    end = last
    while first < last:
        middle = (first + last) >> 1
        if columns[middle] < column:
            first = middle + 1
        else:
            last = middle
    return first if first < end and columns[first] == column else end


@nb.njit(cache=True, nogil=True, error_model="numpy")
def point_covariances(
    first, last, free, offsets, starts, slot, N, shared_starts, shared_slot, B, centers, X, V, M,
    block_offsets, columns, sigma, condition, out,
):  # fmt: skip
    """Fills rows `first:last` of `out` (P, 3, 3) with M + M Eᵀ Σ E M; NaN for free points that are not determined.

    Args:
        offsets: (P + 1,) observations of the points.
        starts … B, centers, X: couplings as in `sfm.core.optim.schur`.
        V, M: information (P, 6) about each point alone, and its inverse.
        block_offsets, columns, sigma: blocks (B, 6, 6) of the lower triangle of Σ, with one for all pairs of rows that
            a point couples to; a missing one makes the point NaN.
    """
    widest = 1
    for p in range(first, last):
        widest = max(widest, starts[p + 1] - starts[p] + shared_starts[p + 1] - shared_starts[p])
    rows, U = np.empty(widest, np.int64), np.empty((widest, 3, 6))
    m, w, t = np.empty((3, 3)), np.empty((1, 3, WIDTH)), np.empty((3, 6))
    for p in range(first, last):
        if not free[p]:
            continue
        traces = (V[p, 0] + V[p, 3] + V[p, 5]) * (M[p, 0] + M[p, 3] + M[p, 5])
        if offsets[p + 1] == offsets[p] or not traces < condition:
            out[p] = np.nan
            continue
        m[0, 0], m[0, 1], m[0, 2] = M[p, 0], M[p, 1], M[p, 2]
        m[1, 0], m[1, 1], m[1, 2] = M[p, 1], M[p, 3], M[p, 4]
        m[2, 0], m[2, 1], m[2, 2] = M[p, 2], M[p, 4], M[p, 5]
        own = starts[p + 1] - starts[p]
        size = own + shared_starts[p + 1] - shared_starts[p]
        for k in range(size):
            if k < own:
                e = starts[p] + k
                s = slot[e]
                set_coupling(w, 0, N, e, (X[p, 0] - centers[s, 0], X[p, 1] - centers[s, 1], X[p, 2] - centers[s, 2]))
                rows[k] = s
            else:
                e = shared_starts[p] + k - own
                rows[k] = shared_slot[e]
                w[0, :, :6] = B[e]
            for i in range(3):
                for a in range(6):
                    U[k, i, a] = m[i, 0] * w[0, 0, a] + m[i, 1] * w[0, 1, a] + m[i, 2] * w[0, 2, a]
        for i in range(3):
            for j in range(3):
                out[p, i, j] = m[i, j]
        for k in range(size):
            end = block_offsets[rows[k] + 1]
            for other in range(k + 1):
                n = _find(columns, block_offsets[rows[k]], end, rows[other])
                if n == end:
                    out[p] = np.nan
                    continue
                for i in range(3):
                    for a in range(6):
                        total = 0.0
                        for b in range(6):
                            total += U[k, i, b] * sigma[n, b, a]
                        t[i, a] = total
                for i in range(3):
                    for j in range(3):
                        total = 0.0
                        for a in range(6):
                            total += t[i, a] * U[other, j, a]
                        out[p, i, j] += total
                        if other < k:
                            out[p, j, i] += total
