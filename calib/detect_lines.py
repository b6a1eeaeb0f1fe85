"""Whether a chessboard's first or last line is where the finder has put it.

Where a board is close to the border of the image, finders may miss its outermost line and invent one beyond the
opposite side, along the edges of the outer squares: the board is read one square off. Most corners of such a line are
no crossings. If beyond the opposite line there are crossings instead, these are the board's.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.boards import Board
from calib.detect_gates import Corners, on_board
from calib.detect_grids import Found
from calib.detect_neighbours import predicted
from sfm.core.arrays import Mask

_LEAST_KNOWN = 10
"""Corners from which others can be told."""


def absent_lines(board: Board, corners: Corners) -> Iterator[tuple[tuple[int, int], Mask]]:
    """The outer lines that have lost more than half of their corners.

    Yields:
        The step (columns, rows) towards the opposite side; and which corners the line holds (N,).
    """
    columns, rows = board.grid
    column, row, kept = corners.ids % columns, corners.ids // columns, corners.kept
    for step, line in (
        ((1, 0), column == 0),
        ((-1, 0), column == columns - 1),
        ((0, 1), row == 0),
        ((0, -1), row == rows - 1),
    ):
        if 2 * np.sum(kept & line) < (rows if step[0] else columns):
            yield step, line


def moved(board: Board, corners: Corners, step: tuple[int, int], line: Mask) -> Found | None:
    """The board with an absent line on the opposite side; None where too little is left to tell its place."""
    known = corners.kept & ~line
    if known.sum() < _LEAST_KNOWN:
        return None
    places, points2D = on_board(board, corners.ids[known]), corners.points2D[known]
    columns, rows = board.grid
    wanted = board.points3D[:, :2] + np.array(step) * board.pitch_m
    sought, _ = predicted(wanted, places, points2D)
    # Corners that are known are where they are, one step earlier in the order of the moved board.
    column, row = corners.ids[known] % columns - step[0], corners.ids[known] // columns - step[1]
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    sought[(row * columns + column)[inside]] = points2D[inside]
    return "a line further", np.arange(len(sought)), sought
