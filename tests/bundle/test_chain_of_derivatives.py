"""Residuals of whole problems, differentiated by complex steps, for every camera model.

What users get of our derivatives is the largest entry of the gradient and the covariances; with one parameter or one
point free the former is the gradient, and of one pose the latter is the inverse of a 6 × 6 normal matrix.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance, squared_errors
from sfm.core.cameras import MODELS
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.cameras.models import model_by_id
from sfm.core.optim import evaluate_loss
from tests.bundle.conftest import looking_inwards
from tests.core.cameras import complex_step
from tests.core.cameras.conftest import random_camera


@pytest.fixture(params=[model.name for model in MODELS])
def problem(request: pytest.FixtureRequest) -> BundleProblem:
    """Four images of 15 points by two cameras of a model, 2 px of noise, observations of different precision."""
    rng = np.random.default_rng([3, len(request.param)])
    cameras = [random_camera(request.param, rng) for _ in range(2)]
    poses, points3D = looking_inwards(4, rng), rng.uniform(-2, 2, (15, 3))
    images, points = (grid.ravel() for grid in np.meshgrid(np.arange(4), np.arange(15)))
    params = np.zeros((2, MAX_PARAMS))
    for row, camera in zip(params, cameras, strict=True):
        row[: len(camera.params)] = camera.params
    made = BundleProblem(
        model_ids=np.full(2, cameras[0].model_info.model_id, np.int32),
        camera_params=params,
        image_cameras=np.array([0, 1, 0, 1], np.int32),
        cams_from_world=poses,
        points3D=points3D,
        obs_images=images.astype(np.int32),
        obs_points=points.astype(np.int32),
        obs_points2D=np.zeros((60, 2)),
        free_params=np.zeros((2, MAX_PARAMS), bool),
        free_poses=np.ones(4, bool),
        free_points=np.ones(15, bool),
        obs_sigmas=rng.uniform(0.5, 2, 60),
    )
    return dataclasses.replace(made, obs_points2D=pixels(made, in_cameras(made)) + 2 * rng.normal(size=(60, 2)))


def in_cameras(problem: BundleProblem) -> np.ndarray:
    return problem.cams_from_world[problem.obs_images] @ problem.points3D[problem.obs_points]


def length(problem: BundleProblem) -> int:
    return len(model_by_id(int(problem.model_ids[0])).param_names)


def pixels(problem: BundleProblem, points: np.ndarray, params: np.ndarray | None = None) -> np.ndarray:
    """Of points (n, 3), which may be complex, by the camera of each observation."""
    params = problem.camera_params if params is None else params
    name, out = model_by_id(int(problem.model_ids[0])).name, np.zeros((len(points), 2), np.result_type(points, params))
    for c, row in enumerate(params):
        mine = problem.image_cameras[problem.obs_images] == c
        out[mine] = complex_step.project(name, row[: length(problem)], points[mine])
    return out


def whitened(problem: BundleProblem, values: np.ndarray) -> np.ndarray:
    assert problem.obs_sigmas is not None
    return values / problem.obs_sigmas[:, None]


def by_params(problem: BundleProblem, camera: int, k: int) -> np.ndarray:
    """(n, 2) of the whitened residuals."""
    params = problem.camera_params.astype(complex)
    params[camera, k] += 1j * complex_step.STEP
    return whitened(problem, np.imag(pixels(problem, in_cameras(problem), params)) / complex_step.STEP)


def by_motion(problem: BundleProblem, directions: np.ndarray) -> np.ndarray:
    """(n, 2) where each point moves in its camera's frame with the velocity `directions` (n, 3)."""
    moved = in_cameras(problem) + 1j * complex_step.STEP * directions
    return whitened(problem, np.imag(pixels(problem, moved)) / complex_step.STEP)


def with_free(problem: BundleProblem, params: Iterable = (), poses: Iterable = (), points: Iterable = ()):
    free_params = np.zeros_like(problem.free_params)
    for camera, k in params:
        free_params[camera, k] = True
    return dataclasses.replace(
        problem,
        free_params=free_params,
        free_poses=np.isin(np.arange(len(problem.free_poses)), list(poses)),
        free_points=np.isin(np.arange(len(problem.free_points)), list(points)),
    )


def gradient_max(problem: BundleProblem, loss: str) -> float:
    config = BundleConfig(loss=loss, loss_scale_px=1.5, max_iterations=0)  # type: ignore[arg-type]
    return adjust(problem, config).table[0].gradient_max


def weighted_residuals(problem: BundleProblem, loss: str) -> np.ndarray:
    """ρ'(|r|²) r (n, 2), whose product with a derivative of r is that of the cost."""
    r = whitened(problem, pixels(problem, in_cameras(problem)) - problem.obs_points2D)
    return evaluate_loss(loss, np.sum(r**2, axis=1), 1.5)[1][:, None] * r  # type: ignore[arg-type]


