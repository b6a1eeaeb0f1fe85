from __future__ import annotations

import numba as nb
import numpy as np

from sfm.core.optim import _block_kernels as blocks
from sfm.core.optim._block_kernels import (
    copy_coupling,
    couple_pose,
    couple_shared,
    set_coupling,
    subtract_product,
    subtract_upper,
)


@nb.njit
def compiled(C, a, W, Y, Z, side, diagonal, B, n, u, m, g):
    subtract_product(C[1], a, W[0])
    subtract_upper(C[2], a, W[0])
    couple_pose(W[1], Y[0], Z, side[0], diagonal, n, u, m, g)
    couple_shared(W[2], Y[1], side[1], B[2], m, g)
    set_coupling(W[3], n, u)
    copy_coupling(W[4], B[1])


def arguments(rng):
    C, W, Y, Z, side, diagonal, B = (
        rng.normal(size=shape) for shape in ((4, 6, 8), (6, 3, 8), (2, 3, 8), (3, 8), (2, 8), (8,), (3, 3, 6))
    )
    a, n, u, m, g = (tuple(rng.normal(size=size).tolist()) for size in (18, 6, 3, 6, 3))
    return C, a, W, Y, Z, side, diagonal, B, n, u, m, g


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


def test_the_plain_products_are_those_of_matrices(rng):
    B, a = rng.normal(size=(3, 8)), rng.normal(size=(6, 3))
    C = np.ones((6, 8))
    subtract_product(C, tuple(a.ravel()), B)
    np.testing.assert_allclose(C, 1 - a @ B, atol=1e-14)
    subtract_upper(C, tuple(a.ravel()), B)
    np.testing.assert_allclose(C, 1 - np.r_[2 * a[:3], a[3:]] @ B, atol=1e-14)


def test_a_coupling_is_the_information_of_a_point_by_how_it_moves_against_the_pose(rng):
    *_, n, u, m, g = arguments(rng)
    N, M = (np.array(x)[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3) for x in (n, m))
    W, Y, Z, side, diagonal = np.zeros((3, 8)), np.zeros((3, 8)), np.zeros((3, 8)), np.ones(8), np.ones(8)
    couple_pose(W, Y, Z, side, diagonal, n, u, m, g)
    for a in range(6):
        turn, shift = np.eye(6)[a, :3], np.eye(6)[a, 3:]
        moved = np.cross(turn, u) + shift
        np.testing.assert_allclose(W[:, a], N @ moved, atol=1e-14)
        np.testing.assert_allclose(Y[:, a], M @ N @ moved, atol=1e-13)
        np.testing.assert_allclose(Z[:, a], M @ N @ moved - moved, atol=1e-13)
        np.testing.assert_allclose(side[a], 1 + g @ M @ N @ moved, atol=1e-13)
        np.testing.assert_allclose(diagonal[a], 1 + moved @ N @ moved, atol=1e-13)
    assert not blocks.WIDTH % 8
