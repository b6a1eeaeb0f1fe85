"""What every solver of the reduced system does alike."""

from __future__ import annotations

import sys
import tracemalloc
import types

import numpy as np
import pytest

from sfm.core.errors import MissingDependencyError
from sfm.core.optim import dense_cholesky, sparse_cholesky
from sfm.core.optim.block_pattern import BlockPattern
from sfm.core.optim.cholmod import CholmodCholesky
from sfm.core.optim.dense_cholesky import DenseCholesky
from sfm.core.optim.solvers import ReducedSolver, forecast_cheapest, forecast_dense, forecast_sparse, make_solver
from sfm.core.optim.sparse_cholesky import SparseCholesky
from sfm.core.optional import import_cholmod

try:
    import_cholmod()
    without_cholmod = False
except MissingDependencyError:
    without_cholmod = True
needs_cholmod = pytest.mark.skipif(without_cholmod, reason="scikit-sparse 0.4 is not installed")
OURS = [pytest.param(kind, id=kind.__name__) for kind in (DenseCholesky, SparseCholesky)]
ours = pytest.mark.parametrize("kind", OURS)
exact = pytest.mark.parametrize("kind", [*OURS, pytest.param(CholmodCholesky, marks=needs_cholmod, id="Cholmod")])


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
def test_the_bits_do_not_depend_on_the_number_of_threads(kind, rng, monkeypatch):
    monkeypatch.setattr(dense_cholesky, "SHARE_FROM", 5)
    monkeypatch.setattr(sparse_cholesky, "SHARE_FROM", 5)
    monkeypatch.setattr(sparse_cholesky, "_WORTH_SHARING_S", 0.0)
    for pattern, S in (random_system(rng, 100, 800), random_system(rng, 150, 250)):
        n = 6 * pattern.rows
        held, side = rng.random(n) < 0.02, rng.normal(size=n)
        solutions = []
        for threads in (1, 2, 3):
            solver = kind(pattern, held)
            assert solver.factor(lower_blocks(S, pattern), np.ones(n), threads)
            solutions.append(solver.solve(side))
        np.testing.assert_array_equal(solutions[0], solutions[1])
        np.testing.assert_array_equal(solutions[0], solutions[2])
        np.testing.assert_allclose(solutions[0], reference(S, np.ones(n), held, side), atol=1e-12)


@exact
def test_badly_scaled_systems_are_solved_to_a_small_residual(kind, rng):
    J = rng.normal(size=(160, 120)) * np.logspace(-6, 6, 120)
    pattern, S, side = BlockPattern.full(20), J.T @ J, rng.normal(size=120)
    solver = kind(pattern, np.zeros(120, bool))
    assert solver.factor(lower_blocks(S, pattern), np.zeros(120), 1)
    scale = np.sqrt(np.diag(S))
    np.testing.assert_allclose((S @ solver.solve(side) - side) / scale, 0, atol=1e-9 * np.abs(side / scale).max())


@ours
@pytest.mark.parametrize("held_part", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(("rows", "pairs"), [(0, 0), (1, 0), (9, 12), (40, 60), (60, 3000)])
def test_blocks_of_the_inverse_equal_numpys(kind, rng, rows, pairs, held_part):
    pattern, S = random_system(rng, rows, pairs)
    held, damping = rng.random(6 * rows) < held_part, rng.random(6 * rows)
    held[6:12] |= held_part > 0
    solver = kind(pattern, held)
    assert solver.factor(lower_blocks(S, pattern), damping, 1)
    inverse = np.zeros_like(S)
    free = np.flatnonzero(~held)
    inverse[np.ix_(free, free)] = np.linalg.inv((S + np.diag(damping))[np.ix_(free, free)])
    i = np.repeat(np.arange(rows), np.diff(pattern.offsets))
    expected = inverse.reshape(rows, 6, rows, 6)[i, :, pattern.columns]
    np.testing.assert_allclose(solver.inverse_blocks(), expected, rtol=0, atol=1e-12)


def test_rows_on_their_own_are_solved_by_all_alike(rng):
    pattern, S = random_system(rng, 30, 0)
    held, damping, side = rng.random(180) < 0.3, rng.random(180), rng.normal(size=180)
    held[:6] = True
    for kind in (SparseCholesky, DenseCholesky):
        solver = kind(pattern, held)
        assert solver.factor(lower_blocks(S, pattern), damping, 1)
        np.testing.assert_allclose(solver.solve(side), reference(S, damping, held, side), rtol=0, atol=1e-13)


def test_all_solvers_are_reduced_solvers():
    pattern, held = BlockPattern.full(2), np.zeros(12, bool)
    for kind in (SparseCholesky, DenseCholesky):
        assert isinstance(kind(pattern, held), ReducedSolver)


def street(rows, reach=6, loops=((0, 200), (100, 250))):
    """Images along a street, each of which sees what the next few see, and places that are seen twice."""
    ahead = [(i, i + d) for i in range(rows) for d in range(1, reach + 1) if i + d < rows]
    again = [(a + i, b + i) for a, b in loops for i in range(10)]
    return BlockPattern.of_pairs(rows, *np.array(ahead + again).T)


def with_border(pattern):
    """One more row, the first, that is coupled to all."""
    rows = np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets)) + 1
    every = np.arange(1, pattern.rows + 1)
    ends = np.concatenate([rows, every]), np.concatenate([pattern.columns + 1, 0 * every])
    return BlockPattern.of_pairs(pattern.rows + 1, *ends)


