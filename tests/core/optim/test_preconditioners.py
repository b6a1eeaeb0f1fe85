from __future__ import annotations

import numpy as np
import pytest

from sfm.core.optim.block_pattern import BlockPattern
from sfm.core.optim.conjugate_gradients import conjugate_gradients
from sfm.core.optim.preconditioners import clusters_of, restricted_pattern
from sfm.core.optim.sparse_cholesky import SparseCholesky


def rows_of(pattern):
    return np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))


def poses_and_points(rng, groups=4, size=8, points=60):
    """The reduced matrix of images in groups that share points; some points are seen by two groups."""
    n = groups * size
    U, E = np.zeros((n, 6, n, 6)), np.zeros((n, 6, n, 6))
    for p in range(groups * points):
        group = p % groups
        seen = group * size + rng.choice(size, 4, replace=False)
        if p % 15 == 0:
            seen = (seen + size // 2) % n
        A, B = rng.normal(size=(4, 2, 6)), rng.normal(size=(4, 2, 3))
        W = np.einsum("kai,kaj->kij", A, B)
        V = np.einsum("kai,kaj->ij", B, B)
        for k, i in enumerate(seen):
            U[i, :, i] += A[k].T @ A[k]
            for m, j in enumerate(seen):
                E[i, :, j] += W[k] @ np.linalg.solve(V, W[m].T)
    U, E = U.reshape(6 * n, -1), E.reshape(6 * n, -1)
    U += 1e-3 * np.eye(6 * n)
    return U - E


def blocks_of(S, pattern):
    return S.reshape(pattern.rows, 6, pattern.rows, 6)[rows_of(pattern), :, pattern.columns].copy()


def steps(S, side, precondition):
    found = conjugate_gradients(lambda p: S @ p, side, precondition, residual_tolerance=1e-8)
    assert found.reason == "residual"
    return found.iterations


def test_better_preconditioners_need_fewer_steps(rng):
    S = poses_and_points(rng)
    n, held = len(S) // 6, np.zeros(len(S), bool)
    side, none, full = rng.normal(size=len(S)), np.zeros(len(S)), BlockPattern.full(n)
    taken = []
    for clusters in (np.arange(n), np.arange(n) // 8):  # block Jacobi, and the groups
        near, numbers = restricted_pattern(full, clusters)
        factor = SparseCholesky(near, held)
        assert factor.factor(blocks_of(S, full)[numbers], none)
        taken.append(steps(S, side, factor.solve))
    assert taken[1] < taken[0] < steps(S, side, lambda r: r.copy())


def naive_clusters(rows, pairs, largest):
    sets = [{i} for i in range(rows)]
    for i, j in pairs:
        one, other = (next(s for s in sets if k in s) for k in (i, j))
        if one is not other and len(one) + len(other) <= largest:
            sets.remove(one)
            sets.remove(other)
            sets.append(one | other)
    return {frozenset(s) for s in sets}


@pytest.mark.parametrize("largest", [1, 3, 10, 100])
def test_clusters_equal_those_of_plain_joining(rng, largest):
    pattern = BlockPattern.of_pairs(50, *rng.integers(0, 50, (2, 90)))
    weights = rng.integers(0, 20, len(pattern.columns)).astype(float)
    labels = clusters_of(pattern, weights, largest)
    rows = rows_of(pattern)
    order = [k for k in np.argsort(-weights, kind="stable") if rows[k] != pattern.columns[k] and weights[k] > 0]
    expected = naive_clusters(50, [(rows[k], pattern.columns[k]) for k in order], largest)
    assert {frozenset(np.flatnonzero(labels == c).tolist()) for c in range(labels.max() + 1)} == expected
    assert np.bincount(labels).max() <= largest


def test_a_restricted_pattern_has_all_pairs_within_clusters_and_no_others(rng):
    pattern = BlockPattern.of_pairs(40, *rng.integers(0, 40, (2, 300)))
    clusters = rng.integers(0, 5, 40)
    near, numbers = restricted_pattern(pattern, clusters)
    rows = rows_of(pattern)
    expected = [k for k in range(len(rows)) if clusters[rows[k]] == clusters[pattern.columns[k]]]
    assert numbers.tolist() == expected
    np.testing.assert_array_equal(rows_of(near), rows[numbers])
    np.testing.assert_array_equal(near.columns, pattern.columns[numbers])
    assert restricted_pattern(BlockPattern.full(0), np.zeros(0, int))[0].rows == 0
