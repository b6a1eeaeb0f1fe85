"""Whether photos show a board that is nearly the one that was named.

The usual mistakes: squares counted instead of inner corners or the other way round, columns and rows swapped. (Of
chessboards and rectangular grids of circles the swapped one is the same board, turned: it needs no guess.)
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from calib.boards import Board
from calib.detect import Detection, detect_board
from sfm.core.errors import ImageError
from sfm.io.images import read_image

_PHOTOS = 2
_PATIENCE_S = 15.0
"""Of work, whatever else the machine does: finders take seconds where there is nothing to be found."""
_MOSTLY = 0.6
"""Part of the corners of another board that must be seen."""
_STEPS = ((-1, -1), (1, 1), (-1, 0), (0, -1), (1, 0), (0, 1))


def board_that_is_shown(photos: Mapping[str, Path], board: Board) -> Board | None:
    """Another board that some of the first photos show, None where they show none of those that were tried."""
    began = time.thread_time()
    for path in list(photos.values())[:_PHOTOS]:
        try:
            grey = read_image(path, gray=True)
        except ImageError:
            continue
        for other in _similar(board):
            if time.thread_time() - began > _PATIENCE_S:
                return None
            seen = detect_board(grey, other)
            if isinstance(seen, Detection) and len(seen.corner_ids) >= _MOSTLY * len(other.points3D):
                return other
    return None


def _similar(board: Board) -> Iterator[Board]:
    sizes = [(board.columns + dx, board.rows + dy) for dx, dy in _STEPS]
    if board.kind not in ("chessboard", "circles") and board.columns != board.rows:
        sizes.insert(0, (board.rows, board.columns))
    for columns, rows in sizes:
        try:
            yield dataclasses.replace(board, columns=columns, rows=rows)
        except ValueError:
            continue
