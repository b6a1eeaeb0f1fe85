"""Steps within bounds, against the conditions of a minimum and an exhaustive search."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sfm.core.optim.box import Box, step_in_box


def quadratic(rng, size: int, rank: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    J = rng.normal(size=(rank or size + 3, size))
    return J.T @ J + 1e-3 * np.eye(size), rng.normal(size=size)


def solved(A: np.ndarray, b: np.ndarray, box: Box):
    return step_in_box(np.linalg.solve(A, b), lambda k: np.linalg.solve(A, np.eye(len(A))[k]), box)


def best(A: np.ndarray, b: np.ndarray, box: Box) -> np.ndarray:
    """The minimum, by trying all sets of active entries."""
    found, lowest = b, np.inf
    for sides in itertools.product((-1, 0, 1), repeat=len(box.entries)):
        active = box.entries[np.array(sides) != 0]
        rest = np.setdiff1d(np.arange(len(b)), active)
        x = np.zeros(len(b))
        x[box.entries] = np.select([np.array(sides) < 0, np.array(sides) > 0], [box.lower, box.upper], 0.0)
        if not np.isfinite(x).all():
            continue
        x[rest] = np.linalg.solve(A[np.ix_(rest, rest)], b[rest] - A[np.ix_(rest, active)] @ x[active])
        inside = np.all((x[box.entries] >= box.lower - 1e-12) & (x[box.entries] <= box.upper + 1e-12))
        value = 0.5 * x @ A @ x - b @ x
        if inside and value < lowest:
            found, lowest = x, value
    return found


@pytest.mark.parametrize("rank", [None, 4])
def test_the_step_is_the_best_of_all_within_the_box(rng, rank):
    for _ in range(60):
        A, b = quadratic(rng, 9, rank)
        box = Box(np.array([1, 4, 5, 8]), -rng.random(4) * 0.3, rng.random(4) * 0.3)
        step = solved(A, b, box)
        np.testing.assert_allclose(step.x, best(A, b, box), rtol=0, atol=1e-6)


def test_a_step_meets_the_conditions_of_a_minimum(rng):
    seen = set()
    for _ in range(30):
        A, b = quadratic(rng, 40)
        lower, upper = -rng.random(15) * 0.05, rng.random(15) * 0.05
        lower[:3], upper[2:6] = -np.inf, np.inf
        lower[10] = upper[10] = 0.0
        box = Box(rng.permutation(40)[:15], lower, upper)
        step = solved(A, b, box)
        here, slope = step.x[box.entries], A @ step.x - b
        assert np.all(here >= lower)
        assert np.all(here <= upper)
        np.testing.assert_allclose(np.delete(slope, box.entries), 0, atol=1e-9)
        np.testing.assert_allclose(slope[box.entries], step.multipliers, atol=1e-9)
        np.testing.assert_array_equal(here[step.sides < 0], lower[step.sides < 0])
        np.testing.assert_array_equal(here[step.sides > 0], upper[step.sides > 0])
        assert np.all((step.multipliers * step.sides <= 0) | (lower == upper))
        assert not step.multipliers[step.sides == 0].any()
        seen |= set(step.sides.tolist())
    assert seen == {-1, 0, 1}


def test_ill_conditioned_boxes_end_without_an_entry_that_would_leave_its_edge():
    held = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        size = int(rng.integers(4, 30))
        J = rng.normal(size=(size + 5, size)) * 10.0 ** rng.uniform(-3, 3, size)
        J = J @ (np.eye(size) + 0.99 * rng.normal(size=(size, size)))
        scale = np.sqrt(np.sum(J**2, 0))
        A, b = J.T @ J / scale / scale[:, None] + 1e-8 * np.eye(size), rng.normal(size=size)
        reach = rng.uniform(0.01, 0.5, size) * np.abs(np.linalg.solve(A, b)).mean()
        step = solved(A, b, Box(np.arange(size), -reach, reach))
        assert np.all(step.multipliers * step.sides <= 0)
        assert np.all(np.abs(step.x) <= reach * (1 + 1e-12))
        held += int(np.sum(step.sides != 0))
    assert held > 300


def test_a_matrix_that_is_not_positive_definite_gives_nan():
    def inverse_column(k: int) -> np.ndarray:
        return np.array([[1.0, 2.0], [2.0, 1.0]])[k] * (-1) ** k

    step = step_in_box(np.array([5.0, 5.0]), inverse_column, Box(np.arange(2), -np.ones(2), np.ones(2)))
    assert np.isnan(step.x).all() or np.all(np.abs(step.x) <= 1)


def test_a_step_within_the_box_is_taken_as_it_is(rng):
    A, b = quadratic(rng, 12)
    x = np.linalg.solve(A, b)
    step = step_in_box(x, lambda k: pytest.fail("nothing is active"), Box(np.arange(12), x - 1, x + 1))
    np.testing.assert_array_equal(step.x, x)
    assert not step.sides.any()
