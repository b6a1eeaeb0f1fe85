"""Covariances of points against dense matrices."""

from __future__ import annotations

import numpy as np

from sfm.bundle import _covariance_kernels as kernels
from sfm.core.geometry.rotation import skew
from sfm.core.optim.block_pattern import BlockPattern

POINTS, POSES, ROWS = 20, 4, 6
SIX = np.triu_indices(3)


def test_covariances_of_points_are_those_of_dense_matrices(rng):
    seen = [np.flatnonzero(rng.random(POSES) < 0.7) for _ in range(POINTS)]
    also = [POSES + np.flatnonzero(rng.random(ROWS - POSES) < 0.5) for _ in range(POINTS)]
    seen[11], also[11] = seen[11][:0], also[11][:0]
    starts, shared_starts = (np.cumsum([0, *map(len, rows)]) for rows in (seen, also))
    slot, shared_slot = (np.concatenate(rows).astype(np.int32) for rows in (seen, also))
    offsets = 2 * starts
    centers, X = rng.normal(size=(POSES, 3)), rng.normal(size=(POINTS, 3))
    J = rng.normal(size=(len(slot), 5, 3))
    N, B = np.einsum("kia,kib->kab", J, J), rng.normal(size=(len(shared_slot), 3, 6))
    J = rng.normal(size=(POINTS, 5, 3))
    J[4, :, 2] = J[4, :, 1] + 1e-4 * J[4, :, 2]  # hardly determined
    V = np.einsum("kia,kib->kab", J, J)
    M, free = np.linalg.inv(V), np.ones(POINTS, bool)
    free[6] = False
    J = rng.normal(size=(6 * ROWS, 6 * ROWS))
    sigma, out = J @ J.T, np.zeros((POINTS, 3, 3))
    full = BlockPattern.full(ROWS)
    blocks = sigma.reshape(ROWS, 6, ROWS, 6).swapaxes(1, 2)[np.tril_indices(ROWS)]
    kernels.point_covariances(
        0, POINTS, free, offsets, starts, slot, np.ascontiguousarray(N[:, *SIX]), shared_starts, shared_slot, B,
        centers, X, np.ascontiguousarray(V[:, *SIX]), np.ascontiguousarray(M[:, *SIX]), full.offsets, full.columns,
        np.ascontiguousarray(blocks), 1e6, out,
    )  # fmt: skip
    for p in range(POINTS):
        if p == 6:
            assert not np.any(out[p])
            continue
        if p in (4, 11):
            assert np.isnan(out[p]).all()
            continue
        E = np.zeros((6 * ROWS, 3))
        for e in range(starts[p], starts[p + 1]):
            s = slot[e]
            E[6 * s : 6 * s + 6] += (N[e] @ np.c_[-skew(X[p] - centers[s]), np.eye(3)]).T
        for e in range(shared_starts[p], shared_starts[p + 1]):
            E[6 * shared_slot[e] : 6 * shared_slot[e] + 6] += B[e].T
        expected = M[p] + M[p] @ E.T @ sigma @ E @ M[p]
        np.testing.assert_allclose(out[p], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
