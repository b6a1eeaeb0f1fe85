from __future__ import annotations

import numba as nb
import numpy as np

from sfm.core.optim._block_kernels import add_combination, set_product, subtract_product


@nb.njit
def compiled(C, a, B, D, m, c, f):
    subtract_product(C[1], a, B)
    set_product(D, m, B)
    add_combination(c, f, B)


def test_the_compiled_products_equal_the_plain_ones_and_touch_nothing_else(rng):
    C, B, D, c = (rng.normal(size=shape) for shape in ((3, 6, 8), (3, 8), (3, 8), (8,)))
    a, m, f = (tuple(rng.normal(size=size)) for size in (18, 6, 3))
    compiled(got_C := C.copy(), a, B, got_D := D.copy(), m, got_c := c.copy(), f)
    subtract_product(C[1], a, B)
    set_product(D, m, B)
    add_combination(c, f, B)
    np.testing.assert_allclose(got_C, C, rtol=0, atol=1e-14)
    np.testing.assert_allclose(got_D, D, rtol=0, atol=1e-14)
    np.testing.assert_allclose(got_c, c, rtol=0, atol=1e-14)


def test_the_plain_products_are_those_of_matrices(rng):
    B, a, m, f = rng.normal(size=(3, 8)), rng.normal(size=(6, 3)), rng.normal(size=(3, 3)), rng.normal(size=3)
    m = m + m.T
    C, D, c = np.ones((6, 8)), np.ones((3, 8)), np.ones(8)
    subtract_product(C, tuple(a.ravel()), B)
    set_product(D, tuple(m[np.triu_indices(3)]), B)
    add_combination(c, tuple(f), B)
    np.testing.assert_allclose(C, 1 - a @ B, atol=1e-14)
    np.testing.assert_allclose(D, m @ B, atol=1e-14)
    np.testing.assert_allclose(c, 1 + f @ B, atol=1e-14)
