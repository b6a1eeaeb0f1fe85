from __future__ import annotations

import math

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.robust._damping_kernels import damped_step
from sfm.core.robust._two_view_kernels import (
    CAUCHY,
    ESSENTIAL,
    FUNDAMENTAL,
    HOMOGRAPHY,
    TRUNCATED,
    best_model,
    robust_weight,
    squared_errors,
)
from sfm.core.robust.absolute_pose import AbsolutePoseProblem, ReprojectionProblem
from sfm.core.robust.ransac import RansacConfig, draw_samples, ransac, refine, required_iterations
from sfm.core.robust.two_view import EssentialProblem, FundamentalProblem, HomographyProblem


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _twin_squared_errors(problem, data, matrix):
    """Sampson's formula e² / |∇e|² (or its 2 × 2 analogue) with numeric gradients, one datum at a time."""
    m = matrix.reshape(3, 3)
    out = []
    for column in data.T:
        if problem == ESSENTIAL:
            r1, r2, j1, j2 = column[:3], column[3:6], column[6:12].reshape(3, 2), column[12:].reshape(3, 2)
            gradient = np.concatenate([j1.T @ m.T @ r2, j2.T @ m @ r1])
            out.append((r2 @ m @ r1) ** 2 / (gradient @ gradient))
            continue

        def error(x):
            x1, x2 = np.append(x[:2], 1), np.append(x[2:], 1)
            mapped = m @ x1
            return np.array([x2 @ mapped]) if problem == FUNDAMENTAL else x[2:] - mapped[:2] / mapped[2]

        steps = 1e-6 * np.eye(4)
        jacobian = np.stack([(error(column + s) - error(column - s)) / 2e-6 for s in steps], 1)
        e = error(column)
        out.append(e @ np.linalg.solve(jacobian @ jacobian.T, e))
    return np.array(out)


@pytest.mark.parametrize(("problem", "rows"), [(ESSENTIAL, 18), (FUNDAMENTAL, 4), (HOMOGRAPHY, 4)])
def test_errors_are_those_of_the_slow_twin(problem, rows):
    rng = np.random.default_rng(0)
    data, matrix, out = rng.normal(size=(rows, 40)), np.eye(3).ravel() + 0.2 * rng.normal(size=9), np.empty(40)
    squared_errors(problem, data, matrix, 0, 40, out)
    np.testing.assert_allclose(out, _twin_squared_errors(problem, data, matrix), rtol=1e-5)


def test_the_best_model_is_that_of_the_exhaustive_search_despite_early_abandonment():
    rng = np.random.default_rng(1)
    data, models, squares = rng.normal(size=(4, 300)), rng.normal(size=(50, 9)), np.empty(300)
    table = np.empty((50, 300))
    for k in range(50):
        squared_errors(FUNDAMENTAL, data, models[k], 0, 300, table[k])
    scores = np.minimum(table, 0.01).sum(1)
    index, score, inliers = best_model(FUNDAMENTAL, data, models, 0.01, np.inf, squares)
    assert index == np.argmin(scores)
    assert score == pytest.approx(scores.min())
    assert inliers == (table[index] < 0.01).sum()
    assert best_model(FUNDAMENTAL, data, models, 0.01, scores.min() * 0.999, squares)[0] == -1


def _pose_problems(seed=0):
    rng = np.random.default_rng(seed)
    camera = Camera("SIMPLE_RADIAL", 1600, 1200, np.array([1300.0, 800, 600, -0.1]))
    points = rng.uniform(-1, 1, (60, 3)) + [0, 0, 5]
    pixels = camera.project(points)[0] + rng.normal(size=(60, 2))
    state = np.append(np.eye(3).ravel(), [0.01, -0.02, 0.03])
    return [
        (AbsolutePoseProblem(pixels, points, camera, 12.0), state),
        (ReprojectionProblem(pixels, points, camera, 12.0, refine_focal=False), state),
        (ReprojectionProblem(pixels, points, camera, 12.0, refine_focal=True), np.append(state, 0.05)),
    ]


def _problems():
    rng = np.random.default_rng(2)
    rays1, rays2 = _unit(rng.normal(size=(60, 3)) + [0, 0, 3]), _unit(rng.normal(size=(60, 3)) + [0, 0, 3])
    jacobians = rng.normal(size=(2, 60, 3, 2))
    essential = EssentialProblem.from_rays(rays1, rays2, jacobians[0], jacobians[1], 1.0)
    points = rng.normal(size=(4, 60))
    f = np.linalg.svd(rng.normal(size=(3, 3)))
    rank_two = ((f[0] * [1.0, 0.5, 0]) @ f[2]).ravel()
    t = np.array([0.3, -0.2, 0.5])
    skew = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    models = [(essential, skew.ravel()), (FundamentalProblem(points, 1.0), rank_two)]
    h = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    near = np.concatenate([points[:2], transform_points(h, points[:2].T).T + 0.01 * rng.normal(size=(2, 60))])
    models.append((HomographyProblem(near, 1.0), h.ravel()))
    return [(problem, problem.state(model)) for problem, model in models] + _pose_problems()


