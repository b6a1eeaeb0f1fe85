"""Boards with markers where few of these can be read."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards import aprilgrid, charuco
from calib.detect import Detection, detect_board
from calib.detect_gates import DetectConfig, fitted_crossings
from calib.detect_neighbours import local_affines
from calib.detect_print import resemblances
from datasets.synthetic import boards as views
from sfm.core.cameras import Camera

NEAR = aprilgrid(4, 4, 0.088, 0.0264)
WIDE = Camera("OPENCV_FISHEYE", 400, 400, np.array([125.0, 125, 200, 200, 0.003, 0.001, -0.002, 0.0]))
CHARUCO = charuco(6, 5, 0.03, 0.022)


@pytest.fixture(scope="module")
def bent():
    """A large AprilGrid close to a fisheye, which bends the sides of its tags; and its corners."""
    return views.render(NEAR, WIDE, views.pose(NEAR, 0.11, 15, 30, 20), texels_per_m=1500)


@pytest.fixture(scope="module")
def plain():
    return views.render(CHARUCO, views.PINHOLE, views.pose(CHARUCO, 0.2, 20, 40))


def test_corners_of_tags_whose_sides_bend_are_found(bent):
    photo, truth = bent
    inside = ((truth > 6) & (truth < 394)).all(axis=1)
    seen = detect_board(photo, NEAR)
    assert isinstance(seen, Detection)
    assert np.isin(np.flatnonzero(inside), seen.corner_ids).mean() > 0.9
    assert np.abs(seen.points2D - truth[seen.corner_ids]).max() < 1


def test_what_is_printed_around_a_corner_is_told_from_what_is_not(plain):
    photo, truth = plain
    inside = np.flatnonzero(((truth > 0) & (truth < [480, 360])).all(axis=1))
    places = truth[inside].copy()
    assert resemblances(photo, CHARUCO, inside, places).min() > 0.7
    assert resemblances(255 - photo, CHARUCO, inside, places).min() > 0.7
    off = len(inside) // 2
    places[off] += [25, 9]
    found = resemblances(photo, CHARUCO, inside, places)
    assert found[off] < 0.35
    assert np.delete(found, off).min() > 0.6


@pytest.mark.parametrize("moved_px", [(12, 7), (-10, 14)])
def test_a_crossing_beside_its_place_is_no_corner_where_few_others_are_seen(moved_px):
    board = charuco(5, 7, 0.03, 0.02, "DICT_4X4_50")
    photo, truth = views.render(board, views.DISTORTED, views.pose(board, 0.14, 30, 60, 20, shift=(0, -0.02)))
    ids = np.array([10, 12, 13, 14, 16, 17, 20, 21])
    sought, spoilt = truth[ids], photo.copy()
    sought[-1] += moved_px
    x, y = np.rint(truth[21]).astype(int)
    (u, v), patch = (x + moved_px[0], y + moved_px[1]), photo[y - 20 : y + 20, x - 20 : x + 20]
    spoilt[v - 20 : v + 20, u - 20 : u + 20] = patch
    affines = local_affines(board.points3D[ids, :2], sought)
    assert list(fitted_crossings(spoilt, board, ids, sought, affines, DetectConfig()).reasons) == [21]
    affines = local_affines(board.points3D[ids, :2], truth[ids])
    assert not fitted_crossings(photo, board, ids, truth[ids], affines, DetectConfig()).reasons


def test_markers_that_are_white_on_black_are_read(plain):
    photo, truth = plain
    seen = detect_board(255 - photo, CHARUCO)
    usual = detect_board(photo, CHARUCO)
    assert isinstance(seen, Detection)
    assert isinstance(usual, Detection)
    assert "white on black" in seen.finder
    np.testing.assert_array_equal(seen.corner_ids, usual.corner_ids)
    assert np.abs(seen.points2D - truth[seen.corner_ids]).max() < 0.1


def test_a_small_board_before_a_fisheye_is_read_from_few_of_its_markers():
    board = charuco(8, 6, 0.03, 0.022)
    photo, truth = views.render(board, WIDE, views.pose(board, 0.21, 40, 60, 15, shift=(0.17, 0.05)))
    seen = detect_board(photo, board)
    assert isinstance(seen, Detection)
    assert len(seen.corner_ids) >= 28
    assert np.abs(seen.points2D - truth[seen.corner_ids]).max() < 0.5