def test_squared_errors_are_those_of_the_formulas(problem):
    r = pixels(problem, in_cameras(problem)) - problem.obs_points2D
    np.testing.assert_allclose(squared_errors(problem), np.sum(r**2, axis=1), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_the_gradient_of_each_camera_parameter_is_that_of_complex_steps(problem, loss):
    residuals = weighted_residuals(problem, loss)
    for k in range(length(problem)):
        jacobian = by_params(problem, 1, k)
        expected, size = abs(np.sum(residuals * jacobian)), np.sum(np.abs(residuals * jacobian))
        assert gradient_max(with_free(problem, params=[(1, k)]), loss) == pytest.approx(expected, abs=1e-9 * size)


@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_the_gradient_of_each_point_is_that_of_complex_steps(problem, loss):
    residuals, R = weighted_residuals(problem, loss), problem.cams_from_world.rotation.matrix[problem.obs_images]
    terms = np.stack([np.sum(residuals * by_motion(problem, R[:, :, k]), axis=1) for k in range(3)], axis=1)
    for p in range(0, 15, 3):
        mine = terms[problem.obs_points == p]
        assert gradient_max(with_free(problem, points=[p]), loss) == pytest.approx(
            np.abs(mine.sum(axis=0)).max(), abs=1e-9 * np.abs(mine).sum()
        )


def test_the_normal_matrix_of_a_pose_is_that_of_complex_steps(problem):
    """Up to how its tangent is written: by the axes of the rotation's ellipsoid and the covariance of the centre."""
    x = in_cameras(problem)
    turns = [np.cross(axis, x) for axis in np.eye(3)]
    shifts = [np.broadcast_to(axis, x.shape) for axis in np.eye(3)]
    J = np.stack([by_motion(problem, direction) for direction in (*turns, *shifts)], axis=2)
    found = covariance(with_free(problem, poses=range(4)))
    assert isinstance(found, BundleCovariance)
    for i in range(4):
        mine = J[problem.obs_images == i].reshape(-1, 6)
        sigma = np.linalg.inv(mine.T @ mine)
        axes = np.linalg.eigvalsh(sigma[:3, :3])
        np.testing.assert_allclose(np.linalg.eigvalsh(found.poses[i, :3, :3]), axes, rtol=1e-6)
        R = problem.cams_from_world.rotation.matrix[i]
        center = R.T @ sigma[3:, 3:] @ R  # a shift υ of the frame moves the centre by −Rᵀ υ, a turn does not
        np.testing.assert_allclose(found.centers[i], center, rtol=0, atol=1e-6 * np.trace(center))


def test_the_normal_matrix_of_a_point_is_that_of_complex_steps(problem):
    R = problem.cams_from_world.rotation.matrix[problem.obs_images]
    J = np.stack([by_motion(problem, R[:, :, k]) for k in range(3)], axis=2)
    found = covariance(with_free(problem, points=range(15)))
    assert isinstance(found, BundleCovariance)
    for p in range(15):
        mine = J[problem.obs_points == p].reshape(-1, 3)
        expected = np.linalg.inv(mine.T @ mine)
        np.testing.assert_allclose(found.points3D[p], expected, rtol=0, atol=1e-7 * np.trace(expected))


def test_the_normal_matrix_of_everything_is_that_of_complex_steps(problem):
    """Two poses held; the first camera's parameters free as far as these few points tell them apart."""
    free = [(c, k) for c in range(2) for k in range(min(length(problem), 3))]
    x, by_world = in_cameras(problem), problem.cams_from_world.rotation.matrix[problem.obs_images]
    columns = []
    for i in (2, 3):
        mine = (problem.obs_images == i)[:, None]
        columns += [by_motion(problem, mine * np.cross(axis, x)) for axis in np.eye(3)]
        columns += [by_motion(problem, mine * axis) for axis in np.eye(3)]
    columns += [by_params(problem, c, k) for c, k in free]
    for p in range(15):
        columns += [by_motion(problem, (problem.obs_points == p)[:, None] * by_world[:, :, k]) for k in range(3)]
    J = np.stack([column.ravel() for column in columns], axis=1)
    sizes = np.linalg.norm(J, axis=0)
    sigma = np.linalg.inv((J / sizes).T @ (J / sizes)) / np.outer(sizes, sizes)
    found = covariance(with_free(problem, params=free, poses=(2, 3), points=range(15)))
    assert isinstance(found, BundleCovariance)
    for row, i in enumerate((2, 3)):
        turn = sigma[6 * row : 6 * row + 3, 6 * row : 6 * row + 3]
        axes = np.linalg.eigvalsh(found.poses[i, :3, :3])
        np.testing.assert_allclose(axes, np.linalg.eigvalsh(turn), rtol=1e-5)
        shift = sigma[6 * row + 3 : 6 * row + 6, 6 * row + 3 : 6 * row + 6]
        R = problem.cams_from_world.rotation.matrix[i]
        np.testing.assert_allclose(found.centers[i], R.T @ shift @ R, rtol=0, atol=1e-5 * np.trace(shift))
    first = 12 + len(free)
    for c in range(2):
        block = sigma[12:first, 12:first][c * len(free) // 2 : (c + 1) * len(free) // 2]
        block = block[:, c * len(free) // 2 : (c + 1) * len(free) // 2]
        ours = found.params[c, : len(block), : len(block)]
        scale = np.sqrt(np.outer(np.diag(block), np.diag(block)))
        np.testing.assert_allclose(ours / scale, block / scale, rtol=0, atol=1e-5)
    for p in range(15):
        mine = slice(first + 3 * p, first + 3 * p + 3)
        expected = sigma[mine, mine]
        np.testing.assert_allclose(found.points3D[p], expected, rtol=0, atol=1e-5 * np.trace(expected))
