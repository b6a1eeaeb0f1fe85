"""Projection and unprojection of every model, against plain NumPy, each other and the axioms."""

from __future__ import annotations

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from sfm.core.cameras import MODELS, Camera, _kernels, model_by_name

FISHEYE = np.array([300.0, 300.0, 400.0, 300.0])


def twin_project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """The models as their papers write them, one by one; valid points only."""
    p = dict(zip(camera.model_info.param_names, camera.params, strict=True))
    x, y, z = points.T
    rho = np.hypot(x, y)
    if camera.model == "EQUIRECTANGULAR":
        longitude, latitude = np.arctan2(x, z), np.arcsin(y / np.linalg.norm(points, axis=1))
        return np.stack([p["w"] * (longitude / (2 * np.pi) + 0.5), p["h"] * (latitude / np.pi + 0.5)], axis=1)
    if camera.model == "EUCM":
        m = p["alpha"] * np.sqrt(p["beta"] * rho**2 + z**2) + (1 - p["alpha"]) * z
        a, b = x / m, y / m
    elif camera.model == "DOUBLE_SPHERE":
        shifted = z + p["xi"] * np.linalg.norm(points, axis=1)
        m = p["alpha"] * np.hypot(rho, shifted) + (1 - p["alpha"]) * shifted
        a, b = x / m, y / m
    elif camera.model_info.is_fisheye:
        theta = np.arctan2(rho, z)
        a, b = theta * x / rho, theta * y / rho
    else:
        a, b = x / z, y / z
    s = a**2 + b**2
    k = [p.get("k", p.get("k1", 0.0)), *(p.get(f"k{i}", 0.0) for i in range(2, 7))]
    factor = 1 + k[0] * s + k[1] * s**2 + k[2] * s**3
    if camera.model.startswith("FULL_OPENCV"):
        factor /= 1 + k[3] * s + k[4] * s**2 + k[5] * s**3
    else:
        factor += k[3] * s**4
    p1, p2 = p.get("p1", 0.0), p.get("p2", 0.0)
    u = a * factor + 2 * p1 * a * b + p2 * (s + 2 * a**2) + p.get("sx1", p.get("s1", 0.0)) * s + p.get("s2", 0.0) * s**2
    v = b * factor + 2 * p2 * a * b + p1 * (s + 2 * b**2) + p.get("sy1", p.get("s3", 0.0)) * s + p.get("s4", 0.0) * s**2
    return np.stack([p.get("fx", p.get("f")) * u + p["cx"], p.get("fy", p.get("f")) * v + p["cy"]], axis=1)


def test_projection_is_the_formula_of_the_model(camera, seen_points):
    points = seen_points(500)
    pixels, valid = camera.project(points)
    assert valid.all()
    np.testing.assert_allclose(pixels, twin_project(camera, points), rtol=0, atol=1e-9)


def test_unprojection_inverts_projection(camera, seen_points):
    points = seen_points(500)
    rays, valid = camera.unproject(camera.project(points)[0])
    assert valid.all()
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), rtol=0, atol=2e-13)


def test_projection_inverts_unprojection_over_the_image(camera, rng):
    pixels = rng.uniform(0, 1, (1000, 2)) * [camera.width, camera.height]
    rays, valid = camera.unproject(pixels)
    assert valid.mean() > 0.3
    np.testing.assert_allclose(np.linalg.norm(rays[valid], axis=1), 1, rtol=0, atol=1e-14)
    again, seen = camera.project(rays[valid])
    assert seen.all()
    np.testing.assert_allclose(again, pixels[valid], rtol=0, atol=1e-8)
    assert np.isnan(rays[~valid]).all()


