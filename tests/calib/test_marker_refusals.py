"""What markers say of the board, where its corners are missing or too few."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.boards import Board, aprilgrid, charuco, chessboard
from calib.cli.marker_refusals import marker_words
from calib.cli.refusals import no_board, shown_size
from calib.cli.sightings import Sightings
from calib.refine_views import BoardView
from datasets.synthetic.boards import PINHOLE, pose, render

SHOWN = charuco(7, 5, 0.03, 0.022)


def photographed(folder: Path, shown: Board, count: int = 2, *, mirrored: bool = False) -> list[Path]:
    paths = []
    for k in range(count):
        photo, _ = render(shown, PINHOLE, pose(shown, 0.36, 15 + 10 * k, 60 * k), seed=k, texels_per_m=2000)
        paths.append(folder / f"{k}.png")
        cv2.imwrite(str(paths[-1]), photo[:, ::-1] if mirrored else photo)
    return paths


def none_found(board: Board) -> Sightings:
    return Sightings(board, board.points3D, (), (), "")


def test_markers_of_another_dictionary_are_named(tmp_path):
    shown = dataclasses.replace(SHOWN, dictionary="DICT_4X4_50")
    photographed(tmp_path, shown)
    told = no_board(none_found(dataclasses.replace(SHOWN, dictionary="DICT_6X6_250")), [tmp_path])
    assert "markers of DICT_4X4_50, you named DICT_6X6_250" in str(told)
    assert f"--board {shown.spec}" in str(told)


def test_the_default_dictionary_is_named_as_such(tmp_path):
    paths = photographed(tmp_path, SHOWN)
    told = marker_words(paths, dataclasses.replace(SHOWN, dictionary="DICT_7X7_50"))
    assert told.endswith(f"try --board {SHOWN.spec}")
    assert "DICT" not in SHOWN.spec


@pytest.mark.parametrize("board", [SHOWN, aprilgrid(5, 4, 0.03, 0.009)], ids=["charuco", "aprilgrid"])
def test_mirrored_photos_are_told(board, tmp_path):
    assert "the photos are mirrored" in marker_words(photographed(tmp_path, board, mirrored=True), board)


def test_of_the_board_s_own_markers_and_of_none_nothing_is_said(tmp_path):
    assert marker_words(photographed(tmp_path, SHOWN), SHOWN) == ""
    assert marker_words(photographed(tmp_path, chessboard(9, 6, 0.025)), SHOWN) == ""


def test_markers_of_another_size_are_told(tmp_path):
    photographed(tmp_path, SHOWN, 3)
    views = []
    for k in range(3):
        pixels, _ = PINHOLE.project(pose(SHOWN, 0.36, 15 + 10 * k, 60 * k) @ SHOWN.points3D)
        views.append(BoardView(f"{k}.png", PINHOLE.width, PINHOLE.height, np.arange(len(pixels)), pixels))
    named = charuco(7, 5, 0.03, 0.015)
    seen = Sightings(named, named.points3D, tuple(views), (), "")
    finding = shown_size(seen, [tmp_path])
    assert finding is not None
    assert finding.cause == "other_board"
    assert "3 photos show markers of 2" in finding.detail
    assert "you named 15 mm" in finding.detail
    assert shown_size(dataclasses.replace(seen, board=SHOWN), [tmp_path]) is None


@pytest.mark.parametrize(("columns", "rows", "line"), [(7, 6, "row"), (8, 5, "column")])
def test_a_line_that_no_photo_shows_is_told(columns, rows, line, tmp_path):
    named = charuco(columns, rows, 0.03, 0.022)
    across = columns - 1
    ids = np.array([r * across + c for r in range(4) for c in range(6)])
    pixels = np.stack([ids % across, ids // across], 1) * 40.0 + 100
    views = tuple(BoardView(f"{k}.png", 640, 480, ids, pixels) for k in range(9))
    finding = shown_size(Sightings(named, named.points3D, views, (), ""), [tmp_path])
    assert finding is not None
    assert f"the last {line} of squares" in finding.detail
    assert finding.remedy.endswith(f"--board {SHOWN.spec}")
    right = Sightings(
        SHOWN, SHOWN.points3D, tuple(dataclasses.replace(v, corner_ids=np.arange(24)) for v in views), (), ""
    )
    assert shown_size(right, [tmp_path]) is None
