from __future__ import annotations

import dataclasses
import tracemalloc

import numpy as np
import pytest
from scipy.linalg import block_diag

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance, squared_errors
from sfm.bundle.gauge import held_by_three_points, held_by_two_cameras
from sfm.bundle.layout import lay_out
from sfm.core.cameras import MODELS, Camera
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3

FREE = BundleConfig(gauge="free")


def residuals(problem: BundleProblem, delta: np.ndarray) -> np.ndarray:
    """Residuals over their standard deviations after a step of all poses, then all free parameters, then all points."""
    images = len(problem.free_poses)
    poses = Rigid3.exp(delta[: 6 * images].reshape(-1, 6)) @ problem.cams_from_world
    params = problem.camera_params.copy()
    count = int(problem.free_params.sum())
    params[problem.free_params] += delta[6 * images : 6 * images + count]
    points = problem.points3D + delta[6 * images + count :].reshape(-1, 3)
    out = np.empty((len(problem.obs_images), 2))
    names = {model.model_id: model.name for model in MODELS}
    for c, row in enumerate(params):
        name = names[int(problem.model_ids[c])]
        length = len(Camera(name, 10, 10, np.ones(12)[: _length(name)]).params)
        camera = Camera(name, 1000, 760, row[:length])
        mine = problem.image_cameras[problem.obs_images] == c
        seen = poses[problem.obs_images[mine]] @ points[problem.obs_points[mine]]
        out[mine] = camera.project(seen)[0] - problem.obs_points2D[mine]
    sigmas = np.ones(len(out)) if problem.obs_sigmas is None else problem.obs_sigmas
    return (out / sigmas[:, None]).ravel()


def _length(name: str) -> int:
    return {"PINHOLE": 4, "SIMPLE_RADIAL": 4, "OPENCV": 8}[name]


def dense_information(problem: BundleProblem) -> np.ndarray:
    """JᵀJ by central differences."""
    size = 6 * len(problem.free_poses) + int(problem.free_params.sum()) + 3 * len(problem.points3D)
    J = np.empty((2 * len(problem.obs_images), size))
    for k in range(size):
        step = np.zeros(size)
        step[k] = 1e-6
        J[:, k] = (residuals(problem, step) - residuals(problem, -step)) / 2e-6
    return J.T @ J