@pytest.mark.parametrize(
    ("pattern", "kind"),
    [
        (street(300), SparseCholesky),
        (with_border(street(300)), SparseCholesky),
        (BlockPattern.full(220), DenseCholesky),
        (BlockPattern.of_pairs(250, *np.random.default_rng(1).integers(0, 250, (2, 4000))), DenseCholesky),
        (street(60, loops=()), DenseCholesky),
    ],
    ids=["street", "border", "object", "random", "small"],
)
def test_the_cheaper_solver_is_chosen(pattern, kind):
    held = np.zeros(6 * pattern.rows, bool)
    forecast = forecast_cheapest(pattern, held)
    assert forecast.kind == ("dense" if kind is DenseCholesky else "sparse")
    assert type(make_solver(pattern, held, forecast)) is kind


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_memory_is_forecast(kind, rng):
    pattern, held = street(300), rng.random(1800) < 0.05
    forecast = forecast_dense(held) if kind == "dense" else forecast_sparse(pattern, held)
    tracemalloc.start()
    try:
        solver = make_solver(pattern, held, forecast)
        assert solver.factor(np.tile(np.eye(6), (len(pattern.columns), 1, 1)), np.full(1800, 99.0))
        taken = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert 0.8 * taken < forecast.bytes < 1.2 * taken


def test_a_sparse_factor_of_a_street_takes_a_small_part_of_the_work_of_a_dense_one():
    for pattern in (street(300), with_border(street(300))):
        held = np.zeros(6 * pattern.rows, bool)
        sparse, dense = forecast_sparse(pattern, held), forecast_dense(held)
        assert sparse.operations < 0.05 * dense.operations
        assert sparse.bytes < 0.3 * dense.bytes


@pytest.mark.parametrize("installed", [None, types.ModuleType("sksparse")])
def test_cholmod_says_so_where_it_is_missing_or_another(monkeypatch, installed):
    if installed is not None:
        installed.cholmod = types.ModuleType("sksparse.cholmod")
    monkeypatch.setitem(sys.modules, "sksparse", installed)
    monkeypatch.setitem(sys.modules, "sksparse.cholmod", None if installed is None else installed.cholmod)
    with pytest.raises(MissingDependencyError, match=r"CHOLMOD"):
        CholmodCholesky(BlockPattern.full(2), np.zeros(12, bool))


def test_the_least_pivot_is_the_inverse_of_the_largest_last_variance(rng):
    # With the rows apart each pivot stands alone: that of an entry on the diagonal, given those before it.
    pattern, S = random_system(rng, 20, 0)
    held = rng.random(120) < 0.2
    pivots = []
    for k in range(0, 120, 6):
        free = np.flatnonzero(~held[k : k + 6]) + k
        pivots += [*np.diag(np.linalg.cholesky(S[np.ix_(free, free)])) ** 2]
    for kind in (DenseCholesky, SparseCholesky):
        solver = kind(pattern, held)
        assert solver.factor(lower_blocks(S, pattern), np.zeros(120), 1)
        assert solver.least_pivot() == pytest.approx(min(pivots), rel=1e-12)
        assert kind(pattern, np.ones(120, bool)).least_pivot() == np.inf
