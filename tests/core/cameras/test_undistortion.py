from __future__ import annotations

import math

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.cameras.undistortion import undistorted_camera, undistortion_grid

BARREL = Camera("OPENCV", 160, 120, np.array([130.0, 131, 82, 59, -0.25, 0.05, 1e-3, -1e-3]), True)
PINCUSHION = Camera("RADIAL", 160, 120, np.array([130.0, 80, 60, 0.15, 0.02]))
FISHEYE = Camera("OPENCV_FISHEYE", 160, 120, np.array([50.0, 50, 80, 60, 0.01, 0, 0, 0]))


def share_seen(source: Camera, target: Camera) -> float:
    """Share of the target's pixels that have one inside the source."""
    x, y = undistortion_grid(source, target)
    return float(((x >= 0) & (x <= source.width) & (y >= 0) & (y <= source.height)).mean())


def share_kept(source: Camera, target: Camera) -> float:
    """Share of the source's pixels that have one inside the target."""
    return share_seen(target, source)


def test_a_camera_without_distortion_is_left_as_it_is():
    camera = Camera("PINHOLE", 160, 120, np.array([130.0, 131, 82, 59]))
    for blank in (None, 0.0, 0.5, 1.0):
        target = undistorted_camera(camera, blank_pixels=blank)
        np.testing.assert_allclose(target.params, camera.params, rtol=1e-12)
    x, y = undistortion_grid(camera, camera)
    np.testing.assert_allclose(x, np.broadcast_to(np.arange(160) + 0.5, (120, 160)), atol=1e-4)
    np.testing.assert_allclose(y, np.broadcast_to(np.arange(120)[:, None] + 0.5, (120, 160)), atol=1e-4)


@pytest.mark.parametrize("camera", [BARREL, PINCUSHION])
def test_by_default_the_centre_keeps_its_scale(camera):
    target = undistorted_camera(camera)
    assert target.focal_lengths == camera.focal_lengths
    assert target.principal_point == camera.principal_point
    assert (target.model, target.width, target.height) == ("PINHOLE", 160, 120)
    assert target.has_prior_focal_length == camera.has_prior_focal_length


@pytest.mark.parametrize("camera", [BARREL, PINCUSHION, FISHEYE])
def test_blank_pixels_go_from_none_to_all_that_keep_the_source(camera):
    wide = math.radians(175)
    filled, half, kept = (undistorted_camera(camera, blank_pixels=b, max_field_of_view=wide) for b in (0.0, 0.5, 1.0))
    assert share_seen(camera, filled) == 1
    assert share_kept(camera, kept) > (0.999 if camera is not FISHEYE else 0.85)
    assert filled.focal_lengths[0] >= half.focal_lengths[0] >= kept.focal_lengths[0]
    tighter = filled.with_params(filled.params * [0.97, 0.97, 1, 1])
    assert share_seen(camera, tighter) < 1


def test_a_fisheye_is_limited_to_the_field_of_view():
    for blank in (None, 0.0, 1.0):
        target = undistorted_camera(FISHEYE, blank_pixels=blank, max_field_of_view=math.radians(100))
        assert 2 * math.atan(80 / target.focal_lengths[0]) <= math.radians(100) + 1e-12
    assert 2 * math.atan(80 / undistorted_camera(FISHEYE).focal_lengths[0]) == pytest.approx(math.radians(110))


def test_a_panorama_can_be_looked_at_through_a_pinhole():
    panorama = Camera("EQUIRECTANGULAR", 400, 200, np.array([400.0, 200.0]))
    target = undistorted_camera(panorama, blank_pixels=1.0)
    assert share_seen(panorama, target) == 1


def test_the_grid_is_projection_row_by_row(rng):
    target = undistorted_camera(BARREL)
    x, y = undistortion_grid(BARREL, target)
    assert x.shape == y.shape == (120, 160)
    assert x.dtype == y.dtype == np.float32
    for row, column in rng.integers(0, [120, 160], (20, 2)):
        ray, _ = target.unproject(np.array([[column + 0.5, row + 0.5]]))
        np.testing.assert_allclose([x[row, column], y[row, column]], BARREL.project(ray)[0][0], atol=1e-4)


def test_rays_that_the_source_cannot_see_are_nan():
    wide = Camera("PINHOLE", 160, 120, np.array([20.0, 20, 80, 60]))
    source = Camera("SIMPLE_RADIAL", 160, 120, np.array([130.0, 80, 60, -0.25]))
    x, y = undistortion_grid(source, wide)
    angle = np.hypot(np.arange(160) + 0.5 - 80, 0.5) / 20
    np.testing.assert_array_equal(np.isnan(x[60]), angle >= source.max_radius)
    np.testing.assert_array_equal(np.isnan(x), np.isnan(y))


@pytest.mark.parametrize("arguments", [{"blank_pixels": 1.5}, {"blank_pixels": -0.1}, {"max_field_of_view": math.pi}])
def test_impossible_wishes_are_refused(arguments):
    with pytest.raises(ValueError, match="expected"):
        undistorted_camera(BARREL, **arguments)
