"""What photos of a board are checked by: where its corners lie, and the error that is allowed.

The shape of the board in a camera file is of one board. Of the same board, named with columns and rows swapped, it is
the same shape, turned; of another one nothing is known, and its corners err as those of a flat board would.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calib.boards import Board
from calib.boards_text import parse_board
from calib.check import known_shape
from calib.cli.sightings import UNNAMED, Sightings
from calib.refine_board import BoardShape
from sfm.core.arrays import Points3D
from sfm.core.errors import ConfigError, FormatError
from sfm.io.camera_records import CameraRecord

_TOLERANCE = 2.0
"""Times the held-out error of the calibration that other photos may have: light and blur differ."""
_UNKNOWN_PX = 1.0
_TURNABLE = ("chessboard", "circles")
"""Boards that are themselves when columns and rows are swapped."""


@dataclasses.dataclass(frozen=True, slots=True)
class Limit:
    """The rms error that is allowed, px, and where it comes from, in words."""

    px: float
    why: str


def board_of_record(path: Path, record: CameraRecord) -> Board | None:
    """The board of a camera file, if it names one; corners of other programs may have places of their own.

    Raises:
        ConfigError: what it names is none.
        FormatError: it has displacements for another number of corners.
    """
    if record.board is None or UNNAMED.fullmatch(record.board.spec):
        return None
    try:
        board = parse_board(record.board.spec)
    except ConfigError as error:
        raise ConfigError(f"[board] {error.cause}", path=path, remedy="name the board with --board") from error
    rows, corners = len(record.board.displacements), len(board.points3D)
    if rows not in (0, corners):
        told = f"[board] displacements has {rows} row{'s' if rows > 1 else ''}, and {board.spec} {corners} corners"
        raise FormatError(told, path=path)
    return board


def shapes_to_try(record: CameraRecord, known: Board | None, seen: Sightings) -> list[BoardShape]:
    """Where the corners may lie, by the shape that they were found to have; none where it is of another board.

    Two for a board with columns and rows swapped: the file does not tell which way it was turned. Of a board without a
    name the file does not tell whether it is the one with this shape: it may be flat as well.
    """
    if record.board is not None and UNNAMED.fullmatch(record.board.spec) and seen.board is None:
        if len(seen.points3D) != len(record.board.displacements):
            return []
        return [known_shape(seen.points3D + moved) for moved in (record.board.displacements, 0.0)]
    if record.board is None or known is None or seen.board is None or not len(record.board.displacements):
        return []
    if seen.board.spec == known.spec:
        return [known_shape(seen.points3D + record.board.displacements)]
    is_like = seen.board.kind == known.kind and len(seen.points3D) == len(known.points3D)
    if not is_like or known.kind not in _TURNABLE:
        return []
    turned = _turned(known.points3D, seen.points3D, record.board.displacements)
    return [known_shape(seen.points3D + moved) for moved in turned]


def _turned(points: Points3D, others: Points3D, moved: Points3D) -> Iterator[Points3D]:
    """Displacements of `points` as those of `others`, where a quarter turn brings the ones onto the others."""
    for sign in (1.0, -1.0):
        turn = np.array([[0.0, -sign, 0.0], [sign, 0.0, 0.0], [0.0, 0.0, 1.0]])
        placed = (points - points.mean(axis=0)) @ turn.T + others.mean(axis=0)
        apart = np.linalg.norm(placed[None] - others[:, None], axis=2)
        nearest = np.argmin(apart, axis=1)
        if np.max(apart[np.arange(len(others)), nearest]) < 1e-9 and len(set(nearest.tolist())) == len(others):
            yield moved[nearest] @ turn.T


def limit_of(record: CameraRecord, max_error: float | None, *, with_shape: bool) -> Limit:
    """The error that is allowed.

    Args:
        max_error: what the user says, if anything.
        with_shape: the board's corners are where the calibration found them.
    """
    if max_error is not None:
        return Limit(max_error, "by --max-error")
    flat, held_out, trained = (record.number(key) for key in ("holdout_flat_px", "holdout_rms_px", "rms_px"))
    if not with_shape and math.isfinite(flat) and flat != held_out:
        return Limit(_TOLERANCE * flat, "twice the error of photos held out with the board taken for flat")
    if math.isfinite(held_out):
        return Limit(_TOLERANCE * held_out, "twice the error of photos held out")
    if math.isfinite(trained):
        return Limit(_TOLERANCE * trained, "twice the error of the photos that it was calibrated from")
    return Limit(_UNKNOWN_PX, "a guess: the file says nothing of its calibration; --max-error sets another")
