"""Chessboards that a finder has read one line off."""

from __future__ import annotations

import numpy as np
import pytest

from calib import detect
from calib.boards import chessboard
from calib.detect import Detection, detect_board
from datasets.synthetic import boards as views

BOARD = chessboard(8, 5, 0.03)


@pytest.mark.parametrize("step", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_board_that_was_read_one_line_off_is_put_right(monkeypatch, step):
    """The finder's line beyond the board runs along the edges of the outer squares."""
    cam_from_board = views.pose(BOARD, 0.45, 25.0, 40.0)
    photo, truth = views.render(BOARD, views.DISTORTED, cam_from_board)
    places = BOARD.points3D - np.array([*step, 0]) * BOARD.pitch_m
    sought, _ = views.DISTORTED.project(cam_from_board @ places)
    seen = detected(monkeypatch, photo, sought)
    assert isinstance(seen, Detection)
    assert len(seen.corner_ids) >= 38
    assert np.linalg.norm(seen.points2D - truth[seen.corner_ids], axis=1).max() < 0.2


def test_a_line_that_is_covered_does_not_move_the_board(monkeypatch):
    cam_from_board = views.pose(BOARD, 0.45, 10.0)
    photo, truth = views.render(BOARD, views.PINHOLE, cam_from_board)
    photo = photo.copy()
    left = truth[BOARD.points3D[:, 0] == BOARD.points3D[:, 0].min()]
    for x, y in left[1:]:
        photo[int(y) - 9 : int(y) + 9, int(x) - 9 : int(x) + 9] = 110
    covered = detected(monkeypatch, photo, truth)
    assert isinstance(covered, Detection)
    assert len(covered.corner_ids) == 36
    assert np.linalg.norm(covered.points2D - truth[covered.corner_ids], axis=1).max() < 0.2


def detected(monkeypatch, photo, sought):
    """By one finder, which says so."""
    monkeypatch.setattr(detect, "candidates", lambda grey, board: iter([("made up", np.arange(len(sought)), sought)]))
    return detect_board(photo, BOARD)
