"""Camera parameters within bounds, against scipy and the conditions of Karush, Kuhn and Tucker."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance
from sfm.bundle.adjustment import system_of
from sfm.bundle.problem import SolverChoice
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3

EXACT = BundleConfig(relative_cost_tolerance=1e-13)
FREE = (0, 1, 2, 3)


def bounded(problem: BundleProblem, lower: dict[tuple[int, int], float], upper: dict[tuple[int, int], float]):
    least, most = (np.full(problem.camera_params.shape, value) for value in (-np.inf, np.inf))
    for cell, value in lower.items():
        least[cell] = value
    for cell, value in upper.items():
        most[cell] = value
    return dataclasses.replace(problem, lower_params=least, upper_params=most)


@pytest.fixture
def scene(make_problem, perturbed, rng):
    """Two cameras of one model with focal lengths near 800 px and a distortion near −0.05; two poses are known."""
    truth = make_problem(
        rng, images=5, points=30, model="SIMPLE_RADIAL", cameras=2, noise_px=0.5, free_params=FREE, seen=0.95
    )
    poses = np.array([False, False, True, True, True])
    return perturbed(dataclasses.replace(truth, free_poses=poses), rng, 0.004)


def residuals(problem: BundleProblem, x: np.ndarray) -> np.ndarray:
    poses, params = problem.cams_from_world, problem.camera_params.copy()
    count = int(problem.free_params.sum())
    params[problem.free_params] = x[:count]
    tangents = np.zeros((5, 6))
    tangents[2:] = x[count : count + 18].reshape(3, 6)
    poses = Rigid3.exp(tangents) @ poses
    points = x[count + 18 :].reshape(-1, 3)
    out = np.empty((len(problem.obs_images), 2))
    seen = poses[problem.obs_images] @ points[problem.obs_points]
    for c, row in enumerate(params):
        mine = problem.image_cameras[problem.obs_images] == c
        out[mine] = Camera("SIMPLE_RADIAL", 1000, 760, row[:4]).project(seen[mine])[0] - problem.obs_points2D[mine]
    return out.ravel()


def by_scipy(problem: BundleProblem):
    start = np.concatenate([problem.camera_params[problem.free_params], np.zeros(18), problem.points3D.ravel()])
    lower, upper = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    for bound, name in ((lower, "lower_params"), (upper, "upper_params")):
        bound[: int(problem.free_params.sum())] = getattr(problem, name)[problem.free_params]
    return least_squares(
        lambda x: residuals(problem, x), start, bounds=(lower, upper), x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-9,
        max_nfev=60,
    )  # fmt: skip


def test_bounded_adjustments_end_where_those_of_scipy_do(scene):
    params = scene.camera_params.copy()
    params[0, 0], params[1, 0], params[0, 1], params[1, 1] = 820.0, 825.0, 505.0, 500.0
    problem = bounded(
        dataclasses.replace(scene, camera_params=params),
        {(0, 0): 790.0, (1, 0): 810.0, (0, 3): -0.1, (1, 1): 495.0},
        {(0, 0): 830.0, (1, 0): 830.0, (0, 3): 0.2, (0, 1): 530.0},
    )
    ours, theirs = adjust(problem, EXACT), by_scipy(problem)
    assert ours.final_cost == pytest.approx(theirs.cost, rel=1e-7)
    found = ours.problem.camera_params[ours.problem.free_params]
    np.testing.assert_allclose(found, theirs.x[: len(found)], rtol=1e-4, atol=1e-4)
    assert (1, "f") in ours.at_bounds
    assert ours.problem.camera_params[1, 0] == 810.0
    without = adjust(dataclasses.replace(problem, lower_params=None, upper_params=None), EXACT)
    assert without.final_cost < ours.final_cost
    assert without.at_bounds == ()


@pytest.mark.parametrize("solver", ["dense", "sparse", "iterative"])
@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_the_gradient_presses_parameters_against_their_bounds(scene, solver: SolverChoice, loss):
    lower = {(c, k): scene.camera_params[c, k] - abs(scene.camera_params[c, k]) * 1e-3 for c in (0, 1) for k in FREE}
    upper = {(c, k): scene.camera_params[c, k] + abs(scene.camera_params[c, k]) * 1e-3 for c in (0, 1) for k in FREE}
    problem = bounded(scene, lower, upper)
    config = dataclasses.replace(EXACT, solver=solver, loss=loss, max_iterations=200)
    result = adjust(problem, config)
    reached = result.problem.at_bounds
    assert 2 <= reached.sum() <= 8
    system, _ = system_of(result.problem, dataclasses.replace(config, gauge="free"), 1)
    cost, left = system.linearize()
    assert cost == pytest.approx(result.final_cost, rel=1e-12)
    camera, column, row, place = system.layout.parameters
    g = system.gradient[row, place] * np.abs(scene.camera_params[camera, column])
    at = reached[camera, column]
    low = result.problem.camera_params[camera, column] <= result.problem.param_bounds[0][camera, column]
    # Against a lower bound the cost falls to below, and against an upper one to above.
    assert np.all(np.where(low, g, -g)[at] > 0)
    assert np.abs(g[~at]).max(initial=0) < 1e-4 * np.abs(g[at]).max()
    assert left < 1e-3 * np.abs(system.gradient).max()


def test_bounds_far_away_change_nothing(scene):
    far = bounded(scene, {(0, 0): 1.0}, {(1, 0): 1e6, (0, 3): 50.0})
    one, other = adjust(scene), adjust(far)
    np.testing.assert_array_equal(one.problem.camera_params, other.problem.camera_params)
    np.testing.assert_array_equal(one.problem.points3D, other.problem.points3D)
    assert other.at_bounds == ()


def test_a_parameter_between_equal_bounds_stays_like_one_that_is_not_free(scene):
    cells = {(c, k): float(scene.camera_params[c, k]) for c in (0, 1) for k in FREE}
    held = adjust(bounded(scene, cells, cells), EXACT)
    constant = adjust(dataclasses.replace(scene, free_params=np.zeros_like(scene.free_params)), EXACT)
    np.testing.assert_array_equal(held.problem.camera_params, scene.camera_params)
    assert held.final_cost == pytest.approx(constant.final_cost, rel=1e-9)
    np.testing.assert_allclose(held.problem.points3D, constant.problem.points3D, atol=1e-6)


def test_a_bounded_adjustment_is_the_same_for_any_number_of_threads(scene):
    problem = bounded(scene, {}, {(0, 0): scene.camera_params[0, 0] + 0.1, (1, 3): scene.camera_params[1, 3] + 1e-4})
    results = [adjust(problem, threads=threads) for threads in (1, 3)]
    np.testing.assert_array_equal(results[0].problem.camera_params, results[1].problem.camera_params)
    np.testing.assert_array_equal(results[0].problem.points3D, results[1].problem.points3D)


def test_a_parameter_on_its_bound_has_no_covariance_of_its_own(scene):
    start, end = (float(there.camera_params[0, 0]) for there in (scene, adjust(scene, EXACT).problem))
    halfway = {(0, 0): 0.5 * (start + end)}
    result = adjust(bounded(scene, *((halfway, {}) if end < start else ({}, halfway))), EXACT)
    assert result.at_bounds == ((0, "f"),)
    free = result.problem.free_params.copy()
    free[0, 0] = False
    found, expected = covariance(result.problem), covariance(dataclasses.replace(result.problem, free_params=free))
    assert isinstance(found, BundleCovariance)
    assert isinstance(expected, BundleCovariance)
    assert found.params[0, 0, 0] == 0
    assert found.params[1, 0, 0] > 0
    np.testing.assert_array_equal(found.poses, expected.poses)


def test_a_start_out_of_its_bounds_is_an_error_that_names_it(scene):
    with pytest.raises(ValueError, match=r"k of camera 1 is -0\.0\d*, out of its bounds 0\.\.1"):
        bounded(scene, {(1, 3): 0.0}, {(1, 3): 1.0})
    with pytest.raises(ValueError, match="out of its bounds nan"):
        bounded(scene, {(0, 0): np.nan}, {})
    # What is not free may be anything.
    bounded(dataclasses.replace(scene, free_params=np.zeros_like(scene.free_params)), {(1, 3): 0.0}, {})
