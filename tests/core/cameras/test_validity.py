"""The range in which a model is one to one, and what happens beyond it."""

from __future__ import annotations

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from numpy.polynomial import Polynomial

from sfm.core.cameras import Camera

PINHOLE_PART = [500.0, 500.0, 400.0, 300.0]
small = st.floats(-0.5, 0.5)


def radial_twin(camera: Camera, radius: np.ndarray) -> np.ndarray:
    """r g(r²) of an OPENCV_FISHEYE or FULL_OPENCV camera."""
    k, s = camera.params[4:], radius**2
    if camera.model == "FULL_OPENCV":
        return radius * (1 + k[0] * s + k[1] * s**2 + k[4] * s**3) / (1 + k[5] * s + k[6] * s**2 + k[7] * s**3)
    return radius * (1 + k[0] * s + k[1] * s**2 + k[2] * s**3 + k[3] * s**4)


def first_root_twin(coefficients: list[float]) -> float:
    """The smallest positive real root of 1 + c₁ s + …, by the eigenvalues of the companion matrix."""
    roots = np.roots([*coefficients[::-1], 1.0])
    real = roots[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)].real
    return float(real.min()) if len(real) else math.inf


@given(k=small)
def test_one_coefficient_ends_where_the_slope_is_zero(k):
    camera = Camera("SIMPLE_RADIAL", 800, 600, np.array([500, 400, 300, k]))
    expected = math.inf if k >= -1e-13 / 3 else 1 / math.sqrt(-3 * k)
    assert camera.max_radius == pytest.approx(expected, rel=1e-12)
    assert camera.max_angle == pytest.approx(math.atan(expected), rel=1e-12)


@given(k=st.lists(st.floats(-0.3, 0.3).filter(lambda c: abs(c) > 1e-3), min_size=4, max_size=4))
def test_four_coefficients_end_at_the_first_root_of_the_slope(k):
    camera = Camera("OPENCV_FISHEYE", 800, 600, np.array([*PINHOLE_PART, *k]))
    slope = [(2 * i + 3) * c for i, c in enumerate(k)]
    assert camera.max_angle == pytest.approx(min(math.sqrt(first_root_twin(slope)), math.pi), rel=1e-6)


@given(k=st.lists(small, min_size=3, max_size=3), d=st.lists(small, min_size=3, max_size=3))
def test_a_rational_radius_increases_up_to_the_limit_and_no_further(k, d):
    camera = Camera("FULL_OPENCV", 800, 600, np.array([*PINHOLE_PART, *k[:2], 0, 0, k[2], *d]))
    limit = camera.max_radius
    inner = np.linspace(0, min(limit, 50.0) * (1 - 1e-9), 2000)
    assert (np.diff(radial_twin(camera, inner)) > -1e-12).all()
    if limit < 50.0:
        numerator, denominator, s = Polynomial([1, *k]), Polynomial([1, *d]), Polynomial([0, 1])
        slope = (numerator + 2 * s * numerator.deriv()) * denominator - 2 * s * numerator * denominator.deriv()
        size = 1 + limit**2
        assert min(abs(denominator(limit**2)) / size**3, abs(slope(limit**2)) / size**6) < 1e-9


def test_a_slope_that_falls_and_rises_again_ends_at_the_fall():
    camera = Camera("RADIAL", 800, 600, np.array([500, 400, 300, -0.5, 0.1]))
    first, second = np.sqrt(np.sort(np.roots([5 * 0.1, 3 * -0.5, 1]).real))
    radii = np.array([0.99 * first, 1.01 * first, 0.5 * (first + second), 1.01 * second, 3 * second])
    points = np.stack([radii, 0 * radii, 1 + 0 * radii], axis=1)
    pixels, valid = camera.project(points)
    assert camera.max_radius == pytest.approx(first, rel=1e-12)
    assert valid.tolist() == [True, False, False, False, False]
    assert np.isnan(pixels[1:]).all()


