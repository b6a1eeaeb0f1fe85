from __future__ import annotations

import math

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.robust._absolute_pose_kernels import Resection
from sfm.core.robust._absolute_pose_kernels import equations as pose_equations
from sfm.core.robust._damping_kernels import damped_step
from sfm.core.robust._loop_kernels import score
from sfm.core.robust._loss_kernels import CAUCHY, MARGINALIZED, TRUNCATED, robust_weight
from sfm.core.robust._problem_kernels import SIZE
from sfm.core.robust._sampling_kernels import draw_progressively, draw_samples
from sfm.core.robust._two_view_kernels import ESSENTIAL, FUNDAMENTAL, HOMOGRAPHY, moved, plausible, start
from sfm.core.robust._two_view_kernels import equations as two_view_equations
from sfm.core.robust.absolute_pose import ReprojectionProblem, resection
from sfm.core.robust.ransac import (
    RansacConfig,
    Solver,
    _progressive_limit,
    farthest_bound,
    ransac,
    required_iterations,
)
from sfm.core.robust.refinement import refine
from sfm.core.robust.relative_pose import flat
from sfm.core.robust.sampling import Sampler
from sfm.core.robust.two_view import essential_matrix, fundamental_matrix, homography_matrix


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
        if problem == HOMOGRAPHY and m[2] @ np.append(column[:2], 1) <= 0:
            out.append(np.inf)
            continue
        e = error(column)
        out.append(e @ np.linalg.solve(jacobian @ jacobian.T, e))
    return np.array(out)


def _problem(kind, data, max_error=1.0):
    if kind == ESSENTIAL:
        return essential_matrix(
            data[:3].T, data[3:6].T, data[6:12].T.reshape(-1, 3, 2), data[12:].T.reshape(-1, 3, 2), 1.0
        )
    return (fundamental_matrix if kind == FUNDAMENTAL else homography_matrix)(data, max_error)


@pytest.mark.parametrize(("problem", "rows"), [(ESSENTIAL, 18), (FUNDAMENTAL, 4), (HOMOGRAPHY, 4)])
def test_errors_are_those_of_the_slow_twin(problem, rows):
    rng = np.random.default_rng(0)
    data, matrix = rng.normal(size=(rows, 40)), np.eye(3).ravel() + 0.2 * rng.normal(size=9)
    found = _problem(problem, data).squared_errors(flat(matrix.reshape(3, 3)))
    np.testing.assert_allclose(found, _twin_squared_errors(problem, data, matrix), rtol=1e-5)


@pytest.mark.parametrize("loss", [TRUNCATED, MARGINALIZED])
def test_the_best_model_is_that_of_the_exhaustive_search_despite_early_abandonment(loss):
    rng = np.random.default_rng(1)
    problem = fundamental_matrix(rng.normal(size=(4, 300)), 0.1)
    models = np.zeros((50, SIZE))
    models[:, :9] = rng.normal(size=(50, 9))
    table = np.array([problem.squared_errors(model) for model in models])
    x = np.minimum(np.sqrt(table) / 0.1, 1)
    scores = np.minimum(table, 0.01).sum(1) if loss == TRUNCATED else 0.01 * (2 * x - x**2).sum(1)
    index, score, inliers = problem.best(models, loss, np.inf)
    assert index == np.argmin(scores)
    assert score == pytest.approx(scores.min())
    assert inliers == (table[index] < 0.01).sum()
    assert problem.best(models, loss, scores.min() * 0.999)[0] == -1


def _still(count=400, wrong=0.6, noise=0.01, seed=0):
    """Points that stay where they are to within noise, and strays: the true homography is the identity."""
    rng = np.random.default_rng(seed)
    x1 = rng.normal(size=(2, count))
    strays = rng.uniform(size=count) < wrong
    x2 = np.where(strays, rng.normal(size=(2, count)), x1 + noise * rng.normal(size=(2, count)))
    return homography_matrix(np.concatenate([x1, x2]), 4 * noise), strays


