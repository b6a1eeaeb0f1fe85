from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.board_extent import ShownSize, size_that_is_shown
from calib.boards import Board, asymmetric_circle_grid, charuco, chessboard, circle_grid
from calib.refine_views import BoardView
from datasets.synthetic import boards as views

SHOWN = chessboard(9, 6, 0.025)
CIRCLES = [circle_grid(9, 6, 0.025), asymmetric_circle_grid(4, 7, 0.025, 0.014)]
SIZES = [(9, 6), (8, 6), (10, 6), (9, 5), (9, 7), (8, 5), (10, 7)]


@pytest.fixture(scope="module", params=[views.PINHOLE, views.DISTORTED, views.FISHEYE], ids=lambda camera: camera.model)
def taken(request):
    """Photos of a board of 9x6, and how the camera sees points of it; the last shows only a part of the board."""
    return photographed(SHOWN, request.param)


@pytest.fixture(scope="module", params=CIRCLES, ids=lambda board: board.spec)
def circles(request):
    return request.param, photographed(request.param, views.DISTORTED)


def photographed(board: Board, camera):
    photos, nearer = [], 0.5 if camera is views.FISHEYE else 1.0
    for k, (tilt, axis, shift) in enumerate([(5, 0, 0.0), (35, 40, 0.0), (30, 130, 0.0), (25, 250, 0.12)]):
        where = views.pose(board, 0.36 * nearer, tilt, axis, shift=(shift * nearer, 0.0))
        photo, _ = views.render(board, camera, where, blur_px=0.7, noise=0.02, seed=k, texels_per_m=2000)
        photos.append((photo, lambda points, where=where: camera.project(where @ points)))
    return photos


def as_named(taken, named: Board, first: tuple[int, int]) -> list[tuple[np.ndarray, BoardView]]:
    """Photos with the corners of a board of another size whose first corner lies at this place, by the pitch."""
    points = named.points3D + named.pitch_m * np.array([*first, 0.0])
    photos = []
    for photo, project in taken:
        pixels, valid = project(points)
        height, width = photo.shape
        inside = np.flatnonzero(valid & np.all((pixels > 2) & (pixels < [width - 2, height - 2]), axis=1))
        photos.append((photo, BoardView("", width, height, inside, pixels[inside])))
    return photos


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("end", [0, 1])
def test_the_size_of_the_board_is_told_from_whichever_end_another_was_found(taken, size, end):
    named = dataclasses.replace(SHOWN, columns=size[0], rows=size[1])
    first = (end * (9 - size[0]), end * (6 - size[1]))
    shown = size_that_is_shown(named, as_named(taken, named, first))
    if size == (9, 6):
        assert shown is None
    else:
        assert shown is not None
        assert (shown.columns, shown.rows) == (9, 6)


@pytest.mark.parametrize("fewer", [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2)], ids=str)
@pytest.mark.parametrize("end", [0, 1])
def test_circles_beyond_those_that_were_found_are_seen(circles, fewer, end):
    board, taken = circles
    named = dataclasses.replace(board, columns=board.columns - fewer[0], rows=board.rows - fewer[1])
    # An asymmetric grid that starts at an odd row is none.
    staggered = board.kind == "acircles"
    first = (end * fewer[0] * (2 if staggered else 1), end * (fewer[1] - fewer[1] % 2 if staggered else fewer[1]))
    shown = size_that_is_shown(named, as_named(taken, named, first))
    if fewer == (0, 0):
        assert shown is None
    else:
        assert shown is not None
        assert (shown.columns, shown.rows) == board.grid
        assert shown.is_certain


def test_a_diameter_that_is_stated_wrongly_does_not_matter(circles):
    board, taken = circles
    for factor in (0.75, 1.25):
        stated = dataclasses.replace(board, detail_m=factor * board.detail_m, columns=board.columns - 1)
        shown = size_that_is_shown(stated, as_named(taken, stated, (0, 0)))
        assert shown is not None
        assert (shown.columns, shown.rows) == board.grid


def test_columns_and_rows_are_each_what_most_photos_show(taken, monkeypatch):
    sizes = iter([(9, 5), (9, 6), (8, 6), (9, 6)])
    monkeypatch.setattr("calib.board_extent._of_squares", lambda *_: next(sizes))
    named = chessboard(8, 5, 0.025)
    assert size_that_is_shown(named, as_named(taken, named, (0, 0))) == ShownSize(9, 6, 2, 4)


def test_few_photos_or_different_ones_are_not_certain():
    assert ShownSize(9, 6, 3, 4).is_certain
    assert not ShownSize(9, 6, 2, 2).is_certain
    assert not ShownSize(9, 6, 3, 5).is_certain


def test_nothing_is_said_of_boards_with_markers(taken):
    assert size_that_is_shown(charuco(9, 6, 0.03, 0.02), as_named(taken, SHOWN, (0, 0))) is None