def test_a_slope_that_touches_zero_or_nearly_does_is_told_apart():
    touching = 9 / 20 * 0.4**2  # 1 + 3 k1 s + 5 k2 s² has a double root at s = -2 / (3 k1)
    for k2, expected in [(touching * (1 + 1e-6), math.inf), (touching * (1 - 1e-6), math.sqrt(2 / 1.2))]:
        camera = Camera("RADIAL", 800, 600, np.array([500, 400, 300, -0.4, k2]))
        assert camera.max_radius == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("model", "extra"),
    [
        ("SIMPLE_RADIAL", [-0.25]),
        ("RADIAL", [-0.4, 0.05]),
        ("OPENCV", [-0.3, 0.02, 1e-3, -2e-3]),
        ("FULL_OPENCV", [-0.3, 0.05, 1e-3, -2e-3, -0.01, 0.05, 0.0, 0.0]),
        ("OPENCV_FISHEYE", [-0.05, -0.01, 0.0, 0.0]),
        ("SIMPLE_RADIAL_FISHEYE", [-0.08]),
        ("THIN_PRISM_FISHEYE", [-0.05, -0.01, 1e-3, 1e-3, 0.0, 0.0, 1e-3, 1e-3]),
        ("EUCM", [0.7, 1.1]),
        ("FULL_OPENCV_THIN_PRISM", [-0.3, 0.05, 1e-3, -2e-3, -0.01, 0.05, 0, 0, 1e-3, 0, -1e-3, 1e-3]),
        ("DOUBLE_SPHERE", [0.3, 0.7]),
        ("DOUBLE_SPHERE", [-0.4, 0.55]),
    ],
)
def test_pixels_beyond_the_rim_have_no_ray(model, extra):
    focal = PINHOLE_PART[1:] if model in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE") else PINHOLE_PART
    camera = Camera(model, 800, 600, np.array([*focal, *extra]))
    turn = np.linspace(0, 2 * np.pi, 33)

    def circle(angle: float) -> np.ndarray:
        return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle) + 0 * turn], axis=1)

    rim, valid = camera.project(circle(0.97 * camera.max_angle))
    assert valid.all()
    outside, found = camera.unproject([400.0, 300.0] + 1.2 * (rim - [400, 300]))
    assert not found.any()
    assert np.isnan(outside).all()
    inside, found = camera.unproject([400.0, 300.0] + 0.98 * (rim - [400, 300]))
    assert found.all()
    assert (np.arctan2(np.hypot(inside[:, 0], inside[:, 1]), inside[:, 2]) < camera.max_angle).all()
    _, valid = camera.project(circle(min(1.05 * camera.max_angle, math.pi)))
    assert not valid.any()


def test_cameras_without_a_rim_see_up_to_the_horizon_or_all_around():
    assert Camera("PINHOLE", 800, 600, np.array(PINHOLE_PART)).max_radius == math.inf
    assert Camera("PINHOLE", 800, 600, np.array(PINHOLE_PART)).max_angle == math.pi / 2
    assert Camera("OPENCV", 800, 600, np.array([*PINHOLE_PART, 0.1, 0.2, 0, 0])).max_radius == math.inf
    assert Camera("EQUIRECTANGULAR", 800, 400, np.array([800.0, 400.0])).max_angle == math.pi
    assert Camera("OPENCV_FISHEYE", 800, 600, np.array([*PINHOLE_PART, 0, 0, 0, 0])).max_radius == math.pi


@np.errstate(divide="ignore", invalid="ignore")  # without JIT, NumPy warns
def test_a_point_exactly_on_a_pole_is_invalid():
    camera = Camera("FULL_OPENCV", 800, 600, np.array([*PINHOLE_PART, 0, 0, 0, 0, 0, -0.5, 0, 0]))
    pixels, by_point, by_params, valid = camera.project_with_jacobians(np.array([[1.0, 1, 1], [0.5, 0.5, 1]]))
    assert valid.tolist() == [False, True]
    assert np.isnan(pixels[0]).all()
    assert (by_point[0] == 0).all()
    assert (by_params[0] == 0).all()


@np.errstate(divide="ignore", invalid="ignore")  # as above
def test_a_focal_length_of_zero_gives_no_rays(camera):
    params = camera.params.copy()
    params[list(camera.model_info.focal_indices) or [0]] = 0.0
    rays, found = camera.with_params(params).unproject(np.array([[11.0, 13.0]]))
    assert not found.any()
    assert np.isnan(rays).all()


@np.errstate(invalid="ignore")  # as above
def test_parameters_that_are_no_numbers_give_nothing():
    camera = Camera("OPENCV", 800, 600, np.array([*PINHOLE_PART, np.nan, 0, 0, 0]))
    assert not camera.project(np.array([[0.1, 0.2, 1.0]]))[1].any()
    assert not camera.unproject(np.array([[100.0, 200.0]]))[1].any()


@pytest.mark.parametrize("size", [(400, 300), (1600, 1200), (801, 599)])
def test_a_scaled_camera_projects_scaled_pixels(camera, seen_points, size):
    points, info = seen_points(50), camera.model_info
    ratio = np.array(size) / [camera.width, camera.height]
    if len(info.focal_indices) == 1:  # such a model keeps its aspect
        size = (camera.width * 3, camera.height * 3)
        ratio = np.array([3.0, 3.0])
    scaled = camera.scaled(*size)
    assert (scaled.width, scaled.height) == size
    np.testing.assert_allclose(scaled.project(points)[0], camera.project(points)[0] * ratio, rtol=0, atol=1e-8)
    np.testing.assert_allclose(scaled.max_angle, camera.max_angle, rtol=1e-15)


def test_changed_cameras_keep_the_rest():
    camera = Camera("PINHOLE", 800, 600, np.array(PINHOLE_PART), has_prior_focal_length=True)
    other = camera.with_params(np.array([1.0, 2, 3, 4]))
    assert (other.model, other.width, other.height, other.has_prior_focal_length) == ("PINHOLE", 800, 600, True)
    assert camera.scaled(400, 300).has_prior_focal_length
    with pytest.raises(ValueError, match="shape"):
        camera.with_params(np.zeros(3))
    with pytest.raises(ValueError, match="size"):
        camera.scaled(0, 10)