@pytest.mark.parametrize("wrong", [0.3, 0.8])
def test_models_that_beat_the_bound_are_not_given_up_and_bad_ones_soon(wrong):
    kept = []
    for seed in range(200):
        problem, _ = _still(wrong=wrong, seed=seed)
        squares, square = np.full(problem.count, -1.0), problem.max_error**2
        exact = problem.best(flat(np.eye(3))[None], TRUNCATED, np.inf)[1]
        total, _ = score(problem.data, flat(np.eye(3)), TRUNCATED, square, 1.001 * exact, 3.0, squares)
        kept.append(total == pytest.approx(exact))
        moved_away = flat(np.eye(3) + [[0, 0, 5.0], [0, 0, 0], [0, 0, 0]])
        assert score(problem.data, moved_away, TRUNCATED, square, exact, 3.0, squares)[0] == np.inf
    assert np.mean(kept) > 0.97
    squares[:] = -1.0
    score(problem.data, moved_away, TRUNCATED, square, exact, 3.0, squares)
    assert (squares >= 0).sum() < (40 if wrong == 0.3 else 250)


def _twin_plausible(kind, data, m, sample):
    """Both signs of depths along the rays for one sign of the matrix, by singular vectors."""
    m = m.reshape(3, 3)
    one = np.ones(len(sample))
    first, second = (
        (data[:3, sample], data[3:6, sample]) if kind == ESSENTIAL else (data[:2, sample], data[2:4, sample])
    )
    if kind != ESSENTIAL:
        first, second = np.stack([*first, one]), np.stack([*second, one])
    if kind == HOMOGRAPHY:
        w = m[2] @ first
        return ((w > 0).all() and np.linalg.det(m) > 0) or ((w < 0).all() and np.linalg.det(m) < 0)
    t = np.linalg.svd(m)[0][:, 2]
    sides = np.sum((m @ first) * np.cross(t, second.T).T, axis=0)
    return (sides > 0).all() or (sides < 0).all()


@pytest.mark.parametrize(("kind", "rows", "size"), [(ESSENTIAL, 18, 5), (FUNDAMENTAL, 4, 7), (HOMOGRAPHY, 4, 4)])
def test_models_that_the_cameras_cannot_see_are_implausible(kind, rows, size):
    rng = np.random.default_rng(4)
    found = []
    for _ in range(300):
        data = rng.normal(size=(rows, 20))
        problem = _problem(kind, data)
        sample = rng.choice(20, size, replace=False)
        # A matrix that is exact for the sample, so that the two directions are parallel.
        models = problem.proposals(sample[None]) if kind != ESSENTIAL else flat(_rank_two(rng))[None]
        for model in models:
            expected = _twin_plausible(kind, data, model[:9], sample)
            assert plausible(problem.data, model, sample) == expected
            found.append(expected)
            if kind == HOMOGRAPHY and expected:
                assert (model[6:8] @ data[:2, sample] + model[8] > 0).all()
    assert 0.001 < np.mean(found) < 0.4


def test_true_models_are_plausible_for_every_sample():
    for problem, model in _compiled()[2:3]:
        assert plausible(problem.data, model, np.array([0, 5, 9, 30]))
    rng = np.random.default_rng(7)
    points = rng.uniform(-1, 1, (40, 3)) + [0, 0, 4]
    rotation, t = np.linalg.qr(np.eye(3) + 0.1 * rng.normal(size=(3, 3)))[0], np.array([1.0, 0.1, 0.4])
    rotation *= np.sign(np.diag(rotation))
    skew = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    seen = points @ rotation.T + t
    data = np.concatenate([(points[:, :2] / points[:, 2:]).T, (seen[:, :2] / seen[:, 2:]).T])
    problem, model = fundamental_matrix(data, 1.0), flat(skew @ rotation)
    assert all(plausible(problem.data, model, rng.choice(40, 7, replace=False)) for _ in range(50))


