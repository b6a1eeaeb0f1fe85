from __future__ import annotations

import numpy as np
import pytest

from calib.boards import Board, asymmetric_circle_grid, circle_grid
from calib.detect import Detection, detect_board
from calib.detect_lattice import circles_among
from datasets.synthetic import boards as views
from sfm.core.errors import Rejected

SQUARE = circle_grid(7, 5, 0.03, 0.018)
SHIFTED = asymmetric_circle_grid(4, 11, 0.02, 0.014)
SIZE = (480, 360)


def seen(board: Board, camera, tilt: float, axis: float, roll: float, distance: float = 0.33) -> np.ndarray:
    return camera.project(views.pose(board, distance, tilt, axis, roll) @ board.points3D)[0]


@pytest.mark.parametrize("board", [SQUARE, SHIFTED], ids=lambda board: board.kind)
@pytest.mark.parametrize("camera", [views.DISTORTED, views.FISHEYE], ids=lambda camera: camera.model)
@pytest.mark.parametrize(("tilt", "axis", "roll"), [(5, 0, 0), (45, 90, 30), (50, 10, -40), (40, 200, 80)])
def test_a_board_is_found_among_other_blobs_with_some_of_its_own_missing(board, camera, tilt, axis, roll):
    rng = np.random.default_rng(5)
    truth = seen(board, camera, tilt, axis, roll)
    there = np.ones(len(truth), bool)
    there[[0, len(truth) // 2]] = False
    others = rng.uniform(0, SIZE, (60, 2))
    apart = np.linalg.norm(others[:, None] - truth, axis=2).min(axis=1) > 6
    blobs = np.concatenate([truth[there] + rng.normal(0, 0.2, (there.sum(), 2)), others[apart]])
    found = circles_among(rng.permutation(blobs), board, SIZE)
    assert found is not None
    assert np.linalg.norm(found - truth, axis=1).max() < 3


def test_a_board_without_an_outer_line_is_not_placed():
    """It may as well be the other one that is missing."""
    truth = seen(SQUARE, views.PINHOLE, 20, 0, 10)
    inner = SQUARE.points3D[:, 0] > 0
    assert circles_among(truth, SQUARE, SIZE) is not None
    assert circles_among(truth[inner], SQUARE, SIZE) is None


@pytest.mark.parametrize("board", [SQUARE, SHIFTED], ids=lambda board: board.kind)
def test_neither_walls_nor_pebbles_are_a_board(board):
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:30, :40].reshape(2, -1)
    wall = np.column_stack([12.0 * x + 5, 12.0 * y + 5])
    assert circles_among(wall, board, SIZE) is None
    assert circles_among(wall[(x < 9) & (y < 7)], board, SIZE) is None
    pebbles = wall + rng.normal(0, 2.0, wall.shape)
    assert circles_among(pebbles, board, SIZE) is None


@pytest.mark.parametrize(("board", "noise"), [(SQUARE, 0.01), (SHIFTED, 0.01)], ids=lambda v: getattr(v, "kind", v))
def test_a_circle_that_the_border_cuts_does_not_cost_the_photo(board, noise):
    where = views.pose(board, 0.30, 20, 0, 20)
    first = views.PINHOLE.project(where @ board.points3D)[0].min(axis=0)
    cut = np.floor(first).astype(int) + [0, -40]
    photo, truth = views.render(board, views.PINHOLE, where, noise=noise)
    photo, truth = np.ascontiguousarray(photo[max(cut[1], 0) :, cut[0] :]), truth - [cut[0], max(cut[1], 0)]
    found = detect_board(photo, board)
    assert isinstance(found, Detection)
    assert 0.85 * len(truth) <= len(found.corner_ids) < len(truth)
    off = np.linalg.norm(found.points2D - truth[found.corner_ids], axis=1)
    turned = np.linalg.norm(found.points2D - truth[::-1][found.corner_ids], axis=1)
    assert min(off.max(), turned.max()) < 0.2


@pytest.mark.parametrize("board", [SQUARE, SHIFTED], ids=lambda board: board.kind)
def test_light_circles_on_black_are_found_as_dark_ones_are(board):
    photo, truth = views.render(board, views.DISTORTED, views.pose(board, 0.33, 25, 30, 10))
    dark, light = detect_board(photo, board), detect_board(255 - photo, board)
    assert isinstance(dark, Detection)
    assert isinstance(light, Detection)
    np.testing.assert_array_equal(light.corner_ids, dark.corner_ids)
    np.testing.assert_allclose(light.points2D, dark.points2D, atol=0.01)
    assert np.linalg.norm(light.points2D - truth[light.corner_ids], axis=1).max() < 0.2


def test_photos_of_a_perforated_wall_are_refused():
    photo = np.full((480, 640), 200, np.uint8)
    y, x = np.mgrid[:480, :640] % 16 - 8
    photo[y * y + x * x < 20] = 40
    assert isinstance(detect_board(photo, SHIFTED), Rejected)


@pytest.mark.parametrize("board", [SQUARE, SHIFTED], ids=lambda board: board.kind)
def test_a_circle_that_is_partly_covered_is_left_out_and_no_other(board):
    photo, truth = views.render(board, views.PINHOLE, views.pose(board, 0.30, 25, 30, 10))
    x, y = np.rint(truth[17]).astype(int)
    photo[y + 4 : y + 14, x - 12 : x + 13] = 190  # a finger on its lower third
    found = detect_board(photo, board)
    assert isinstance(found, Detection)
    assert list(found.rejected) == [17]
    assert np.linalg.norm(found.points2D - truth[found.corner_ids], axis=1).max() < 0.2
