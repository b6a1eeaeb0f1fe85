from __future__ import annotations

import numpy as np
import pytest

from calib.boards import Board, asymmetric_circle_grid, chessboard, circle_grid
from calib.circle_shifts import exact_centres, with_exact_centres
from calib.detect import Detection, detect_board
from calib.detect_circles import centroid_shifts, without_shifts
from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_views import BoardView
from datasets.synthetic import boards as views
from sfm.core.cameras import Camera

LARGE = circle_grid(7, 5, 0.03, 0.018)
SHIFTED = asymmetric_circle_grid(4, 11, 0.02, 0.014)
WIDE = Camera("OPENCV", 1024, 768, np.array([650.0, 648, 520.3, 378.8, -0.1, 0.02, 3e-4, -3e-4]))
FISHEYE = Camera("OPENCV_FISHEYE", 800, 800, np.array([260.0, 260, 405, 396, 0.02, -0.01, 0.002, 0.0]))
TILTS = [(30, 0, 5), (40, 90, -20), (45, 200, 10), (28, 310, 30), (38, 45, -8), (46, 135, 60), (25, 260, 95)]


def disc(image, center, radius: float) -> np.ndarray:
    """Centroid of the image of one disc: the mean of its points, each with the area of its surroundings' image."""
    r, around = np.meshgrid((np.arange(60) + 0.5) / 60 * radius, np.arange(48) * 2 * np.pi / 48)
    points = center + np.column_stack([(r * np.cos(around)).ravel(), (r * np.sin(around)).ravel()])
    step = 1e-3 * radius * np.eye(2)
    fx, fy = (image(points + e) - image(points - e) for e in step)
    areas = r.ravel() * (fx[:, 0] * fy[:, 1] - fx[:, 1] * fy[:, 0])
    return areas @ image(points) / areas.sum()