def test_no_model_is_given_up_before_any_has_set_a_bound():
    for error in (0.1, 0.03, 0.01):
        still = np.random.default_rng(0).uniform(-1, 1, (2, 64))
        data = np.concatenate([still, still])
        data[2:, :16] += 50.0  # the first block agrees with nothing
        problem = homography_matrix(data, error)
        bound, square = 64 * problem.max_error**2, problem.max_error**2
        for patience in (3.0, 1e150):
            _, inliers = score(problem.data, flat(np.eye(3)), TRUNCATED, square, bound, patience, np.empty(64))
            assert inliers == 48


@pytest.mark.parametrize("loss", [TRUNCATED, MARGINALIZED])
def test_the_search_finds_what_its_slow_twin_finds(loss):
    problem, _ = _still(count=200, seed=3)
    samples = np.empty((100, 4), np.int64)
    draw_samples(np.array([7]), 200, samples)

    def truncated(model):
        return problem.best(model[None], TRUNCATED, np.inf)[1]

    best, bounds, model, used = [np.inf, np.inf], np.full(2, 200 * problem.max_error**2), np.zeros(SIZE), 0
    expected = np.zeros(SIZE)
    for first in range(0, 100, 20):
        seen = [
            proposal
            for sample in samples[first : first + 20]
            for proposal in problem.proposals(sample[None])
            if plausible(problem.data, proposal, sample)
        ]
        winner = min(seen, key=truncated, default=None)
        if winner is None or truncated(winner) >= best[0]:
            continue
        best[0] = truncated(winner)
        refined = problem.improved(winner, loss, problem.max_error, 1e-2)
        cost = problem.best(refined[None], loss, np.inf)[1]
        if cost < best[1]:
            best[1], expected = cost, refined
    while used < 100:
        used += problem.search(samples[used:], loss, bounds, model)[0]
    np.testing.assert_allclose(bounds, best, rtol=1e-12)
    np.testing.assert_allclose(model, expected, rtol=1e-9)


@pytest.mark.parametrize("quality", [None, np.arange(50.0)])
def test_samples_are_the_same_however_many_are_taken_at_a_time(quality):
    drawn = []
    for portions in ([7] * 30, [1, 60, 13, 2] * 4):
        sampler, rows = Sampler(50, 4, 1000, np.random.default_rng(1), quality), []
        for most in portions:
            some = sampler.ahead(most)
            assert 0 < len(some) <= most
            rows += some.tolist()
            sampler.use(len(some))
        assert sampler.used == len(rows)
        drawn.append(rows)
    shortest = min(map(len, drawn))
    assert shortest > 50
    assert drawn[0][:shortest] == drawn[1][:shortest]
    if quality is not None:
        # The best data have the highest numbers.
        assert np.mean(drawn[0][:20]) > 40


def test_scores_reach_over_bounds_of_the_noise_up_to_eight_pixels():
    def reached(solver: Solver) -> list[float]:
        return [px * farthest_bound(solver, RansacConfig(max_error_px=px)) for px in (0.5, 1.0, 2.0, 4.0, 12.0)]

    solver = Solver(7, 3)
    assert reached(solver) == [2.0, 4.0, 8.0, 8.0, 12.0]
    assert reached(solver._replace(reach=3.0)) == [1.5, 3.0, 6.0, 8.0, 12.0]
    assert farthest_bound(solver, RansacConfig(max_error_px=1.0, score="truncated")) == 1.0


def _rank_two(rng):
    u, _, vt = np.linalg.svd(rng.normal(size=(3, 3)))
    return (u * [1.0, 0.5, 0]) @ vt


