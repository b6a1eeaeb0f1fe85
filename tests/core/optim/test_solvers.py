"""What every solver of the reduced system does alike."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.core.optim.block_pattern import BlockPattern
from sfm.core.optim.dense_cholesky import DenseCholesky
from sfm.core.optim.sparse_cholesky import SparseCholesky

exact = pytest.mark.parametrize("kind", [DenseCholesky, SparseCholesky], ids=lambda kind: kind.__name__)


def lower_blocks(S, pattern):
    """The blocks of a square array that a pattern has; above the diagonal there is nothing to be read."""
    rows = np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))
    blocks = S.reshape(pattern.rows, 6, pattern.rows, 6)[rows, :, pattern.columns].copy()
    blocks[pattern.diagonal] += np.triu(np.full((6, 6), np.nan), 1)
    return blocks


def random_system(rng, rows, pairs):
    """A pattern of so many random pairs of rows, and a well conditioned square array that has it."""
    first, second = rng.integers(0, rows, (2, pairs)) if rows else np.zeros((2, 0), int)
    pattern = BlockPattern.of_pairs(rows, first, second)
    S = np.zeros((rows, 6, rows, 6))
    i = np.repeat(np.arange(rows), np.diff(pattern.offsets))
    S[i, :, pattern.columns] = rng.normal(size=(len(i), 6, 6))
    S = S.reshape(6 * rows, 6 * rows)
    S = np.tril(S) + np.tril(S, -1).T
    return pattern, S + np.diag(np.abs(S).sum(axis=1) + 0.1)


def reference(S, damping, held, side):
    """What numpy says."""
    free, x = np.flatnonzero(~held), np.zeros(len(side))
    x[free] = np.linalg.solve((S + np.diag(damping))[np.ix_(free, free)], side[free])
    return x


@exact
@pytest.mark.parametrize("held_part", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(("rows", "pairs"), [(0, 0), (1, 0), (2, 1), (5, 0), (9, 12), (40, 60), (60, 3000)])
def test_the_solution_equals_numpys(kind, rng, rows, pairs, held_part):
    pattern, S = random_system(rng, rows, pairs)
    held = rng.random(6 * rows) < held_part
    held[:6] |= held_part > 0  # a whole row too
    damping, side = rng.random(6 * rows), rng.normal(size=6 * rows)
    solver, blocks = kind(pattern, held), lower_blocks(S, pattern)
    before = blocks.copy()
    for scale in (1.0, 10.0):
        assert solver.factor(blocks, scale * damping, 1)
        x = solver.solve(side)
        np.testing.assert_allclose(x, reference(S, scale * damping, held, side), rtol=0, atol=1e-12)
        assert np.all(x[held] == 0)
    np.testing.assert_array_equal(blocks, before)


@exact
def test_what_is_not_positive_definite_or_not_finite_has_no_factor(kind, rng):
    pattern, S = random_system(rng, 12, 30)
    held, none = np.zeros(72, bool), np.zeros(72)
    held[6:12] = True
    solver, good = kind(pattern, held), lower_blocks(S, pattern)
    assert not solver.factor(-good, none, 1)
    assert not solver.factor(np.zeros_like(good), none, 1)
    for value in (np.nan, np.inf, -np.inf):
        for block in (pattern.offsets[3], pattern.diagonal[5]):
            blocks = good.copy()
            blocks[block, 2, 1] = value
            assert not solver.factor(blocks, none, 1)
        assert not solver.factor(good, np.where(np.arange(72) == 30, value, 0.0), 1)
    blocks = good.copy()
    blocks[pattern.diagonal[1]] = np.nan  # a row that is held
    assert solver.factor(blocks, none, 1)


@exact
def test_the_bits_do_not_depend_on_the_number_of_threads(kind, rng):
    pattern, S = random_system(rng, 210, 9000)
    held, side = rng.random(1260) < 0.02, rng.normal(size=1260)
    solutions = []
    for threads in (1, 2, 3):
        solver = kind(pattern, held)
        assert solver.factor(lower_blocks(S, pattern), np.ones(1260), threads)
        solutions.append(solver.solve(side))
    np.testing.assert_array_equal(solutions[0], solutions[1])
    np.testing.assert_array_equal(solutions[0], solutions[2])
    np.testing.assert_allclose(solutions[0], reference(S, np.ones(1260), held, side), atol=1e-12)


@exact
def test_badly_scaled_systems_are_solved_to_a_small_residual(kind, rng):
    J = rng.normal(size=(160, 120)) * np.logspace(-6, 6, 120)
    pattern, S, side = BlockPattern.full(20), J.T @ J, rng.normal(size=120)
    solver = kind(pattern, np.zeros(120, bool))
    assert solver.factor(lower_blocks(S, pattern), np.zeros(120), 1)
    scale = np.sqrt(np.diag(S))
    np.testing.assert_allclose((S @ solver.solve(side) - side) / scale, 0, atol=1e-9 * np.abs(side / scale).max())