def seen_by(board: Board, camera: Camera, distance_m: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centroids of all discs and the images of their centres, of a few poses toward the corners of the image."""
    out = []
    for k, (tilt, axis, roll) in enumerate(TILTS):
        shift = 0.1 * distance_m * np.array([(-1) ** k, (-1) ** (k // 2)])
        where = views.pose(board, distance_m, tilt, axis, roll, tuple(shift))

        def image(points, where=where):
            return camera.project(where @ np.column_stack([points, np.zeros(len(points))]))[0]

        flat = board.points3D[:, :2]
        out.append((np.array([disc(image, center, board.detail_m / 2) for center in flat]), image(flat)))
    return out


def view(name: str, camera: Camera, points2D: np.ndarray) -> BoardView:
    return BoardView(name, camera.width, camera.height, np.arange(len(points2D)), points2D)


def rms(off: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def test_the_centroid_of_a_disc_in_perspective_is_the_centre_of_an_ellipse(rng):
    """With C the circle as a dual conic and H the homography, the last column of H C Hᵀ is that centre."""
    H = np.array([[900.0, 80, 200], [-60, 850, 150], [0.8, 1.2, 1]])
    radius, centers = 0.01, rng.uniform(0, 0.2, (6, 2))

    def image(points):
        lifted = np.column_stack([points, np.ones(len(points))]) @ H.T
        return lifted[:, :2] / lifted[:, 2:]

    for (x, y), shift in zip(centers, centroid_shifts(image, centers, radius), strict=True):
        column = H @ np.array([[x * x - radius**2, x * y, x], [x * y, y * y - radius**2, y], [x, y, 1]]) @ H[2]
        expected = column[:2] / column[2] - image(np.array([[x, y]]))[0]
        assert np.linalg.norm(expected) > 0.01
        np.testing.assert_allclose(shift, expected, atol=1e-5)


def test_the_centroid_of_a_disc_under_a_curved_map_is_that_of_its_outline():
    def image(p):
        x, y = p.T
        u = 900 * x + 60 * y + 2500 * x * x + 700 * x * y - 900 * y * y
        return np.column_stack([u, -50 * x + 850 * y + 500 * x * x - 1500 * x * y + 1800 * y * y])

    centers = SHIFTED.points3D[:6, :2]
    for center, shift in zip(centers, centroid_shifts(image, centers, 0.007), strict=True):
        expected = disc(image, center, 0.007) - image(center[None])[0]
        assert np.linalg.norm(expected) > 0.05
        np.testing.assert_allclose(shift, expected, atol=1e-4)


@pytest.mark.parametrize(
    ("board", "camera", "distance", "raw", "left"),
    [(LARGE, WIDE, 0.22, 0.3, 0.01), (SHIFTED, WIDE, 0.2, 0.3, 0.02), (LARGE, FISHEYE, 0.14, 0.3, 0.04)],
)
def test_one_lens_takes_nearly_all_off_centroids(board, camera, distance, raw, left):
    pairs = seen_by(board, camera, distance)
    size, flat = (camera.width, camera.height), board.points3D[:, :2]
    assert rms(np.concatenate([centroids - centres for centroids, centres in pairs])) > raw
    off = [without_shifts(centroids, flat, board.detail_m / 2, size) - centres for centroids, centres in pairs]
    assert rms(np.concatenate(off)) < left


@pytest.mark.parametrize(("camera", "lens", "distance"), [(WIDE, "opencv4", 0.22), (FISHEYE, "fisheye", 0.14)])
def test_the_camera_that_circles_give_takes_off_the_rest(camera, lens, distance):
    """From exact centroids comes the exact camera; with what detection takes off alone it is far from it."""
    size, flat = (camera.width, camera.height), LARGE.points3D[:, :2]
    pairs = seen_by(LARGE, camera, distance)
    detected = [without_shifts(centroids, flat, LARGE.detail_m / 2, size) for centroids, _ in pairs]
    given = [view(f"{k}.png", camera, points) for k, points in enumerate(detected)]
    config = CalibrationConfig(lens=lens, reject=False)
    off, found = [], []
    for some in (given, with_exact_centres(LARGE, given, config)):
        off.append(rms(np.concatenate([one.points2D - pair[1] for one, pair in zip(some, pairs, strict=True)])))
        made = calibrate(LARGE.points3D, some, config)
        assert isinstance(made, Calibration)
        found.append(abs(made.camera.params[0] - camera.params[0]))
    assert off[1] < 0.2 * off[0]
    assert off[1] < 2e-3
    assert found[1] < 0.3 * found[0]
    assert found[1] < 0.03


def test_a_known_camera_gives_exact_centres_and_leaves_other_views_as_they_are():
    centroids, centres = seen_by(LARGE, WIDE, 0.22)[1]
    size, flat = (WIDE.width, WIDE.height), LARGE.points3D[:, :2]
    one = view("a.png", WIDE, without_shifts(centroids, flat, LARGE.detail_m / 2, size))
    small = BoardView("b.png", 640, 480, np.arange(35), one.points2D / 2)
    better, same = exact_centres(LARGE, [one, small], WIDE)
    np.testing.assert_allclose(better.points2D, centres, atol=1e-3)
    assert np.abs(one.points2D - centres).max() > 5e-3
    assert same is small


def test_corners_of_chessboards_stay_as_they_are():
    board = chessboard(9, 6, 0.025)
    given = tuple(view("a.png", WIDE, np.random.default_rng(k).uniform(0, 700, (54, 2))) for k in range(3))
    assert with_exact_centres(board, given, CalibrationConfig()) == given
    assert exact_centres(None, given, WIDE) == given


def test_large_circles_in_photos_are_found_where_their_centres_are():
    where = views.pose(LARGE, 0.2, 42, 20, 10, (0.01, 0.0))
    camera = Camera("OPENCV", 512, 384, np.array([325.0, 324, 260.1, 189.4, -0.1, 0.02, 3e-4, -3e-4]))
    photo, truth = views.render(LARGE, camera, where, noise=0.003)
    seen = detect_board(photo, LARGE)
    assert isinstance(seen, Detection)
    assert rms(seen.points2D - truth[seen.corner_ids]) < 0.03
