"""Covariances of points from those of what sees them; the mathematics is in `covariance`."""

from __future__ import annotations

import numba as nb
import numpy as np

from sfm.core.optim._block_kernels import WIDTH, set_coupling


@nb.njit(cache=True, nogil=True, error_model="numpy")
def point_covariances(
    free, offsets, starts, slot, N, shared_starts, shared_slot, B, centers, X, V, M, sigma, condition, out
):  # fmt: skip
    """Fills `out` (P, 3, 3) with M + M Eᵀ Σ E M; NaN for points that are free and not determined.

    Args:
        offsets: (P + 1,) observations of the points.
        starts … B, centers, X: couplings as in `sfm.core.optim.schur`.
        V, M: information (P, 6) about each point alone, and its inverse.
        sigma: (6 rows, 6 rows).
    """
    widest = 1
    for p in range(len(out)):
        widest = max(widest, 6 * (starts[p + 1] - starts[p] + shared_starts[p + 1] - shared_starts[p]))
    rows, T, U = np.empty(widest, np.int64), np.empty((3, widest)), np.empty((3, widest))
    m, w = np.empty((3, 3)), np.empty((1, 3, WIDTH))
    for p in range(len(out)):
        if not free[p]:
            continue
        traces = (V[p, 0] + V[p, 3] + V[p, 5]) * (M[p, 0] + M[p, 3] + M[p, 5])
        if offsets[p + 1] == offsets[p] or not traces < condition:
            out[p] = np.nan
            continue
        size = 0
        for e in range(starts[p], starts[p + 1]):
            s = slot[e]
            u = (X[p, 0] - centers[s, 0], X[p, 1] - centers[s, 1], X[p, 2] - centers[s, 2])
            set_coupling(w, 0, N, e, u)
            for a in range(6):
                rows[size] = 6 * s + a
                T[0, size], T[1, size], T[2, size] = w[0, 0, a], w[0, 1, a], w[0, 2, a]
                size += 1
        for e in range(shared_starts[p], shared_starts[p + 1]):
            for a in range(6):
                rows[size] = 6 * shared_slot[e] + a
                T[0, size], T[1, size], T[2, size] = B[e, 0, a], B[e, 1, a], B[e, 2, a]
                size += 1
        m[0, 0], m[0, 1], m[0, 2] = M[p, 0], M[p, 1], M[p, 2]
        m[1, 0], m[1, 1], m[1, 2] = M[p, 1], M[p, 3], M[p, 4]
        m[2, 0], m[2, 1], m[2, 2] = M[p, 2], M[p, 4], M[p, 5]
        for i in range(3):
            for a in range(size):
                U[i, a] = m[i, 0] * T[0, a] + m[i, 1] * T[1, a] + m[i, 2] * T[2, a]
        out[p] = m
        for a in range(size):
            x = y = z = 0.0
            for b in range(size):
                s = sigma[rows[a], rows[b]]
                x += s * U[0, b]
                y += s * U[1, b]
                z += s * U[2, b]
            for i in range(3):
                out[p, i, 0] += U[i, a] * x
                out[p, i, 1] += U[i, a] * y
                out[p, i, 2] += U[i, a] * z