def _compiled():
    """Problems whose data are random, with a model near which their costs are smooth."""
    rng = np.random.default_rng(2)
    rays = [_unit(rng.normal(size=(60, 3)) + [0, 0, 3]) for _ in range(2)]
    t = np.array([0.3, -0.2, 0.5]) / np.linalg.norm([0.3, -0.2, 0.5])
    skew = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    points, h = rng.normal(size=(4, 60)), np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    near = np.concatenate([points[:2], transform_points(h, points[:2].T).T + 0.01 * rng.normal(size=(2, 60))])
    camera = Camera("SIMPLE_RADIAL", 1600, 1200, np.array([1300.0, 800, 600, -0.1]))
    points3D = rng.uniform(-1, 1, (60, 3)) + [0, 0, 5]
    pixels = camera.project(points3D)[0] + rng.normal(size=(60, 2))
    return [
        (essential_matrix(*rays, *rng.normal(size=(2, 60, 3, 2)), 1.0), flat(skew)),
        (fundamental_matrix(points, 1.0), flat(_rank_two(rng))),
        (homography_matrix(near, 1.0), flat(h)),
        (resection(pixels, points3D, camera, 12.0)[0], np.append(np.eye(3).ravel(), [0.01, -0.02, 0.03])),
    ]


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("loss", [TRUNCATED, CAUCHY])
def test_gradients_are_the_derivatives_of_the_cost(index, loss):
    problem, model = _compiled()[index]
    equations = pose_equations if isinstance(problem.data, Resection) else two_view_equations
    dof, state = (5, 8, 8, 6)[index], model.copy()
    if index < 3:
        assert start(problem.data, model, state)

    def cost(state, hessian, gradient):
        return equations(problem.data, state, loss, 1.5, 1e12, hessian, gradient)

    hessian, gradient, numeric = np.zeros((dof, dof)), np.zeros(dof), np.empty(dof)
    value, squares = cost(state, hessian, gradient), problem.squared_errors(model)
    expected = squares if loss == TRUNCATED else 1.5 * np.log1p(squares / 1.5)
    assert value == pytest.approx(expected.sum(), rel=1e-9)
    for k in range(dof):
        steps = [sign * 1e-6 * np.eye(dof)[k] for sign in (1, -1)]
        move = moved if index < 3 else (lambda _, state, step: _moved_pose(state, step))
        costs = [cost(move(problem.data, state, step), np.zeros((dof, dof)), np.zeros(dof)) for step in steps]
        numeric[k] = 0.5 * (costs[0] - costs[1]) / 2e-6
    # The metric of a homography's error is held fixed in its derivative, which is exact only on exact data.
    tolerance = 0.1 if index == 2 else 1e-4
    assert np.linalg.norm(gradient - numeric) < tolerance * np.linalg.norm(numeric)
    lower = np.tril(hessian)
    assert (np.linalg.eigvalsh(lower + np.tril(lower, -1).T) > -1e-9 * np.trace(lower)).all()


def _moved_pose(state, step):
    """The twin of a step: exp([ω]×) by its power series."""
    w = np.array([[0, -step[2], step[1]], [step[2], 0, -step[0]], [-step[1], step[0], 0]])
    rotation = (np.eye(3) + w + w @ w / 2) @ state[:9].reshape(3, 3)
    return np.append(rotation.ravel(), state[9:] + step[3:])


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("loss", [TRUNCATED, CAUCHY, MARGINALIZED])
def test_refinement_never_raises_the_cost(index, loss):
    problem, model = _compiled()[index]

    def cost(model):
        return sum(
            robust_weight(square, loss, 1.0, problem.max_error**2)[0] for square in problem.squared_errors(model)
        )

    before, after = cost(model), cost(problem.improved(model, loss, 1.0, 1e-6))
    assert after <= before * (1 + 1e-12)


def test_refined_matrices_keep_their_rank():
    for (problem, model), singular in zip(_compiled()[:2], ([1, 1, 0], None), strict=True):
        found = np.linalg.svd(problem.improved(model, CAUCHY, 1.0, 1e-9)[:9].reshape(3, 3))[1]
        assert found[2] < 1e-12 * found[0]
        if singular:
            np.testing.assert_allclose(found / found[0], singular, atol=1e-9)


def test_a_degenerate_model_is_left_as_it_is():
    for problem, _ in _compiled()[:2]:
        np.testing.assert_array_equal(problem.improved(np.zeros(SIZE), TRUNCATED, 1.0, 1e-6), 0)


