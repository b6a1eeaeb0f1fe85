from __future__ import annotations

import numpy as np
import pytest

from sfm.core.optim import schur
from sfm.core.optim.block_pattern import BlockPattern


def packed(blocks):
    """Symmetric 3×3 blocks as (xx, xy, xz, yy, yz, zz)."""
    return np.ascontiguousarray(blocks[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


def unpacked(rows):
    return rows[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def test_inverse_blocks_equal_numpy(rng):
    J = rng.normal(size=(50, 6, 3))
    blocks = np.einsum("pki,pkj->pij", J, J)
    for damping in (0.0, 1e-4, 1e3):
        M = np.empty((50, 6))
        schur.invert_blocks(0, 50, packed(blocks), damping, M)
        damped = blocks + damping * np.einsum("pii,ij->pij", blocks, np.eye(3))
        np.testing.assert_allclose(unpacked(M), np.linalg.inv(damped), rtol=1e-9, atol=1e-12 * np.abs(M).max())


def test_inverses_of_singular_blocks_are_finite_and_positive_semidefinite(rng):
    J = rng.normal(size=(40, 2, 3))
    J[20:, 1] = J[20:, 0]
    blocks = np.concatenate([np.einsum("pki,pkj->pij", J, J), np.zeros((1, 3, 3))])
    for damping in (0.0, 1e-12, 1e-4):
        M = np.empty((41, 6))
        schur.invert_blocks(0, 41, packed(blocks), damping, M)
        assert np.all(np.isfinite(M))
        values = np.linalg.eigvalsh(unpacked(M))
        assert np.all(values >= -1e-12 * values[:, -1:])
        assert np.all(M[40] == 0)


def skew(u):
    return np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])


class Problem:
    """Couplings as the kernels want them, and the dense matrices they stand for."""

    def __init__(self, rng, points=30, poses=5, shared=2):
        self.points, self.poses, self.rows = points, poses, poses + shared
        seen = [np.flatnonzero(rng.random(poses) < 0.6) for _ in range(points)]
        also = [poses + np.flatnonzero(rng.random(shared) < 0.6) for _ in range(points)]
        self.starts = np.cumsum([0, *map(len, seen)])
        self.slot = np.concatenate(seen).astype(np.int32)
        self.shared_starts = np.cumsum([0, *map(len, also)])
        self.shared_slot = np.concatenate(also).astype(np.int32)
        J = rng.normal(size=(len(self.slot), 4, 3))
        self.N = packed(np.einsum("pki,pkj->pij", J, J))
        self.B = rng.normal(size=(len(self.shared_slot), 3, 6))
        self.centers, self.X = rng.normal(size=(poses, 3)), rng.normal(size=(points, 3))
        self.M = packed(np.einsum("pki,pkj->pij", *[rng.normal(size=(points, 4, 3))] * 2))
        self.M[7] = 0  # a point that does not move
        self.g = rng.normal(size=(points, 3))
        self.g[7] = 0

    @property
    def couplings(self):
        return schur.Couplings(self.starts, self.slot, self.N, self.shared_starts, self.shared_slot, self.B)

    def eliminate(self, pattern, ranges, narrow=False):
        blocks, side = np.zeros((len(pattern.columns), 6, 8)), np.zeros((self.rows, 8))
        diagonal = np.zeros((self.rows, 8))
        for first, last in ranges:
            schur.eliminate(
                first, last, narrow, *self.couplings, self.centers, self.X, self.M, self.g, pattern.offsets,
                pattern.columns, blocks, side, diagonal,
            )  # fmt: skip
        return blocks[:, :, :6], side[:, :6], diagonal[:, :6]

    def dense(self):
        """U of the poses, S and the right-hand side."""
        U, E = np.zeros((6 * self.rows, 6 * self.rows)), np.zeros((6 * self.rows, 3 * self.points))
        inverse = np.zeros((3 * self.points, 3 * self.points))
        for p, m in enumerate(unpacked(self.M)):
            mine = slice(3 * p, 3 * p + 3)
            inverse[mine, mine] = m
            for e in range(self.starts[p], self.starts[p + 1]):
                s, N = self.slot[e], unpacked(self.N[e : e + 1])[0]
                T = np.c_[-skew(self.X[p] - self.centers[s]), np.eye(3)]
                U[6 * s : 6 * s + 6, 6 * s : 6 * s + 6] += T.T @ N @ T
                E[6 * s : 6 * s + 6, mine] += (N @ T).T
            for e in range(self.shared_starts[p], self.shared_starts[p + 1]):
                s = self.shared_slot[e]
                E[6 * s : 6 * s + 6, mine] += self.B[e].T
        return U, U - E @ inverse @ E.T, E @ inverse @ self.g.ravel()


def assembled(pattern, blocks):
    S = np.zeros((6 * pattern.rows, 6 * pattern.rows))
    for i in range(pattern.rows):
        for k in range(pattern.offsets[i], pattern.offsets[i + 1]):
            j = pattern.columns[k]
            S[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = blocks[k]
    return np.tril(S)


@pytest.mark.parametrize("ranges", [[(0, 7)], [(0, 3), (3, 6), (6, 7)]])
def test_elimination_equals_the_dense_schur_complement(rng, ranges):
    problem, pattern = Problem(rng), BlockPattern.full(7)
    blocks, side, diagonal = problem.eliminate(pattern, ranges)
    U, S, expected = problem.dense()
    np.testing.assert_allclose(assembled(pattern, blocks), np.tril(S), atol=1e-10)
    np.testing.assert_allclose(side.ravel(), expected, atol=1e-10)
    np.testing.assert_allclose(diagonal.ravel(), np.diag(U), atol=1e-10)


def test_narrow_shared_rows_give_the_same_blocks(rng):
    problem, pattern = Problem(rng), BlockPattern.full(7)
    problem.B[:, :, 3:] = 0
    for wide, narrow in zip(*(problem.eliminate(pattern, [(0, 7)], flag) for flag in (False, True)), strict=True):
        np.testing.assert_array_equal(wide, narrow)


def test_a_pattern_with_fewer_blocks_gets_those_it_has(rng):
    problem, pattern = Problem(rng), BlockPattern.of_pairs(7, np.array([2, 5, 6]), np.array([0, 3, 4]))
    blocks, side, _ = problem.eliminate(pattern, [(0, 7)])
    _, S, expected = problem.dense()
    np.testing.assert_allclose(side.ravel(), expected, atol=1e-10)
    for i in range(7):
        for k in range(pattern.offsets[i], pattern.offsets[i + 1]):
            j, kept = pattern.columns[k], slice(None) if pattern.columns[k] < i else np.tril_indices(6)
            wanted = S[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
            np.testing.assert_allclose(blocks[k][kept], wanted[kept], atol=1e-10)


def test_the_product_without_the_matrix_equals_that_with_it(rng):
    problem = Problem(rng)
    x, y = rng.normal(size=(7, 6)), np.zeros((7, 6))
    for first, last in ((0, 11), (11, 30)):
        schur.multiply(first, last, *problem.couplings, problem.centers, problem.X, problem.M, x, y)
    _, S, _ = problem.dense()
    np.testing.assert_allclose(y.ravel(), S @ x.ravel(), atol=1e-10)