def in_world_axes(problem: BundleProblem, size: int) -> np.ndarray:
    """Turns tangents in the axes of the world, in which the gauge is held, into those of the cameras."""
    out = np.eye(size)
    for k, R in enumerate(problem.cams_from_world.rotation.matrix):
        out[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = np.kron(np.eye(2), R)
    return out


def blocks(matrix: np.ndarray, first: int, size: int, count: int) -> np.ndarray:
    return np.stack([matrix[k : k + size, k : k + size] for k in range(first, first + size * count, size)])


def assert_same(found: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    """Covariances (N, n, n) that differ by less than a part of the standard deviations."""
    sigmas = np.sqrt(np.maximum(np.einsum("naa->na", expected), 1e-20))
    unit = sigmas[:, None] * sigmas[:, :, None]
    np.testing.assert_allclose(found / unit, expected / unit, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("model", "free"), [("PINHOLE", ()), ("SIMPLE_RADIAL", (0, 3)), ("OPENCV", (0, 1, 2, 3, 4))])
def test_covariances_are_the_blocks_of_the_inverse_normal_matrix(make_problem, rng, model, free):
    problem = make_problem(rng, images=4, points=25, model=model, cameras=2, free_params=free, seen=0.95)
    problem = dataclasses.replace(problem, obs_sigmas=rng.uniform(0.5, 2, len(problem.obs_images)))
    found = covariance(problem)
    assert isinstance(found, BundleCovariance)
    H = dense_information(problem)
    held = held_by_two_cameras(problem, lay_out(problem, np.ones(len(problem.obs_images), bool))).ravel()
    kept = np.ones(len(H), bool)
    kept[: len(held)] = ~held
    world = in_world_axes(problem, len(H))
    H = world.T @ H @ world
    inverse = np.zeros_like(H)
    inverse[np.ix_(kept, kept)] = np.linalg.inv(H[np.ix_(kept, kept)])
    inverse = world @ inverse @ world.T
    start = 24 + 2 * len(free)
    assert_same(found.poses, blocks(inverse, 0, 6, 4), 1e-5)
    assert_same(found.points3D, blocks(inverse, start, 3, 25), 1e-5)
    if free:
        params = blocks(inverse, 24, len(free), 2)
        assert_same(found.params[:, free][:, :, free], params, 1e-5)
        assert np.count_nonzero(found.params) == params.size


def test_the_free_gauge_is_the_pseudo_inverse_of_the_reduced_matrix(make_problem, rng):
    problem = make_problem(rng, images=5, points=30, model="SIMPLE_RADIAL", free_params=(0, 3), seen=0.95)
    found = covariance(problem, FREE)
    assert isinstance(found, BundleCovariance)
    H = dense_information(problem)
    n = 32
    M = block_diag(*[np.linalg.inv(block) for block in blocks(H, n, 3, 30)])
    W = H[:n, n:]
    S = H[:n, :n] - W @ M @ W.T
    values, vectors = np.linalg.eigh(S)
    assert values[6] < 1e-6 * values[7]
    sigma = (vectors[:, 7:] / values[7:]) @ vectors[:, 7:].T
    assert_same(found.poses, blocks(sigma, 0, 6, 5), 1e-4)
    assert_same(found.points3D, blocks(M + M @ W.T @ sigma @ W @ M, 0, 3, 30), 1e-4)
    held = covariance(problem)
    assert isinstance(held, BundleCovariance)
    assert np.trace(found.poses, axis1=1, axis2=2).sum() < np.trace(held.poses, axis1=1, axis2=2).sum()


def test_constant_parts_take_the_freedom_of_the_scene_away(make_problem, rng):
    problem = make_problem(rng, images=5, points=30)
    for constant in (1, 2):
        poses = np.ones(5, bool)
        poses[:constant] = False
        fixed = dataclasses.replace(problem, free_poses=poses)
        free, held = covariance(fixed, FREE), covariance(fixed)
        assert isinstance(free, BundleCovariance)
        assert isinstance(held, BundleCovariance)
        assert not free.poses[:constant].any()
        same = np.allclose(free.poses, held.poses, rtol=1e-6, atol=1e-12)
        assert same == (constant == 2)


def test_twenty_thousand_constant_points_take_no_memory_to_speak_of(make_problem, rng):
    """A square of the number of their coordinates would be 29 GB."""
    count = 20_000
    problem = make_problem(rng, images=3, points=count, seen=0.5)
    problem = dataclasses.replace(problem, free_points=np.zeros(count, bool))
    tracemalloc.start()
    free = covariance(problem, FREE)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    held = covariance(problem)
    assert isinstance(free, BundleCovariance)
    assert isinstance(held, BundleCovariance)
    np.testing.assert_array_equal(free.poses, held.poses)
    assert free.poses.any(axis=(1, 2)).all()
    assert peak < 5000 * count


def test_predicted_covariances_are_those_of_repeated_measurements(make_problem, rng):
    truth = make_problem(rng, images=5, points=50, model="SIMPLE_RADIAL", free_params=(0,))
    noise = 0.3
    predicted = covariance(dataclasses.replace(truth, obs_sigmas=np.full(len(truth.obs_images), noise)))
    assert isinstance(predicted, BundleCovariance)
    poses, focals, points, factors = [], [], [], []
    turn = in_world_axes(truth, 30)
    config = BundleConfig(relative_cost_tolerance=1e-9)
    for _ in range(300):
        measured = truth.obs_points2D + noise * rng.normal(size=truth.obs_points2D.shape)
        found = adjust(dataclasses.replace(truth, obs_points2D=measured), config).problem
        left = (found.cams_from_world @ truth.cams_from_world.inverse()).log()
        poses.append((turn.T @ left.ravel()).reshape(-1, 6))
        focals.append(found.camera_params[0, 0] - truth.camera_params[0, 0])
        points.append(found.points3D - truth.points3D)
        factors.append(2 * 0.5 * np.nansum(squared_errors(found)) / noise**2)
    variance = np.mean(np.square(poses), axis=0)
    expected = np.diag(turn.T @ block_diag(*predicted.poses) @ turn).reshape(-1, 6)
    free = expected > 1e-9 * expected.max()
    assert free.sum() == 30 - 7
    ratio = np.sqrt(variance[free] / expected[free])
    assert 0.9 < np.median(ratio) < 1.1
    assert (np.abs(ratio - 1) < 0.2).all()
    assert 0.9 < np.std(focals) / np.sqrt(predicted.params[0, 0, 0]) < 1.1
    ratio = np.sqrt(np.mean(np.square(points), axis=0) / np.einsum("iaa->ia", predicted.points3D))
    assert 0.95 < np.nanmedian(ratio) < 1.05
    assert np.isnan(ratio).sum() <= 3
    freedom = 2 * len(truth.obs_images) - 150 - 23 - 1
    assert abs(np.mean(factors) / freedom - 1) < 0.02


def test_the_variance_factor_finds_noise_that_was_not_stated(make_problem, rng):
    problem = make_problem(rng, images=8, points=300, noise_px=0.4)
    solution = adjust(problem).problem
    found = covariance(solution)
    assert isinstance(found, BundleCovariance)
    assert abs(np.sqrt(found.variance_factor) / 0.4 - 1) < 0.05
    scaled = found.scaled()
    assert scaled.variance_factor == pytest.approx(1)
    np.testing.assert_allclose(scaled.points3D, found.points3D * found.variance_factor)
    with_sigmas = covariance(dataclasses.replace(solution, obs_sigmas=np.full(len(problem.obs_images), 0.4)))
    assert isinstance(with_sigmas, BundleCovariance)
    np.testing.assert_allclose(with_sigmas.poses, found.poses * 0.16, rtol=1e-6, atol=1e-15)


def test_a_prior_is_information(make_problem, rng):
    problem = make_problem(rng, images=4, points=40, free_params=(0, 1))
    expected = np.zeros((1, MAX_PARAMS))
    expected[:] = problem.camera_params
    for sigma in (1e-4, 1e9):
        sigmas = np.full((1, MAX_PARAMS), np.inf)
        sigmas[0, :2] = sigma
        found = covariance(dataclasses.replace(problem, prior_params=expected, prior_sigmas=sigmas))
        assert isinstance(found, BundleCovariance)
        if sigma < 1:
            np.testing.assert_allclose(np.diag(found.params[0])[:2], sigma**2, rtol=1e-3)
        else:
            without = covariance(problem)
            assert isinstance(without, BundleCovariance)
            np.testing.assert_allclose(found.params, without.params, rtol=1e-6)


def test_without_anything_left_over_there_is_no_variance_factor_and_nothing_to_scale(make_problem, rng):
    found = covariance(make_problem(rng, images=2, points=5, seen=1.1))
    assert isinstance(found, BundleCovariance)
    assert np.isnan(found.variance_factor)
    assert np.isfinite(found.poses).all()
    with pytest.raises(ValueError, match="positive and finite"):
        found.scaled()


def test_what_observations_leave_open_is_named(make_problem, rng):
    problem = make_problem(rng, images=5, points=40, seen=1.0)
    # Image 3 sees two points only: four equations for six unknowns.
    kept = (problem.obs_images != 3) | (problem.obs_points < 2)
    few = dataclasses.replace(
        problem,
        obs_images=problem.obs_images[kept],
        obs_points=problem.obs_points[kept],
        obs_points2D=problem.obs_points2D[kept],
    )
    for config in (BundleConfig(), FREE):
        found = covariance(few, config)
        assert isinstance(found, Rejected)
        assert (found.reason, found.detail) == ("undetermined_pose", "3")


def test_a_point_on_one_ray_has_no_covariance_and_others_keep_theirs(make_problem, rng):
    problem = make_problem(rng, images=4, points=30, seen=1.0)
    kept = (problem.obs_points != 7) | (problem.obs_images == 1)
    lonely = dataclasses.replace(
        problem,
        obs_images=problem.obs_images[kept],
        obs_points=problem.obs_points[kept],
        obs_points2D=problem.obs_points2D[kept],
    )
    found = covariance(lonely)
    assert isinstance(found, BundleCovariance)
    assert np.isnan(found.points3D[7]).all()
    assert np.isfinite(np.delete(found.points3D, 7, axis=0)).all()
    assert np.isfinite(found.poses).all()


def test_three_points_hold_the_scene_as_well_as_two_cameras(make_problem, perturbed, rng):
    truth = make_problem(rng, images=5, points=50, model="SIMPLE_RADIAL", free_params=(0,), seen=0.95)
    layout = lay_out(truth, np.ones(len(truth.obs_images), bool))
    held = held_by_three_points(truth, layout)
    assert held is not None
    points, noise = list(held.points), 0.3
    config = BundleConfig(gauge="three_points", relative_cost_tolerance=1e-12)
    predicted = covariance(dataclasses.replace(truth, obs_sigmas=np.full(len(truth.obs_images), noise)), config)
    assert isinstance(predicted, BundleCovariance)
    assert not predicted.points3D[points[:2]].any()
    plane = held.bases[2]
    normal = np.cross(plane[:, 0], plane[:, 1])
    np.testing.assert_allclose(normal @ predicted.points3D[points[2]], 0, atol=1e-15)
    centers, others = [], []
    for _ in range(300):
        measured = truth.obs_points2D + noise * rng.normal(size=truth.obs_points2D.shape)
        found = adjust(dataclasses.replace(truth, obs_points2D=measured), config).problem
        centers.append(found.cams_from_world.center - truth.cams_from_world.center)
        others.append(found.points3D - truth.points3D)
    np.testing.assert_allclose(np.array(others)[:, points[:2]], 0, atol=1e-9)
    ratio = np.sqrt(np.mean(np.square(centers), axis=0) / np.einsum("iaa->ia", predicted.centers))
    assert 0.93 < np.median(ratio) < 1.07
    rest = np.delete(np.arange(50), points)
    ratio = np.sqrt(np.mean(np.square(others), axis=0)[rest] / np.einsum("iaa->ia", predicted.points3D)[rest])
    assert 0.95 < np.median(ratio) < 1.05
    free, two = covariance(truth, FREE), covariance(truth)
    assert isinstance(free, BundleCovariance)
    assert isinstance(two, BundleCovariance)
    assert predicted.variance_factor * noise**2 == pytest.approx(two.variance_factor, rel=1e-6)
    np.testing.assert_allclose(predicted.params / noise**2, two.params, rtol=1e-5)


def test_three_points_leave_a_scene_alone_that_something_else_holds(make_problem, rng):
    problem = make_problem(rng, images=5, points=30)
    fixed = dataclasses.replace(problem, free_poses=np.array([False, True, True, True, True]))
    by_points, by_cameras = covariance(fixed, BundleConfig(gauge="three_points")), covariance(fixed)
    assert isinstance(by_points, BundleCovariance)
    assert isinstance(by_cameras, BundleCovariance)
    np.testing.assert_allclose(by_points.centers, by_cameras.centers, rtol=1e-9)