@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize("loss", [TRUNCATED, CAUCHY])
def test_gradients_are_the_derivatives_of_the_cost(index, loss):
    problem, state = _problems()[index]
    scale = 1e6 if loss == TRUNCATED else 1.5
    cost, hessian, gradient = problem.normal_equations(state, loss, scale)
    squares = problem.squared_errors(problem.model(state))
    expected = np.minimum(squares, scale**2) if loss == TRUNCATED else scale**2 * np.log1p(squares / scale**2)
    assert cost == pytest.approx(expected.sum(), rel=1e-9)
    dof = len(gradient)
    numeric = np.empty(dof)
    for k in range(dof):
        step = np.eye(dof)[k] * 1e-6
        costs = [problem.normal_equations(problem.moved(state, s), loss, scale)[0] for s in (step, -step)]
        numeric[k] = 0.5 * (costs[0] - costs[1]) / 2e-6
    # The metric of a homography's error is held fixed in its derivative, which is exact only on exact data.
    tolerance = 0.1 if index == 2 else 1e-4
    assert np.linalg.norm(gradient - numeric) < tolerance * np.linalg.norm(numeric)
    lower = np.tril(hessian)
    assert (np.linalg.eigvalsh(lower + np.tril(lower, -1).T) > -1e-9 * np.trace(lower)).all()


@pytest.mark.parametrize("index", range(6))
def test_refinement_never_raises_the_cost(index):
    problem, state = _problems()[index]
    before = problem.normal_equations(state, CAUCHY, 1.0)[0]
    after = problem.normal_equations(refine(problem, state, CAUCHY, 1.0, 20), CAUCHY, 1.0)[0]
    assert after <= before


def test_damped_step_solves_the_damped_system_and_reports_indefinite_ones():
    rng = np.random.default_rng(3)
    a = rng.normal(size=(8, 5))
    hessian, gradient = a.T @ a, rng.normal(size=5)
    expected = -np.linalg.solve(hessian + 0.1 * np.diag(np.diag(hessian)), gradient)
    np.testing.assert_allclose(damped_step(hessian, gradient, 0.1), expected, rtol=1e-10)
    assert np.isnan(damped_step(-hessian, gradient, 0.0)).all()


@pytest.mark.parametrize("loss", [TRUNCATED, CAUCHY])
def test_weights_are_the_derivatives_of_the_loss(loss):
    for square in (0.0, 0.3, 3.9, 4.1, 50.0):
        numeric = (robust_weight(square + 1e-6, loss, 4.0)[0] - robust_weight(square - 1e-6, loss, 4.0)[0]) / 2e-6
        assert robust_weight(square, loss, 4.0)[1] == pytest.approx(numeric, abs=1e-6)


def test_iterations_follow_the_exact_probability_of_a_clean_sample():
    config = RansacConfig(min_iterations=1, max_iterations=10**9, trials_factor=1.0, confidence=0.99)
    # 3 of 5 inliers, samples of 2: one draw in (5 · 4) / (3 · 2) is clean; (3/5)² would promise more.
    assert required_iterations(3, 5, 2, config) == math.ceil(math.log(0.01) / math.log(1 - 0.3))
    assert required_iterations(1, 5, 2, config) == 10**9
    assert required_iterations(5, 5, 2, config) == 1


@pytest.mark.parametrize(("size", "count"), [(5, 5), (5, 30), (7, 1000), (3, 37), (4, 64)])
def test_samples_are_distinct_in_range_and_cover_everything(size, count):
    samples = draw_samples(2000, size, count, np.random.default_rng(4))
    assert samples.shape == (2000, size)
    assert samples.min() == 0
    assert samples.max() == count - 1
    assert all(len(set(row)) == size for row in samples.tolist())
    frequency = np.bincount(samples.ravel(), minlength=count) / samples.size * count
    assert abs(frequency - 1).max() < 6 / np.sqrt(samples.size / count)


def test_too_few_data_are_rejected_with_numbers():
    problem = FundamentalProblem(np.zeros((4, 10)), 1.0)
    found = ransac(problem, RansacConfig(), np.random.default_rng(0))
    assert isinstance(found, Rejected)
    assert found.reason == "too_few_points"
    assert "10 of 15" in found.detail
