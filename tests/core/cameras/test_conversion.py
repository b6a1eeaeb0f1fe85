"""Cameras in the words of other models: exact where names change, near where formulas do."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.cameras.conversion import converted, difference, fitted
from sfm.core.errors import Rejected

K = [500.0, 510.0, 330.0, 235.0]
EXACT = [
    ("SIMPLE_PINHOLE", [500.0, 330, 235], ["PINHOLE", "SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV_THIN_PRISM", "EUCM"]),
    ("PINHOLE", K, ["OPENCV", "EUCM", "DOUBLE_SPHERE"]),
    ("SIMPLE_RADIAL", [500.0, 330, 235, -0.1], ["RADIAL", "OPENCV", "FULL_OPENCV", "FULL_OPENCV_THIN_PRISM"]),
    ("OPENCV", [*K, -0.2, 0.05, 1e-3, -1e-3], ["FULL_OPENCV", "FULL_OPENCV_THIN_PRISM"]),
    ("FULL_OPENCV", [*K, -0.2, 0.05, 1e-3, -1e-3, 0, 0, 0, 0], ["OPENCV", "FULL_OPENCV_THIN_PRISM"]),
    ("FULL_OPENCV_THIN_PRISM", [*K, -0.2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], ["OPENCV", "FULL_OPENCV"]),
    ("RADIAL_FISHEYE", [300.0, 330, 235, 0.02, -0.004], ["OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"]),
    ("OPENCV_FISHEYE", [*K, 0.02, -0.004, 0.001, 1e-4], ["THIN_PRISM_FISHEYE"]),
    ("EUCM", [*K, 0.6, 1.0], ["DOUBLE_SPHERE"]),
    ("DOUBLE_SPHERE", [*K, 0.0, 0.6], ["EUCM"]),
    ("DOUBLE_SPHERE", [*K, 0.0, 0.0], ["PINHOLE", "OPENCV"]),
]


def camera_of(model: str, params: list[float]) -> Camera:
    return Camera(model, 640, 480, np.array(params, float), has_prior_focal_length=True)


@pytest.mark.parametrize(("model", "params", "target"), [(m, p, t) for m, p, targets in EXACT for t in targets])
def test_a_conversion_is_the_same_camera(model, params, target):
    camera = camera_of(model, params)
    other = converted(camera, target)
    assert isinstance(other, Camera)
    assert (other.model, other.width, other.height, other.has_prior_focal_length) == (target, 640, 480, True)
    apart = difference(camera, other)
    assert apart.largest_px < 1e-9
    assert apart.uncovered == 0
    again = converted(other, model)
    if isinstance(again, Camera):
        np.testing.assert_array_equal(again.params, camera.params)


@pytest.mark.parametrize(
    ("model", "params", "target", "told"),
    [
        ("OPENCV", [*K, -0.2, 0.05, 1e-3, 0], "RADIAL", "one focal length"),
        ("OPENCV", [500, 500, 330, 235, -0.2, 0.05, 1e-3, 0], "RADIAL", "no place for p1 = 0.001"),
        ("FULL_OPENCV", [*K, -0.2, 0, 0, 0, 0, 0, 0.1, 0], "OPENCV", "no place for k5 = 0.1"),
        ("OPENCV_FISHEYE", [*K, 0, 0, 0, 0], "PINHOLE", "different formulas"),
        ("EUCM", [*K, 0.6, 1.1], "DOUBLE_SPHERE", "different formulas"),
        ("EQUIRECTANGULAR", [640, 480], "OPENCV_FISHEYE", "different formulas"),
    ],
)
def test_what_has_no_place_is_named(model, params, target, told):
    refused = converted(camera_of(model, params), target)
    assert isinstance(refused, Rejected)
    assert told in refused.detail


@pytest.mark.parametrize(
    ("model", "params", "target", "px"),
    [
        ("FULL_OPENCV", [*K, -0.2, 0.05, 1e-3, -1e-3, 0.01, 0.02, 0, 0], "OPENCV", 0.5),
        ("DOUBLE_SPHERE", [300, 303, 330, 235, -0.2, 0.58], "OPENCV_FISHEYE", 0.01),
        ("OPENCV_FISHEYE", [300, 303, 330, 235, 0.02, -0.004, 0.001, 0], "EUCM", 2.0),
        ("OPENCV_FISHEYE", [300, 303, 330, 235, 0.02, -0.004, 0.001, 0], "DOUBLE_SPHERE", 2.0),
        ("EUCM", [300, 303, 330, 235, 0.4, 1.05], "FULL_OPENCV", 0.2),
    ],
)
def test_a_fit_is_near_and_says_how_near(model, params, target, px):
    camera = camera_of(model, params)
    near = fitted(camera, target)
    assert isinstance(near, Camera)
    apart = difference(camera, near)
    assert apart.rms_px <= apart.largest_px < px
    assert apart.uncovered == 0


def test_a_fit_cannot_be_bettered_by_a_small_change():
    camera = camera_of("DOUBLE_SPHERE", [300, 303, 330, 235, -0.2, 0.58])
    near = fitted(camera, "RADIAL_FISHEYE")
    assert isinstance(near, Camera)
    best = difference(camera, near).rms_px
    for k in range(5):
        for sign in (-1, 1):
            moved = near.with_params(near.params + sign * 0.05 * np.abs(near.params) * (np.arange(5) == k))
            assert difference(camera, moved).rms_px > best


def test_a_perspective_fit_of_a_view_around_tells_what_it_does_not_see():
    camera = camera_of("OPENCV_FISHEYE", [140, 140, 330, 235, 0.0, 0.0, 0.0, 0.0])
    near = fitted(camera, "FULL_OPENCV")
    assert isinstance(near, Camera)
    assert 0.3 < difference(camera, near).uncovered < 0.8


def test_a_model_without_focal_length_is_not_fitted():
    with pytest.raises(ValueError, match="nothing to fit"):
        fitted(camera_of("PINHOLE", K), "EQUIRECTANGULAR")
