"""What a check goes by: the shape of the board, also turned, and an error that says where it comes from."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from calib.boards import Board, chessboard
from calib.check import check_camera, known_shape
from calib.cli.check_limits import board_of_record, limit_of, shapes_to_try
from calib.cli.sightings import Sightings
from sfm.core.errors import FormatError, Rejected
from sfm.io.camera_records import BoardRecord, CameraRecord
from tests.calib.boards_in_space import LENS, poses_before, seen

BOARD, SWAPPED = chessboard(9, 6, 0.025), chessboard(6, 9, 0.025)


def sightings(board: Board, views=()) -> Sightings:
    return Sightings(board, board.points3D, tuple(views), (), "digest")


def record_with(displacements: np.ndarray, **facts: float) -> CameraRecord:
    return CameraRecord(facts, None, BoardRecord(BOARD.spec, "free", displacements))


def test_the_shape_of_a_board_is_kept_when_columns_and_rows_are_swapped(rng):
    """The same board and photos, corner for corner, with the corners numbered as a 6x9 board numbers them."""
    off = rng.normal(0, 5e-4, BOARD.points3D.shape)
    middle = BOARD.points3D.mean(axis=0)
    views = seen(LENS, BOARD.points3D - middle + off, poses_before(LENS, 8, rng), rng)
    # Corner (column, row) of 9x6 is (row, 8 - column) of 6x9.
    number = {9 * r + c: 6 * (8 - c) + r for r in range(6) for c in range(9)}
    swapped = []
    for view in views:
        ids = np.array([number[k] for k in view.corner_ids.tolist()])
        order = np.argsort(ids)
        swapped.append(dataclasses.replace(view, corner_ids=ids[order], points2D=view.points2D[order]))
    errors = []
    for board, some in ((BOARD, views), (SWAPPED, swapped)):
        shapes = shapes_to_try(record_with(off), BOARD, sightings(board, some))
        assert len(shapes) == (1 if board is BOARD else 2)
        checks = [check_camera(LENS, shape, some, limit_px=1.0) for shape in shapes]
        errors.append(min(check.rms_px for check in checks if not isinstance(check, Rejected)))
    flat = check_camera(LENS, known_shape(SWAPPED.points3D), swapped, limit_px=1.0)
    assert not isinstance(flat, Rejected)
    assert errors[1] == pytest.approx(errors[0], rel=1e-6)
    assert errors[0] < 0.2 < 3 * errors[0] < flat.rms_px


@pytest.mark.parametrize("other", [chessboard(9, 6, 0.03), chessboard(8, 6, 0.025), chessboard(6, 9, 0.03)])
def test_of_another_board_no_shape_is_known(other):
    assert shapes_to_try(record_with(np.full((54, 3), 1e-4)), BOARD, sightings(other)) == []


@pytest.mark.parametrize(
    ("facts", "given", "with_shape", "px", "said"),
    [
        ({"rms_px": 0.1, "holdout_rms_px": 0.2, "holdout_flat_px": 0.5}, None, True, 0.4, "photos held out"),
        ({"rms_px": 0.1, "holdout_rms_px": 0.2, "holdout_flat_px": 0.5}, None, False, 1.0, "taken for flat"),
        ({"rms_px": 0.1, "holdout_rms_px": 0.2}, None, False, 0.4, "photos held out"),
        ({"rms_px": 0.1}, None, True, 0.2, "calibrated from"),
        ({}, None, True, 1.0, "a guess"),
        ({"rms_px": 0.1}, 0.3, True, 0.3, "--max-error"),
    ],
)
def test_the_error_that_is_allowed_says_where_it_comes_from(facts, given, with_shape, px, said):
    limit = limit_of(CameraRecord(facts), given, with_shape=with_shape)
    assert limit.px == pytest.approx(px)
    assert said in limit.why


def test_displacements_for_another_number_of_corners_are_refused():
    path = Path("c.toml")
    assert board_of_record(path, record_with(np.zeros((54, 3)))).spec == BOARD.spec  # pyright: ignore
    assert board_of_record(path, record_with(np.zeros((0, 3)))).spec == BOARD.spec  # pyright: ignore
    with pytest.raises(FormatError, match=r"has 1 row, and chessboard:9x6:25mm 54 corners"):
        board_of_record(path, record_with(np.zeros((1, 3))))


@pytest.mark.parametrize(("others", "fails"), [(5, True), (2, False)])
def test_a_check_fails_where_most_photos_are_of_another_size(others, fails, rng):
    points = BOARD.points3D - BOARD.points3D.mean(axis=0)
    views = seen(LENS, points, poses_before(LENS, 8, rng), rng)
    views[:others] = [dataclasses.replace(view, width=view.width + 1) for view in views[:others]]
    check = check_camera(LENS, known_shape(points), views, limit_px=1.0)
    assert not isinstance(check, Rejected)
    assert check.failed is fails
    assert len(check.left_out) == others
    told = [finding.detail for finding in check.findings if finding.cause == "other_size"]
    assert told == ([f"{others} of 8 photos are not of 1280 × 960 px"] if fails else [])
