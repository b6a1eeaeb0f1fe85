from __future__ import annotations

import numpy as np
import pytest

from sfm.core.optim.conjugate_gradients import conjugate_gradients


def system(rng, n, condition=1e4):
    Q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    return (Q * np.geomspace(1, condition, n)) @ Q.T, rng.normal(size=n)


def same(r):
    return r.copy()


def model(S, b, x):
    return 0.5 * x @ S @ x - b @ x


def test_the_solution_is_numpys_within_the_tolerance(rng):
    S, b = system(rng, 60)
    found = conjugate_gradients(lambda p: S @ p, b, same, residual_tolerance=1e-10)
    assert found.reason == "residual"
    assert np.linalg.norm(S @ found.x - b) <= 2e-10 * np.linalg.norm(b)
    assert found.relative_residual <= 1e-10
    np.testing.assert_allclose(found.x, np.linalg.solve(S, b), atol=1e-7)


def test_as_many_steps_as_there_are_different_eigenvalues_are_enough(rng):
    Q, _ = np.linalg.qr(rng.normal(size=(40, 40)))
    S = (Q * np.repeat([1.0, 5.0, 20.0], [20, 15, 5])) @ Q.T
    found = conjugate_gradients(lambda p: S @ p, rng.normal(size=40), same, residual_tolerance=1e-9)
    assert found.iterations == 3


def test_an_exact_preconditioner_needs_one_step(rng):
    S, b = system(rng, 30)
    found = conjugate_gradients(lambda p: S @ p, b, lambda r: np.linalg.solve(S, r))
    assert found.iterations == 1
    np.testing.assert_allclose(found.x, np.linalg.solve(S, b), atol=1e-10)


def test_no_step_raises_the_model_and_the_tolerance_of_the_model_ends_it_early(rng):
    S, b = system(rng, 80, 1e6)
    values = [model(S, b, conjugate_gradients(lambda p: S @ p, b, same, max_iterations=k).x) for k in range(1, 40)]
    assert np.all(np.diff(values) <= 1e-12 * np.abs(values[-1]))
    early = conjugate_gradients(lambda p: S @ p, b, same, model_tolerance=0.1, max_iterations=1000)
    late = conjugate_gradients(lambda p: S @ p, b, same, model_tolerance=0.001, max_iterations=1000)
    assert early.reason == late.reason == "model"
    assert early.iterations < late.iterations
    k, q = early.iterations, [0.0, *values]
    assert k * (q[k] - q[k - 1]) / q[k] < 0.1
    assert all(j * (q[j] - q[j - 1]) / q[j] >= 0.1 for j in range(1, k))


def test_a_direction_without_curvature_ends_it_with_what_there_was(rng):
    S = np.diag([1.0, 2.0, -3.0])
    found = conjugate_gradients(lambda p: S @ p, np.array([1.0, 1.0, 0.1]), same)
    assert found.reason == "curvature"
    assert np.all(np.isfinite(found.x))
    assert model(S, np.array([1.0, 1.0, 0.1]), found.x) <= 0
    assert conjugate_gradients(lambda p: 0 * p, np.ones(3), same).reason == "curvature"


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_no_answer_is_ever_not_finite(rng, bad):
    S, b = system(rng, 10)
    calls = []

    def fails_late(p):
        calls.append(1)
        return S @ p if len(calls) < 3 else bad * p

    with np.errstate(over="ignore", invalid="ignore"):
        for product, precondition, side in (
            (fails_late, same, b),
            (lambda p: bad * p, same, b),
            (lambda p: S @ p, lambda r: bad * r, b),
            (lambda p: S @ p, lambda r: -r, b),
            (lambda p: S @ p, same, np.append(b[:-1], bad)),
        ):
            found = conjugate_gradients(product, side, precondition, max_iterations=20)
            assert np.all(np.isfinite(found.x))
            assert np.isfinite(found.relative_residual)


def test_nothing_is_solved_by_nothing():
    found = conjugate_gradients(same, np.zeros(4), same)
    assert (found.iterations, found.reason) == (0, "residual")
    assert np.all(found.x == 0)
    assert conjugate_gradients(same, np.zeros(0), same).x.shape == (0,)


def test_nothing_that_is_given_is_changed(rng):
    S, b = system(rng, 20)
    before = b.copy()
    conjugate_gradients(lambda p: S @ p, b, lambda r: r, max_iterations=5)  # the very array is handed back
    np.testing.assert_array_equal(b, before)