def _focal_problem():
    rng = np.random.default_rng(0)
    camera = Camera("SIMPLE_RADIAL", 1600, 1200, np.array([1300.0, 800, 600, -0.1]))
    points = rng.uniform(-1, 1, (60, 3)) + [0, 0, 5]
    pixels = camera.project(points)[0] + rng.normal(size=(60, 2))
    return ReprojectionProblem(pixels, points, camera, 12.0, refine_focal=True)


def test_the_gradient_of_a_pose_with_a_focal_length_is_the_derivative_of_the_cost():
    problem, state = _focal_problem(), np.append(np.eye(3).ravel(), [0.01, -0.02, 0.03, 0.05])
    _, _, gradient = problem.normal_equations(state, CAUCHY, 1.5)
    numeric = [
        0.5
        * np.diff([problem.normal_equations(problem.moved(state, s), CAUCHY, 1.5)[0] for s in (-step, step)])[0]
        / 2e-6
        for step in 1e-6 * np.eye(7)
    ]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4 * np.abs(gradient).max())
    before = problem.normal_equations(state, CAUCHY, 1.0)[0]
    assert problem.normal_equations(refine(problem, state, CAUCHY, 1.0, 20), CAUCHY, 1.0)[0] < before


def test_damped_step_solves_the_damped_system_and_reports_indefinite_ones():
    rng = np.random.default_rng(3)
    a = rng.normal(size=(8, 5))
    hessian, gradient = a.T @ a, rng.normal(size=5)
    expected = -np.linalg.solve(hessian + 0.1 * np.diag(np.diag(hessian)), gradient)
    np.testing.assert_allclose(damped_step(hessian, gradient, 0.1), expected, rtol=1e-10)
    assert np.isnan(damped_step(-hessian, gradient, 0.0)).all()


@pytest.mark.parametrize("loss", [TRUNCATED, CAUCHY, MARGINALIZED])
def test_weights_are_the_derivatives_of_the_loss(loss):
    for square in (0.1, 0.3, 3.9, 4.1, 50.0):
        costs = [robust_weight(square + step, loss, 2.0, 4.0)[0] for step in (1e-6, -1e-6)]
        assert robust_weight(square, loss, 2.0, 4.0)[1] == pytest.approx((costs[0] - costs[1]) / 2e-6, abs=1e-6)


def test_the_marginalised_loss_is_the_mean_of_the_truncated_one_over_all_bounds():
    bounds = (np.arange(20000) + 0.5) / 20000 * 3.0
    for error in (0.0, 0.4, 1.7, 2.9, 5.0):
        expected = 9.0 * np.minimum(error**2 / bounds**2, 1).mean()
        assert robust_weight(error**2, MARGINALIZED, 1.0, 9.0)[0] == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_iterations_follow_the_exact_probability_of_a_clean_sample():
    config = RansacConfig(min_iterations=1, max_iterations=10**9, trials_factor=1.0, confidence=0.99)
    # 3 of 5 inliers, samples of 2: one draw in (5 · 4) / (3 · 2) is clean; (3/5)² would promise more.
    assert required_iterations(3, 5, 2, config) == math.ceil(math.log(0.01) / math.log(1 - 0.3))
    assert required_iterations(1, 5, 2, config) == 10**9
    assert required_iterations(5, 5, 2, config) == 1


@pytest.mark.parametrize(("size", "count"), [(5, 5), (5, 30), (7, 1000), (3, 37), (4, 64)])
def test_samples_are_distinct_in_range_and_cover_everything(size, count):
    samples = np.empty((2000, size), np.int64)
    draw_samples(np.array([12345]), count, samples)
    assert samples.shape == (2000, size)
    assert samples.min() == 0
    assert samples.max() == count - 1
    assert all(len(set(row)) == size for row in samples.tolist())
    frequency = np.bincount(samples.ravel(), minlength=count) / samples.size * count
    assert abs(frequency - 1).max() < 6 / np.sqrt(samples.size / count)


