from __future__ import annotations

import numpy as np
import pytest

from sfm.core.optim import block_product as block_product_module
from sfm.core.optim.block_pattern import BlockPattern
from sfm.core.optim.block_product import block_product
from sfm.core.optim.conjugate_gradients import conjugate_gradients
from sfm.core.optim.dense_cholesky import DenseCholesky
from sfm.core.optim.preconditioners import BlockJacobi


def random_blocks(rng, rows, pairs):
    """A pattern, blocks with nothing above the diagonal, and the square array that they stand for."""
    first, second = rng.integers(0, rows, (2, pairs)) if rows else np.zeros((2, 0), int)
    pattern = BlockPattern.of_pairs(rows, first, second)
    blocks = rng.normal(size=(len(pattern.columns), 6, 6))
    blocks[pattern.diagonal] += 12 * (1 + 2 * pairs / max(rows, 1)) * np.eye(6)
    S = np.zeros((rows, 6, rows, 6))
    S[np.repeat(np.arange(rows), np.diff(pattern.offsets)), :, pattern.columns] = blocks
    S = np.tril(S.reshape(6 * rows, 6 * rows))
    blocks[pattern.diagonal] += np.triu(np.full((6, 6), np.nan), 1)
    return pattern, blocks, S + np.tril(S, -1).T


@pytest.mark.parametrize(("rows", "pairs"), [(0, 0), (1, 0), (2, 2), (7, 5), (50, 400)])
def test_products_equal_numpys_for_any_number_of_threads(rng, rows, pairs, monkeypatch):
    monkeypatch.setattr(block_product_module, "_SHARE_FROM", 0)
    pattern, blocks, S = random_blocks(rng, rows, pairs)
    held, damping = rng.random(6 * rows) < 0.2, rng.random(6 * rows)
    x = np.where(held, 0.0, rng.normal(size=6 * rows))
    before = x.copy()
    found = [block_product(pattern, blocks, damping, held, threads)(x) for threads in (1, 2, 3)]
    np.testing.assert_allclose(found[0], np.where(held, 0.0, S @ x + damping * x), rtol=1e-12, atol=1e-11)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
    np.testing.assert_array_equal(x, before)


def test_conjugate_gradients_with_products_and_block_jacobi_end_where_a_factor_does(rng):
    pattern, blocks, _ = random_blocks(rng, 60, 200)
    held, damping, side = rng.random(360) < 0.1, rng.random(360), rng.normal(size=360)
    jacobi, exact = BlockJacobi(pattern, held), DenseCholesky(pattern, held)
    assert jacobi.factor(blocks, damping)
    assert exact.factor(blocks, damping)
    product = block_product(pattern, blocks, damping, held)
    found = conjugate_gradients(product, np.where(held, 0.0, side), jacobi.solve, residual_tolerance=1e-12)
    assert found.reason == "residual"
    np.testing.assert_allclose(found.x, exact.solve(side), rtol=0, atol=1e-12)
