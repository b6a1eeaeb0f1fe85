"""Analytic Jacobians against complex steps, from the axis to where a model ends, and what happens beyond."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import MODELS, Camera
from tests.core.cameras import complex_step
from tests.core.cameras.conftest import random_camera

# Lenses that end early, by the radius or by the angle, besides the random ones, some of which never end.
ENDING = {
    "SIMPLE_RADIAL": [500, 400, 300, -0.25],
    "RADIAL": [500, 400, 300, -0.4, 0.05],
    "OPENCV": [500, 510, 400, 300, -0.3, 0.02, 1e-3, -2e-3],
    "FULL_OPENCV": [500, 510, 400, 300, -0.3, 0.05, 1e-3, -2e-3, -0.01, 0.05, 0.01, 0.002],
    "OPENCV_FISHEYE": [300, 310, 400, 300, -0.05, -0.01, 0.0, 0.0],
    "SIMPLE_RADIAL_FISHEYE": [300, 400, 300, -0.08],
    "RADIAL_FISHEYE": [300, 400, 300, -0.08, -0.004],
    "THIN_PRISM_FISHEYE": [300, 310, 400, 300, -0.05, -0.01, 1e-3, 1e-3, 0.001, 0.0, 1e-3, 2e-3],
    "EUCM": [300, 310, 400, 300, 0.7, 1.1],
    "FULL_OPENCV_THIN_PRISM": [
        500,
        510,
        400,
        300,
        -0.3,
        0.05,
        1e-3,
        -2e-3,
        -0.01,
        0.05,
        0.01,
        0.002,
        1e-3,
        -5e-4,
        -2e-3,
        4e-4,
    ],
    "DOUBLE_SPHERE": [300, 310, 400, 300, -0.2, 0.65],
}
PARTS = np.array([1e-9, 1e-6, 1e-3, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.999, 1 - 1e-6])
"""Of the way from the axis to the end."""
_WIDEST_RADIUS, _WIDEST_ANGLE = 20.0, 0.999 * np.pi


def cameras() -> list[Camera]:
    rng = np.random.default_rng(7)
    drawn = [random_camera(model.name, rng) for model in MODELS for _ in range(3)]
    return drawn + [Camera(name, 800, 600, np.array(params, float)) for name, params in ENDING.items()]


@pytest.fixture(params=cameras(), ids=lambda c: f"{c.model}-{c.params[0]:.0f}")
def camera(request: pytest.FixtureRequest) -> Camera:
    return request.param


def rays_to_the_edge(camera: Camera) -> np.ndarray:
    """Twelve around the axis at each part of the way, at different distances; with all around the panorama's."""
    turn = np.arange(12) * (np.pi / 6) + 0.1
    if camera.model_info.is_fisheye:
        angle = PARTS * min(camera.max_angle, _WIDEST_ANGLE)
    else:
        angle = np.arctan(PARTS * min(camera.max_radius, _WIDEST_RADIUS))
    angle, turn = (grid.ravel() for grid in np.meshgrid(angle, turn, indexing="ij"))
    rays = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    return rays * 10.0 ** np.linspace(-2, 3, len(rays))[:, None]


def test_projection_is_that_of_the_formulas(camera):
    points = rays_to_the_edge(camera)
    pixels, valid = camera.project(points)
    expected = complex_step.project(camera.model, camera.params, points)
    assert valid.mean() > 0.85  # tangential terms end some of the last ones a little early
    np.testing.assert_allclose(pixels[valid], expected[valid], rtol=1e-10, atol=1e-8)


def test_derivatives_by_the_point_are_those_of_complex_steps(camera):
    """Relative to the largest entry for the same point: pixels per scene unit, whatever the distance."""
    points = rays_to_the_edge(camera)
    _, found, _, valid = camera.project_with_jacobians(points)
    expected = complex_step.by_point(camera.model, camera.params, points)
    scale = np.abs(expected).max(axis=(1, 2))
    assert np.isfinite(found).all()
    assert (np.abs(found - expected).max(axis=(1, 2))[valid] <= 1e-9 * scale[valid]).all()


def test_derivatives_by_the_parameters_are_those_of_complex_steps(camera):
    """Relative to the largest entry of the parameter for the same point, or to a rounding of the pixel."""
    points = rays_to_the_edge(camera)
    _, _, found, valid = camera.project_with_jacobians(points)
    expected = complex_step.by_params(camera.model, camera.params, points)
    scale = np.abs(expected).max(axis=1)
    assert np.isfinite(found).all()
    assert (np.abs(found - expected).max(axis=1)[valid] <= 1e-9 * scale[valid] + 1e-12).all()


@pytest.mark.parametrize("name", list(ENDING))
def test_beyond_the_end_there_is_neither_pixel_nor_derivative(name):
    camera = Camera(name, 800, 600, np.array(ENDING[name], float))
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    angle = min(camera.max_angle * 1.02 + 0.01, 3.1)
    points = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle) + 0 * turn], axis=1)
    pixels, by_point, by_params, valid = camera.project_with_jacobians(points)
    assert not valid.any()
    assert np.isnan(pixels).all()
    assert not by_point.any()
    assert not by_params.any()


def test_validity_does_not_depend_on_whether_derivatives_are_asked_for(camera):
    points = np.concatenate([rays_to_the_edge(camera), -rays_to_the_edge(camera), np.zeros((1, 3))])
    pixels, valid = camera.project(points)
    also, _, _, also_valid = camera.project_with_jacobians(points)
    assert np.array_equal(valid, also_valid)
    np.testing.assert_allclose(pixels, also, rtol=1e-13, atol=1e-10)
