"""Analytic derivatives against central differences."""

from __future__ import annotations

import numpy as np

from sfm.core.cameras import MODELS, Camera, _kernels


def numeric_by_point(camera: Camera, points: np.ndarray) -> np.ndarray:
    step = 1e-5 * np.linalg.norm(points, axis=1, keepdims=True)
    columns = []
    for axis in np.eye(3):
        ahead, behind = camera.project(points + step * axis)[0], camera.project(points - step * axis)[0]
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=2)


def numeric_by_params(camera: Camera, points: np.ndarray) -> np.ndarray:
    columns = []
    for k, value in enumerate(camera.params):
        step = 1e-5 * max(abs(value), 0.1)
        ahead, behind = (
            camera.with_params(camera.params + sign * step * (np.arange(len(camera.params)) == k)) for sign in (1, -1)
        )
        columns.append((ahead.project(points)[0] - behind.project(points)[0]) / (2 * step))
    return np.stack(columns, axis=2)


def assert_close_for_each_point(actual: np.ndarray, expected: np.ndarray, rtol: float) -> None:
    """The error of a column is measured by its largest entry over all points."""
    scale = np.abs(expected).max(axis=(0, 1))
    assert np.isfinite(expected).all()
    assert (np.abs(actual - expected) <= rtol * scale + 1e-9).all()


def test_derivatives_by_the_point_are_the_limit_of_differences(camera, seen_points):
    points = seen_points(200)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    _, by_point, _, valid = camera.project_with_jacobians(points)
    assert valid.all()
    if camera.model == "EQUIRECTANGULAR":  # away from the poles and the seam, where differences do not exist
        keep = (np.abs(points[:, 1]) < 0.95) & (points[:, 2] > -0.9)
        points, by_point = points[keep], by_point[keep]
    assert_close_for_each_point(by_point, numeric_by_point(camera, points), 1e-6)


def test_derivatives_by_the_parameters_are_the_limit_of_differences(camera, seen_points):
    points = seen_points(200)
    _, _, by_params, valid = camera.project_with_jacobians(points)
    assert valid.all()
    assert by_params.shape == (200, 2, len(camera.params))
    assert_close_for_each_point(by_params, numeric_by_params(camera, points), 1e-6)


def test_derivatives_vanish_along_the_ray(camera, seen_points):
    points = seen_points(200)
    _, by_point, _, _ = camera.project_with_jacobians(points)
    along = np.einsum("nij,nj->ni", by_point, points)
    np.testing.assert_allclose(along, 0, rtol=0, atol=1e-9 * max(camera.width, camera.height))


def test_derivatives_stay_exact_towards_the_axis():
    for info in MODELS:
        if info.name == "EQUIRECTANGULAR":
            continue
        focal = [300.0, 310.0][: len(info.focal_indices)]
        extra = {"EUCM": [0.5, 1.1], "DOUBLE_SPHERE": [0.0, 0.6]}.get(info.name, [0.02] * len(info.extra_indices))
        camera = Camera(info.name, 800, 600, np.array([*focal, 400, 300, *extra]))
        for offset in (0.0, 1e-300, 1e-160, 1e-12, 1e-10, 1e-9, 1e-7):
            point = 2.0 * np.array([[offset, -0.5 * offset, 1.0]])
            _, by_point, by_params, valid = camera.project_with_jacobians(point)
            expected = np.array([[focal[0] / 2, 0, 0], [0, focal[-1] / 2, 0]])
            assert valid[0]
            np.testing.assert_allclose(by_point[0], expected, rtol=0, atol=1e-9 + 300 * offset)
            assert np.isfinite(by_params).all()


def test_columns_behind_the_parameters_are_zero(camera, seen_points):
    by_point, by_params = np.full((2, 3), np.nan), np.full((2, _kernels.MAX_PARAMS), np.nan)
    u, v, ok = _kernels.project_point_jacobians(
        camera.model_info.model_id, camera.params, *seen_points(1)[0], by_point, by_params
    )
    assert ok
    assert np.isfinite([u, v]).all()
    assert np.isfinite(by_point).all()
    assert (by_params[:, len(camera.params) :] == 0).all()
    assert np.isfinite(by_params).all()


def test_one_focal_length_differentiates_as_the_sum_of_two(rng):
    points = rng.uniform([-0.5, -0.5, 1], [0.5, 0.5, 2], (20, 3))
    simple = Camera("RADIAL", 800, 600, np.array([500, 400, 300, 0.1, 0.05]))
    full = Camera("OPENCV", 800, 600, np.array([500, 500, 400, 300, 0.1, 0.05, 0, 0]))
    _, by_point, by_params, _ = simple.project_with_jacobians(points)
    _, also_by_point, also, _ = full.project_with_jacobians(points)
    np.testing.assert_allclose(by_point, also_by_point, rtol=1e-13)
    np.testing.assert_allclose(by_params[:, :, 0], also[:, :, :2].sum(axis=2), rtol=1e-13)
    np.testing.assert_allclose(by_params[:, :, 1:], also[:, :, 2:6], rtol=1e-13)
