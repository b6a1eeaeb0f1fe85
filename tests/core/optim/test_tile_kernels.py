from __future__ import annotations

import numba as nb
import numpy as np
import pytest

from sfm.core.optim import _tile_kernels as tiles
from sfm.core.optim._tile_kernels import (
    add_run,
    solve_tile,
    subtract_strip_product,
    subtract_strip_vector,
    subtract_two_strip_products,
    subtract_vector_strip,
)


@nb.njit
def compiled(C, A, k, T):
    subtract_strip_product(C, 64, A, 0, 8 * k, k)
    subtract_two_strip_products(C, 0, 192, A, 8 * k, 16 * k, 0, k)
    solve_tile(T, 64, 0)


@pytest.mark.parametrize("k", [0, 1, 7, 24])
def test_the_compiled_products_equal_the_plain_ones(rng, k):
    C, A, T = rng.normal(size=256), rng.normal(size=24 * k), rng.normal(size=192)
    compiled(got_C := C.copy(), A, k, got_T := T.copy())
    compiled.py_func(C, A, k, T)
    np.testing.assert_allclose(got_C, C, rtol=0, atol=1e-13)
    np.testing.assert_allclose(got_T, T, rtol=1e-12, atol=1e-12 * np.abs(T).max())


def test_the_products_are_what_they_say(rng):
    C, X, Y = rng.normal(size=(8, 8)), rng.normal(size=(8, 5)), rng.normal(size=(8, 5))
    flat = C.T.ravel().copy()
    subtract_strip_product(flat, 0, np.concatenate([X.T.ravel(), Y.T.ravel()]), 0, 40, 5)
    np.testing.assert_allclose(flat.reshape(8, 8).T, C - X @ Y.T, atol=1e-14)
    D = np.tril(rng.normal(size=(8, 8))) + 8 * np.eye(8)
    stored = D - np.diag(np.diag(D)) + np.diag(1 / np.diag(D))
    flat = np.concatenate([stored.T.ravel(), C.T.ravel()])
    solve_tile(flat, 64, 0)
    np.testing.assert_allclose(flat[64:].reshape(8, 8).T, C @ np.linalg.inv(D).T, atol=1e-14)


def test_narrow_registers_give_the_same_bits_as_wide_ones(rng, monkeypatch):
    C, A = rng.normal(size=128), rng.normal(size=24 * 50)
    results = []
    for wide in (False, True):
        monkeypatch.setattr(tiles, "_WIDE", wide)

        @nb.njit
        def both(C, A, k):
            subtract_two_strip_products(C, 0, 64, A, 0, 8 * k, 16 * k, k)

        both(result := C.copy(), A, 50)
        results.append(result)
    np.testing.assert_array_equal(*results)


@pytest.mark.parametrize("n", range(1, 9))
def test_strips_times_vectors_and_runs_equal_the_plain_ones(rng, n):
    @nb.njit
    def both(x, A, y, k):
        subtract_strip_vector(x, 40, A, 8, k)
        subtract_vector_strip(y, 40, A, 8, k)
        add_run(x, 3, A, 5, k)

    A, x, y = rng.normal(size=8 * n + 16), rng.normal(size=48), rng.normal(size=48)
    both(got_x := x.copy(), A, got_y := y.copy(), n)
    both.py_func(x, A, y, n)
    np.testing.assert_allclose(got_x, x, atol=1e-14)
    np.testing.assert_allclose(got_y, y, atol=1e-14)


def test_a_run_changes_nothing_beside_it(rng):
    @nb.njit
    def run(C, A, n):
        add_run(C, 2, A, 0, n)

    for n in range(9):
        run(C := np.zeros(12), np.ones(8), n)
        np.testing.assert_array_equal(C, (np.arange(12) >= 2) & (np.arange(12) < 2 + n))
