"""What neighbours say of a corner, against the camera that shows them."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards import chessboard
from calib.detect_neighbours import local_curvatures, local_slopes
from calib.detect_plane import fit_plane
from datasets.synthetic import boards as views

BOARD = chessboard(9, 6, 0.025)
PLACES = BOARD.points3D[:, :2]


def shown(camera, distance, tilt, axis, places=PLACES):
    """Pixels of places on the board."""
    points = np.column_stack([places, np.zeros(len(places))])
    pixels, valid = camera.project(views.pose(BOARD, distance, tilt, axis, 20) @ points)
    assert valid.all()
    return pixels


def curvatures_of(camera, distance, tilt, axis, step=1e-4):
    """Of the images of the lines along x and y, by differences."""
    found = []
    for along in np.eye(2):
        ahead, here, behind = (shown(camera, distance, tilt, axis, PLACES + k * step * along) for k in (1, 0, -1))
        a, b = (ahead - behind) / (2 * step), (ahead - 2 * here + behind) / step**2
        found.append((a[:, 1] * b[:, 0] - a[:, 0] * b[:, 1]) / np.linalg.norm(a, axis=1) ** 3)
    return np.stack(found, axis=1)


@pytest.mark.parametrize(
    ("camera", "distance"), [(views.PINHOLE, 0.3), (views.DISTORTED, 0.34), (views.FISHEYE, 0.12)],
    ids=lambda value: getattr(value, "model", value),
)  # fmt: skip
def test_curvatures_are_those_of_the_camera_and_as_uncertain_as_they_say(camera, distance, rng):
    for tilt, axis in ((15, 0), (40, 80)):
        true, pixels = curvatures_of(camera, distance, tilt, axis), shown(camera, distance, tilt, axis)
        pixels = pixels + rng.normal(0, 0.01, pixels.shape)
        plane = fit_plane(PLACES, pixels, (camera.width, camera.height))
        found, deviations = local_curvatures(PLACES, PLACES, pixels, plane, 0.01)
        rms = np.sqrt(np.mean((found - true) ** 2))
        assert rms < max(0.1 * np.sqrt(np.mean(true**2)), 1e-4)
        assert np.mean(np.abs(found - true) < 3 * deviations) > 0.8
        assert np.sqrt(np.mean(deviations**2)) < 5 * rms


def test_a_board_before_a_pinhole_is_its_homography():
    pixels = shown(views.PINHOLE, 0.3, 30, 50)
    plane = fit_plane(PLACES, pixels, (480, 360))
    assert plane.coefficient == 0.0
    assert np.abs(plane.image(PLACES) - pixels).max() < 1e-6


def test_a_board_before_a_fisheye_is_near_that_of_one_coefficient():
    pixels = shown(views.FISHEYE, 0.12, 30, 50)
    plane = fit_plane(PLACES, pixels, (480, 360))
    assert plane.coefficient < -0.3
    assert np.abs(plane.image(PLACES) - pixels).max() < 0.01 * np.ptp(pixels)


def test_few_or_collinear_neighbours_leave_curvatures_open(rng):
    pixels = shown(views.DISTORTED, 0.34, 15, 0)
    for some in (slice(0, 9), slice(3, 8)):
        plane = fit_plane(PLACES[some], pixels[some], (480, 360))
        assert np.isinf(local_curvatures(PLACES, PLACES[some], pixels[some], plane, 0.01)[1]).all()
    row = np.column_stack([np.linspace(0, 1, 20), np.zeros(20)])
    plane = fit_plane(row, 100 * row + 50, (480, 360))
    assert np.isinf(local_curvatures(PLACES, row, 100 * row + 50, plane, 0.01)[1]).all()


def test_slopes_of_a_plane_are_its_own_and_scatter_is_told(rng):
    pixels = shown(views.DISTORTED, 0.34, 15, 0)
    values = 100 + pixels @ [0.3, -0.2]
    slopes, scatter = local_slopes(PLACES, PLACES, pixels, values)
    np.testing.assert_allclose(slopes, np.broadcast_to([0.3, -0.2], slopes.shape), atol=1e-9)
    assert scatter.max() < 1e-9
    rough = local_slopes(PLACES, PLACES, pixels, values + rng.normal(0, 5, len(values)))
    assert np.sqrt(np.mean((rough[0] - [0.3, -0.2]) ** 2)) < np.median(rough[1])
    assert np.isinf(local_slopes(PLACES, PLACES[:5], pixels[:5], values[:5])[1]).all()
