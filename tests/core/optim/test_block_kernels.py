from __future__ import annotations

import numba as nb
import numpy as np

from sfm.core.optim._block_kernels import (
    copy_coupling,
    couple_pose,
    couple_shared,
    set_coupling,
    subtract_product,
    subtract_upper,
)


@nb.njit
def compiled(C, a, W, X, Y, Z, side, diagonal, B, n, u, m, g):
    subtract_product(C, 1, a, W, 0)
    subtract_upper(C, 2, a, W, 0)
    couple_pose(W, 1, Y, Z, side, diagonal, 1, n, 0, u, m, g)
    couple_shared(W, 2, X, side, 0, B, 2, m, g)
    set_coupling(W, 3, n, 1, u)
    copy_coupling(W, 4, B, 1)


def arguments(rng):
    C, W, X, Y, Z, side, diagonal, B, n = (
        rng.normal(size=shape)
        for shape in ((4, 6, 8), (6, 3, 8), (3, 8), (3, 8), (3, 8), (2, 8), (2, 8), (3, 3, 6), (2, 6))
    )
    a, u, m, g = (tuple(rng.normal(size=size).tolist()) for size in (18, 3, 6, 3))
    return C, a, W, X, Y, Z, side, diagonal, B, n, u, m, g


def without_padding(array):
    return array[..., :6]


def test_the_compiled_products_equal_the_plain_ones_and_touch_nothing_else(rng):
    given = arguments(rng)
    got, expected = ([x.copy() if isinstance(x, np.ndarray) else x for x in given] for _ in range(2))
    compiled(*got)
    compiled.py_func(*expected)
    for mine, theirs in zip(got, expected, strict=True):
        if isinstance(mine, np.ndarray):
            np.testing.assert_allclose(without_padding(mine), without_padding(theirs), rtol=0, atol=1e-13)
    for k in (0, 3):
        np.testing.assert_array_equal(got[0][k], given[0][k])
    np.testing.assert_array_equal(got[2][5], given[2][5])
    np.testing.assert_array_equal(got[7][0], given[7][0])


def test_the_plain_products_are_those_of_matrices(rng):
    B, a = rng.normal(size=(2, 3, 8)), rng.normal(size=(6, 3))
    C = np.ones((2, 6, 8))
    subtract_product(C, 1, tuple(a.ravel()), B, 0)
    np.testing.assert_allclose(C[1], 1 - a @ B[0], atol=1e-14)
    subtract_upper(C, 1, tuple(a.ravel()), B, 0)
    np.testing.assert_allclose(C[1], 1 - np.r_[2 * a[:3], a[3:]] @ B[0], atol=1e-14)
    np.testing.assert_array_equal(C[0], 1)


def test_a_coupling_is_the_information_of_a_point_by_how_it_moves_against_the_pose(rng):
    *_, n, u, m, g = arguments(rng)
    N, M = (np.array(x)[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3) for x in (n[1], m))
    W, Y, Z = np.zeros((2, 3, 8)), np.zeros((3, 8)), np.zeros((3, 8))
    sides, diagonals = np.ones((2, 8)), np.ones((2, 8))
    couple_pose(W, 1, Y, Z, sides, diagonals, 0, n, 1, u, m, g)
    W, side, diagonal = W[1], sides[0], diagonals[0]
    for a in range(6):
        turn, shift = np.eye(6)[a, :3], np.eye(6)[a, 3:]
        moved = np.cross(turn, u) + shift
        np.testing.assert_allclose(W[:, a], N @ moved, atol=1e-14)
        np.testing.assert_allclose(Y[:, a], M @ N @ moved, atol=1e-13)
        np.testing.assert_allclose(Z[:, a], M @ N @ moved - moved, atol=1e-13)
        np.testing.assert_allclose(side[a], 1 + g @ M @ N @ moved, atol=1e-13)
        np.testing.assert_allclose(diagonal[a], 1 + moved @ N @ moved, atol=1e-13)
