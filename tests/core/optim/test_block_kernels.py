from __future__ import annotations

import numba as nb
import numpy as np

from sfm.core.optim._block_kernels import add_combination, add_gram, set_product, subtract_product


@nb.njit
def compiled(C, A, B, H, J, W, P):
    subtract_product(C, A, B)
    add_gram(H, J)
    set_product(W, P, J)


def test_the_compiled_products_equal_the_plain_ones(rng):
    shapes = ((6, 6), (6, 3), (3, 6), (6, 6), (2, 6), (3, 6), (2, 3))
    C, A, B, H, J, W, P = (rng.normal(size=shape) for shape in shapes)
    compiled(got_C := C.copy(), A, B, got_H := H.copy(), J, W, P)
    subtract_product(C, A, B)
    add_gram(H, J)
    np.testing.assert_allclose(got_C, C, rtol=0, atol=1e-14)
    np.testing.assert_allclose(got_H, H, rtol=0, atol=1e-14)
    got_W = W.copy()
    set_product(W, P, J)
    np.testing.assert_allclose(got_W, W, rtol=0, atol=1e-14)


def test_rows_of_larger_arrays_are_changed_in_place(rng):
    @nb.njit
    def second(many, A, B):
        subtract_product(many[1], A, B)

    many, A, B = np.zeros((3, 6, 6)), rng.normal(size=(6, 3)), rng.normal(size=(3, 6))
    second(many, A, B)
    assert np.all(many[[0, 2]] == 0)
    np.testing.assert_allclose(many[1], -A @ B, rtol=0, atol=1e-14)


def test_only_the_first_six_of_a_row_are_changed(rng):
    @nb.njit
    def second(rows, x, y, J):
        add_combination(rows[1], x, y, J)

    rows, J = np.zeros((3, 9)), rng.normal(size=(2, 6))
    plain = rows.copy()
    second(rows, 2.0, -3.0, J)
    add_combination(plain[1], 2.0, -3.0, J)
    np.testing.assert_allclose(rows, plain, rtol=0, atol=1e-14)
    assert np.count_nonzero(rows) == 6
