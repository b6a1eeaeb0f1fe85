"""Covariances of points from those of what sees them; the mathematics is in `covariance`."""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True, error_model="numpy")
def point_covariances(
    free, offsets, starts, slot, coupling_offsets, coupling_slot, W, B, V, M, sigma, poses, condition, out
):  # fmt: skip
    """Fills `out` (P, 3, 3) with M + M Eᵀ Σ E M; NaN for points that are free and not determined.

    Args:
        slot, W: row of the pose and transposed coupling (n, 3, 6) of each observation, used from `starts` (P,) on.
        coupling_offsets, coupling_slot, B: the same for cameras, (P + 1,), (E,), (E, 3, K).
        V, M: information (P, 6) about each point alone, and its inverse.
        sigma: (N, N); poses first, six entries each, `poses` of them, then cameras, K each.
    """
    K, widest = B.shape[2], 0
    for p in range(len(out)):
        size = 6 * (offsets[p + 1] - starts[p]) + K * (coupling_offsets[p + 1] - coupling_offsets[p])
        widest = max(widest, size)
    rows, T, U = np.empty(widest, np.int64), np.empty((3, widest)), np.empty((3, widest))
    m = np.empty((3, 3))
    for p in range(len(out)):
        if not free[p]:
            continue
        traces = (V[p, 0] + V[p, 3] + V[p, 5]) * (M[p, 0] + M[p, 3] + M[p, 5])
        if offsets[p + 1] == offsets[p] or not traces < condition:
            out[p] = np.nan
            continue
        size = 0
        for o in range(starts[p], offsets[p + 1]):
            for a in range(6):
                rows[size] = 6 * slot[o] + a
                T[0, size], T[1, size], T[2, size] = W[o, 0, a], W[o, 1, a], W[o, 2, a]
                size += 1
        for e in range(coupling_offsets[p], coupling_offsets[p + 1]):
            for a in range(K):
                rows[size] = 6 * poses + K * coupling_slot[e] + a
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
