from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.boards import Board, chessboard, circle_grid
from calib.cli.refusals import shown_size, shown_size_of_all
from calib.cli.sightings import Sightings
from calib.refine_views import BoardView
from datasets.synthetic.boards import PINHOLE, pose, render
from sfm.core.errors import InputError

SHOWN = chessboard(9, 6, 0.025)


def sightings(folder: Path, named: Board, count: int, shown: Board = SHOWN) -> Sightings:
    """Photos of a board of 9x6 in which another one was found, from the same first corner."""
    views = []
    folder.mkdir(exist_ok=True)
    for k, tilt in enumerate(range(10, 10 + 8 * count, 8)):
        where = pose(shown, 0.36, tilt, 50 * k)
        photo, _ = render(shown, PINHOLE, where, seed=k, texels_per_m=2000)
        cv2.imwrite(str(folder / f"{k}.png"), photo)
        pixels, _ = PINHOLE.project(where @ named.points3D)
        views.append(BoardView(f"{k}.png", PINHOLE.width, PINHOLE.height, np.arange(len(pixels)), pixels))
    return Sightings(named, named.points3D, tuple(views), (), "")


def test_a_part_of_the_board_that_is_shown_is_refused_by_name(tmp_path):
    seen = sightings(tmp_path, chessboard(8, 6, 0.025), 3)
    with pytest.raises(InputError, match="3 of 3 photos show a board of 9x6 inner corners, not 8x6") as told:
        shown_size(seen, [tmp_path])
    assert "--board chessboard:9x6:25mm" in str(told.value)


def test_what_two_photos_show_is_a_finding(tmp_path):
    finding = shown_size(sightings(tmp_path, chessboard(8, 6, 0.025), 2), [tmp_path])
    assert finding is not None
    assert finding.cause == "other_board"
    assert "--board chessboard:9x6:25mm" in finding.remedy


def test_the_board_that_is_shown_needs_no_word(tmp_path):
    seen = sightings(tmp_path, SHOWN, 3)
    assert shown_size(seen, [tmp_path]) is None
    assert shown_size(dataclasses.replace(seen, kind="corners"), [tmp_path]) is None


def test_circles_are_called_circles(tmp_path):
    seen = sightings(tmp_path, circle_grid(8, 6, 0.025), 3, circle_grid(9, 6, 0.025))
    with pytest.raises(InputError, match="3 of 3 photos show a board of 9x6 circles, not 8x6") as told:
        shown_size(seen, [tmp_path])
    assert "--board circles:9x6:25mm:12.5mm" in str(told.value)


def test_the_cameras_of_a_rig_are_asked_together(tmp_path):
    """Two photos of one camera would not be enough."""
    named = chessboard(9, 5, 0.025)
    seen = {side: sightings(tmp_path / side, named, 2) for side in ("left", "right")}
    with pytest.raises(InputError, match="4 of 4 photos show a board of 9x6 inner corners, not 9x5"):
        shown_size_of_all(seen, {side: [tmp_path / side] for side in seen})
    right = {side: sightings(tmp_path / side, SHOWN, 2) for side in seen}
    assert shown_size_of_all(right, {side: [tmp_path / side] for side in seen}) is None