@pytest.mark.parametrize("count", [7, 19, 20, 60, 1000])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.7, 1.0])
def test_progressive_samples_end_at_the_fewest_that_any_part_of_the_best_data_needs(count, share):
    config = RansacConfig(min_iterations=1, max_iterations=10**9)
    inliers = np.random.default_rng(count).uniform(size=count) < share * np.linspace(1.5, 0.5, count)
    limit, reach = _progressive_limit(inliers, 5, config)
    assert limit == required_iterations(int(inliers[:reach].sum()), reach, 5, config)
    needed = {n: required_iterations(int(inliers[:n].sum()), n, 5, config) for n in (count // 10, count // 2, count)}
    convincing = [n for n in needed if n >= 20 and inliers[:n].sum() > 0.1 * n + 1.5 * math.sqrt(n)]
    assert limit <= needed[count]
    # The parts that are looked at lie a fifth apart: between them a little less may be needed.
    assert limit <= min([1.5 * needed[n] + 1 for n in convincing], default=needed[count])


def test_progressive_samples_grow_from_the_best_data_to_all_and_contain_the_newest():
    samples, growth = np.empty((1000, 4), np.int64), np.zeros(3)
    draw_progressively(np.array([1]), 0, 100, 100, 1000.0, growth, samples)
    assert (np.sort(samples, 1)[:, 1:] > np.sort(samples, 1)[:, :-1]).all()
    newest = np.maximum.accumulate(samples.max(1))
    assert samples[0].max() < 5
    assert newest[20] < 40
    assert newest[-1] > 90
    grown = np.flatnonzero(np.diff(newest)) + 1
    assert (samples[grown].max(1) == newest[grown]).all()
    # The draws that lie among the best n are about as many as uniform draws would have there.
    clean = math.comb(50, 4) / math.comb(100, 4)
    assert np.sum(samples.max(1) < 50) > 0.8 * 1000 * clean


def test_matches_in_the_order_of_their_quality_need_fewer_samples():
    rng = np.random.default_rng(5)
    x1 = rng.normal(size=(2, 400))
    wrong = np.arange(400) >= 60
    x2 = np.where(wrong, rng.normal(size=(2, 400)), 1.1 * x1 + 0.2) + 0.001 * rng.normal(size=(2, 400))
    order = rng.permutation(400)
    problem = homography_matrix(np.concatenate([x1, x2])[:, order], 0.01)
    quality = np.where(wrong, rng.uniform(0, 0.6, 400), rng.uniform(0.4, 1, 400))[order]
    config = RansacConfig(min_iterations=1)
    uniform = ransac(problem, config, np.random.default_rng(0))
    guided = ransac(problem, config, np.random.default_rng(0), quality)
    assert guided.iterations < 0.3 * uniform.iterations
    for found in (uniform, guided):
        assert found.inliers[~wrong[order]].mean() > 0.95
        assert found.inliers[wrong[order]].mean() < 0.05


def test_sampling_ends_where_a_model_with_enough_inliers_would_have_been_found():
    rng = np.random.default_rng(6)
    problem = homography_matrix(rng.normal(size=(4, 30)), 0.3)
    drawn = []
    best = problem.best
    problem.best = lambda models, *rest: drawn.append(len(models)) or best(models, *rest)
    found = ransac(problem, RansacConfig(), rng)
    assert isinstance(found, Rejected)
    # 15 of 30 inliers: log(0.0001) / log(1 − 1365 / 27405) = 181 draws, not the 10,000 that few inliers ask for.
    assert sum(drawn) < 250


def test_too_few_data_are_rejected_with_numbers():
    problem = fundamental_matrix(np.zeros((4, 10)), 1.0)
    found = ransac(problem, RansacConfig(), np.random.default_rng(0))
    assert isinstance(found, Rejected)
    assert found.reason == "too_few_points"
    assert "10 of 15" in found.detail
