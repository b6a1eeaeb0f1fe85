from __future__ import annotations

import numpy as np
import pytest

from sfm.core.optim.linear import solve_positive_definite as solve


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 7, 8, 30, 61, 300])
def test_solutions_equal_numpy_and_only_the_lower_triangle_counts(rng, n):
    J, b = rng.normal(size=(n + 5, n)), rng.normal(size=n)
    S = J.T @ J
    spoiled = np.tril(S) + np.triu(np.full((n, n), np.nan), 1)
    np.testing.assert_allclose(solve(spoiled, b.copy()), np.linalg.solve(S, b), rtol=1e-9, atol=1e-12)


def test_badly_scaled_systems_are_solved_to_a_small_residual(rng):
    J, b = rng.normal(size=(60, 40)) * np.logspace(-6, 6, 40), rng.normal(size=40)
    S = J.T @ J
    x = solve(S.copy(), b.copy())
    scale = np.sqrt(np.diag(S))
    np.testing.assert_allclose((S @ x - b) / scale, 0, atol=1e-9 * np.abs(b / scale).max())


@pytest.mark.parametrize("n", [1, 3, 4, 9])
def test_there_is_no_solution_of_what_is_not_positive_definite(rng, n):
    J = rng.normal(size=(n, n))
    assert solve(-(J.T @ J), np.ones(n)) is None
    assert solve(np.zeros((n, n)), np.ones(n)) is None
    indefinite = np.eye(n)
    indefinite[-1, -1] = -1
    assert solve(indefinite, np.ones(n)) is None


def test_a_matrix_that_is_not_finite_has_no_solution():
    S = np.eye(5)
    S[3, 3] = np.nan
    assert solve(S, np.ones(5)) is None


def test_nothing_is_solved_by_nothing():
    assert solve(np.zeros((0, 0)), np.zeros(0)).shape == (0,)