@given(
    model=st.sampled_from([m.name for m in MODELS if not m.is_fisheye]),
    coefficients=st.lists(st.floats(-0.4, 0.4), min_size=12, max_size=12),
    tangent=st.floats(0, 3),
    turn=st.floats(-math.pi, math.pi),
)
def test_a_valid_perspective_projection_can_be_inverted(model, coefficients, tangent, turn):
    info = model_by_name(model)
    extra = [
        0.01 * c if info.param_names[i][0] in "ps" else c
        for i, c in zip(info.extra_indices, coefficients, strict=False)
    ]
    camera = Camera(model, 800, 600, np.array([*[300.0] * len(info.focal_indices), 400, 300, *extra]))
    point = np.array([[tangent * math.cos(turn), tangent * math.sin(turn), 1.0]])
    pixels, valid = camera.project(point)
    if valid[0] and tangent < 0.98 * camera.max_radius:
        rays, found = camera.unproject(pixels)
        again, seen = camera.project(rays)
        assert found[0]
        assert seen[0]
        np.testing.assert_allclose(again, pixels, rtol=0, atol=1e-7)


@given(
    coefficients=st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=4),
    theta=st.floats(0, 3.1),
    turn=st.floats(-math.pi, math.pi),
)
def test_a_valid_fisheye_projection_comes_back_to_its_ray(coefficients, theta, turn):
    camera = Camera("OPENCV_FISHEYE", 800, 600, np.array([*FISHEYE, *coefficients]))
    ray = np.array([[math.sin(theta) * math.cos(turn), math.sin(theta) * math.sin(turn), math.cos(theta)]])
    pixels, valid = camera.project(ray)
    assert valid[0] == (theta < camera.max_angle) or abs(theta - camera.max_angle) < 1e-9
    if valid[0] and theta < 0.98 * camera.max_angle:
        rays, found = camera.unproject(pixels)
        assert found[0]
        np.testing.assert_allclose(rays, ray, rtol=0, atol=1e-7)


def test_padded_parameters_and_the_scalar_kernels_give_the_same(camera, seen_points):
    points, model_id = seen_points(20), camera.model_info.model_id
    padded = np.zeros(_kernels.MAX_PARAMS)
    padded[: len(camera.params)] = camera.params
    padded[len(camera.params) :] = 7.0  # whatever is behind the parameters is not read
    pixels, _ = camera.project(points)
    rays, _ = camera.unproject(pixels)
    for point, pixel, ray in zip(points, pixels, rays, strict=True):
        assert _kernels.project_point(model_id, padded, *point) == (*pixel, True)
        assert _kernels.unproject_point(model_id, padded, *pixel) == (*ray, True)


@np.errstate(invalid="ignore")  # without JIT, NumPy warns
def test_the_batch_with_jacobians_projects_alike(camera, seen_points):
    points = seen_points(100)
    points[3, 2] = np.nan
    pixels, valid = camera.project(points)
    also, *_, also_valid = camera.project_with_jacobians(points)
    np.testing.assert_array_equal(valid, also_valid)
    np.testing.assert_allclose(also, pixels, rtol=1e-13, atol=0)


def test_no_points_give_no_pixels(camera):
    pixels, valid = camera.project(np.empty((0, 3)))
    rays, found = camera.unproject(np.empty((0, 2)))
    assert pixels.shape == (0, 2)
    assert rays.shape == (0, 3)
    assert valid.shape == found.shape == (0,)


@np.errstate(invalid="ignore", divide="ignore")  # as above
def test_what_is_not_a_number_has_no_pixel_and_no_ray(camera):
    points = np.array([[np.nan, 0, 1], [0, np.nan, 1], [0.1, 0.1, np.nan], [np.inf, 0, 1], [0, 0, 0]])
    pixels, valid = camera.project(points)
    assert not valid[[0, 1, 2, 4]].any()
    assert np.isnan(pixels[~valid]).all()
    rays, found = camera.unproject(np.array([[np.nan, 10.0], [10.0, np.nan], [np.inf, 1.0]]))
    assert not found.any()
    assert np.isnan(rays).all()
    _, by_point, by_params, _ = camera.project_with_jacobians(points)
    assert (by_point[~valid] == 0).all()
    assert (by_params[~valid] == 0).all()


