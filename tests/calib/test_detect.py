from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.boards import aprilgrid, asymmetric_circle_grid, charuco, chessboard, circle_grid
from calib.detect import Detection, detect_board
from calib.detect_gates import DetectConfig
from calib.detect_neighbours import local_affines, predicted
from calib.detect_overlay import overlay
from datasets.synthetic import boards as views
from sfm.core.errors import Rejected

CHESSBOARD = chessboard(9, 6, 0.025)
CHARUCO = charuco(8, 6, 0.03, 0.022)
APRILGRID = aprilgrid(5, 4, 0.03, 0.009)
CIRCLES = circle_grid(8, 7, 0.025, 0.014)
SHIFTED = asymmetric_circle_grid(4, 9, 0.02, 0.014)


def errors(seen: Detection, truth: np.ndarray) -> np.ndarray:
    return seen.points2D - truth[seen.corner_ids]


def distances(seen: Detection, truth: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances of the corners from the truth by the stated covariances."""
    off = errors(seen, truth)
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv(seen.covariances), off)


@pytest.mark.parametrize(
    ("board", "camera", "distance", "blur", "noise", "worst_rms"),
    [
        (CHESSBOARD, views.PINHOLE, 0.30, 0.7, 0.02, 0.015),
        (CHESSBOARD, views.DISTORTED, 0.34, 1.5, 0.01, 0.015),
        (CHESSBOARD, views.FISHEYE, 0.15, 0.5, 0.01, 0.015),
        (CHARUCO, views.DISTORTED, 0.30, 0.7, 0.01, 0.02),
        (APRILGRID, views.FISHEYE, 0.14, 0.6, 0.01, 0.03),
        (CIRCLES, views.PINHOLE, 0.32, 0.7, 0.02, 0.03),
        (SHIFTED, views.DISTORTED, 0.30, 0.7, 0.02, 0.05),
    ],
    ids=lambda value: getattr(value, "kind", getattr(value, "model", value)),
)
def test_corners_are_unbiased_and_as_uncertain_as_they_say(board, camera, distance, blur, noise, worst_rms):
    off, squared = [], []
    for k, (tilt, axis, roll) in enumerate([(10, 0, 5), (35, 90, -20)]):
        where = views.pose(board, distance, tilt, axis, roll)
        photo, truth = views.render(board, camera, where, blur_px=blur, noise=noise, seed=k)
        seen = detect_board(photo, board)
        assert isinstance(seen, Detection)
        assert len(seen.points2D) >= 0.97 * np.isfinite(truth[:, 0]).sum()
        off.append(errors(seen, truth))
        squared.append(distances(seen, truth))
    off, squared = np.concatenate(off), np.concatenate(squared)
    rms = np.sqrt(np.mean(off**2))
    assert rms < worst_rms
    assert np.abs(off.mean(axis=0)).max() < 5 * rms / np.sqrt(len(off)) + 0.003
    assert np.abs(off).max() < 10 * rms  # an edge along a row of pixels is rendered 0.07 px off
    assert 0.5 < squared.mean() / 2 < 2


def test_a_larger_noise_is_told_by_larger_covariances():
    where = views.pose(CHESSBOARD, 0.3, 20)
    sigmas = []
    for noise in (0.01, 0.03):
        seen = detect_board(views.render(CHESSBOARD, views.PINHOLE, where, noise=noise)[0], CHESSBOARD)
        assert isinstance(seen, Detection)
        sigmas.append(np.median(np.sqrt(seen.covariances[:, 0, 0])))
    assert sigmas[1] / sigmas[0] == pytest.approx(3, rel=0.15)


@pytest.fixture(scope="module")
def upright():
    """A chessboard as it hangs on a wall, and its corners."""
    return views.render(CHESSBOARD, views.DISTORTED, views.pose(CHESSBOARD, 0.33, 15, 30))


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_photo_has_the_same_corners_by_their_ids(upright, turns):
    photo, truth = upright
    seen = detect_board(np.ascontiguousarray(np.rot90(photo, turns)), CHESSBOARD)
    assert isinstance(seen, Detection)
    for _ in range(turns):  # x, y → y, width − x
        truth = np.column_stack([truth[:, 1], (360 if _ % 2 else 480) - truth[:, 0]])
    assert np.abs(errors(seen, truth)).max() < 0.1


def test_detection_is_the_same_every_time_and_does_not_touch_the_photo(upright):
    photo, _ = upright
    before = photo.copy()
    first, second = detect_board(photo, CHESSBOARD), detect_board(photo, CHESSBOARD)
    assert isinstance(first, Detection)
    assert isinstance(second, Detection)
    np.testing.assert_array_equal(photo, before)
    np.testing.assert_array_equal(first.points2D, second.points2D)
    np.testing.assert_array_equal(first.covariances, second.covariances)


def test_a_corner_that_is_covered_is_rejected_with_a_reason_and_the_others_stay(upright):
    photo, truth = upright
    spoilt = photo.copy()
    x, y = np.rint(truth[22]).astype(int)
    spoilt[y - 3 : y + 4, x - 3 : x + 4] = 150  # a sticker
    seen = detect_board(spoilt, CHESSBOARD, DetectConfig(max_misfit=0.2))
    assert isinstance(seen, Detection)
    assert list(seen.rejected) == [22]
    assert np.linalg.norm(seen.rejected2D[0] - truth[22]) < 4
    assert np.abs(errors(seen, truth)).max() < 0.1


def test_noise_of_a_third_of_the_contrast_is_no_reason_to_doubt_a_corner(upright, rng):
    photo, truth = upright
    faint = 110 + photo * (20 / 255)
    noisy = np.clip(np.rint(faint + rng.normal(0, 2.7, photo.shape)), 0, 255).astype(np.uint8)
    seen = detect_board(noisy, CHESSBOARD)
    assert isinstance(seen, Detection)
    assert len(seen.corner_ids) == 54
    assert np.abs(errors(seen, truth)).max() < 0.6


def test_a_photo_that_is_refused_says_what_is_wrong_with_its_corners(upright):
    photo, _ = upright
    seen = detect_board(photo, CHESSBOARD, DetectConfig(max_misfit=0.001))
    assert isinstance(seen, Rejected)
    assert "unlike a crossing" in seen.detail


@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=lambda board: board.kind)
def test_a_board_with_markers_is_known_by_a_part_of_it(board):
    where = views.pose(board, 0.22, 15, 20, 10, shift=(0.07, 0.05))
    photo, truth = views.render(board, views.PINHOLE, where)
    in_view = ((truth > 12) & (truth < [468, 348])).all(axis=1)
    seen = detect_board(photo, board)
    assert isinstance(seen, Detection)
    assert 8 < in_view.sum() < len(truth)
    assert np.isin(np.flatnonzero(in_view), seen.corner_ids).mean() > 0.9
    assert np.abs(errors(seen, truth)).max() < 0.3


def test_the_older_layout_of_charuco_is_tried_as_well():
    layout = cv2.aruco.CharucoBoard((8, 6), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000))
    layout.setLegacyPattern(True)
    photo = cv2.GaussianBlur(layout.generateImage((800, 640), marginSize=40), (0, 0), 1)
    seen = detect_board(photo, CHARUCO)
    assert isinstance(seen, Detection)
    assert seen.finder == "markers, older layout"
    assert len(seen.points2D) == 35


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO, APRILGRID, CIRCLES, SHIFTED], ids=lambda board: board.kind)
def test_a_photo_without_a_board_is_rejected_by_name(board, rng):
    photo = cv2.GaussianBlur(rng.integers(0, 255, (240, 320), np.uint8), (0, 0), 2)
    seen = detect_board(photo, board)
    assert isinstance(seen, Rejected)
    assert seen.reason in ("no_board", "too_few_corners")


def test_neighbours_predict_a_quadratic_map_and_its_slope():
    x, y = CHESSBOARD.points3D[:, :2].T
    known = CHESSBOARD.points3D[:, :2]
    image = np.column_stack([100 + 900 * x + 50 * y + 300 * x * y, 80 - 40 * x + 800 * y + 500 * x * x])
    wanted, gain = predicted(known, known, image)
    np.testing.assert_allclose(wanted, image, atol=1e-8)
    assert gain.argmax() in (0, 8, 45, 53)
    inner = 2 * 9 + 4
    slope = [[900 + 300 * y[inner], 50 + 300 * x[inner]], [-40 + 1000 * x[inner], 800]]
    np.testing.assert_allclose(local_affines(known, image)[inner], slope, atol=1e-8)


def test_an_overlay_marks_found_and_rejected_corners(upright):
    photo, _ = upright
    seen = detect_board(photo, CHESSBOARD)
    drawn = overlay(photo, CHESSBOARD, seen)
    plain = overlay(photo, CHESSBOARD, Rejected("no_board", "nothing"))
    assert drawn.shape == plain.shape == (720, 960, 3) or drawn.shape[0] % photo.shape[0] == 0
    assert (drawn != plain).any(axis=2).sum() > 54 * 4