@pytest.mark.parametrize("model", [m.name for m in MODELS if not m.is_fisheye])
def test_a_perspective_camera_sees_nothing_behind_it(model):
    info = model_by_name(model)
    camera = Camera(
        model, 800, 600, np.array([*[300.0] * len(info.focal_indices), 400, 300, *[0.01] * len(info.extra_indices)])
    )
    assert not camera.project(np.array([[0.1, 0.1, -1.0], [0, 0, -1], [0.1, 0, 0], [0, 0, -0.0]]))[1].any()


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"])
def test_a_fisheye_sees_around_the_corner_and_keeps_the_order_of_angles(model):
    info = model_by_name(model)
    focal = [300.0] * len(info.focal_indices)
    camera = Camera(model, 800, 600, np.array([*focal, 400, 300, *[0.0] * len(info.extra_indices)]))
    angles = np.deg2rad([0, 30, 89.999, 90, 90.001, 120, 179])
    pixels, valid = camera.project(np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1))
    assert valid.all()
    np.testing.assert_allclose(pixels[:, 0], 400 + 300 * angles, rtol=0, atol=1e-10)
    assert not camera.project(np.array([[0, 0, -1.0]]))[1].any()
    assert camera.max_angle == math.pi


def test_the_eucm_ends_at_its_maximal_angle():
    for alpha, beta in [(0.3, 1.0), (0.45, 0.8), (0.6, 1.2), (0.8, 0.9), (0.0, 1.0)]:
        camera = Camera("EUCM", 800, 600, np.array([*FISHEYE, alpha, beta]))
        for offset, expected in [(-1e-6, True), (1e-6, False)]:
            angle = camera.max_angle + offset
            pixels, valid = camera.project(np.array([[math.sin(angle), 0, math.cos(angle)]]))
            assert valid[0] == expected
            if expected:
                rays, found = camera.unproject(pixels)
                assert found[0]
                assert math.atan2(rays[0, 0], rays[0, 2]) == pytest.approx(angle, abs=1e-6)


def test_the_eucm_with_equal_shares_sees_all_but_one_ray():
    camera = Camera("EUCM", 800, 600, np.array([*FISHEYE, 0.5, 0.8]))
    assert camera.max_angle == math.pi
    assert camera.project(np.array([[1e-3, 0, -1.0], [0, 0, -1]]))[1].tolist() == [True, False]


def test_the_seam_of_a_panorama_is_straight_behind():
    camera = Camera("EQUIRECTANGULAR", 2000, 1000, np.array([2000.0, 1000.0]))
    pixels, valid = camera.project(np.array([[1e-12, 0, -1], [-1e-12, 0, -1], [0, 0, 1], [1, 0, 0], [0, 1e9, 1]]))
    assert valid.all()
    np.testing.assert_allclose(pixels, [[2000, 500], [0, 500], [1000, 500], [1500, 500], [1000, 1000]], atol=1e-6)
    rays, found = camera.unproject(np.array([[0.0, 500], [2000, 500], [2500, 500], [500, 500], [10, -1], [10, 1001]]))
    assert found.tolist() == [True, True, True, True, False, False]
    np.testing.assert_allclose(rays[:4], [[0, 0, -1], [0, 0, -1], [-1, 0, 0], [-1, 0, 0]], atol=1e-12)
    assert not camera.project(np.array([[0, 1.0, 0], [0, -1.0, 0]]))[1].any()


def test_pixels_do_not_depend_on_the_distance_of_the_point(camera, seen_points):
    points = seen_points(100)
    near, far = camera.project(points * 2.0**-10)[0], camera.project(points * 2.0**10)[0]
    np.testing.assert_allclose(near, far, rtol=0, atol=1e-10)


def test_arrays_of_another_shape_are_refused(camera):
    with pytest.raises((ValueError, TypeError)):
        camera.project(np.zeros((3, 4)))
    with pytest.raises((ValueError, TypeError)):
        camera.unproject(np.zeros((3, 3)))
