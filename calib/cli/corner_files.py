"""Corners that were found before, by `calib detect` or by another program.

.json       what `calib detect -o` writes: corners with the board, the sizes of the photos and the pixel convention
.vnl, .csv  tables of other programs, see `corner_tables`
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.boards import Board
from calib.boards_text import parse_board
from calib.cli.corner_tables import Corners, check_inside, read_tables
from calib.cli.photos import detection_from_json
from calib.detect import Detection
from calib.refine_reject import RejectedView
from calib.refine_views import BoardView
from sfm.core.arrays import Points3D
from sfm.core.errors import ConfigError, FormatError, InputError, Rejected
from sfm.io.atomic import os_errors

SUFFIXES = (".json", ".vnl", ".csv")
_SAME_BOARD = 1e-8
"""Of lengths, which a board's word has with nine digits."""


def corner_files(sources: Sequence[Path]) -> dict[str, Path]:
    """The files of corners that are named, or lie in a folder with nothing but them; empty where these are photos.

    Raises:
        InputError: a folder cannot be read, or two files have one name.
    """
    files: dict[str, Path] = {}
    for source in sources:
        found = [source]
        if source.is_dir():
            with os_errors(source):
                found = sorted(path for path in source.iterdir() if not path.name.startswith("."))
        if not found or not all(path.suffix.lower() in SUFFIXES for path in found):
            return {}
        names = {path.name: path for path in found}
        if twice := files.keys() & names.keys():
            raise InputError(f"{min(twice)} is there twice", path=source, remedy="name one folder")
        files |= names
    return files


def read_corners(files: dict[str, Path], board: Board | None, size: tuple[int, int] | None) -> Corners:
    """Corners of all files.

    Args:
        board: what they are of; needed where the files do not say it.
        size: width and height of the photos in px; likewise.
    Raises:
        InputError: a file cannot be read, or disagrees with `board`.
        ConfigError: board or size are needed and not given.
    """
    path = next(iter(files.values()))
    if path.suffix.lower() == ".json":
        if len(files) > 1:
            raise InputError("is one of several files of corners", path=path, remedy="name one .json")
        return _read_json(path, board)
    return read_tables(files, board, size)


def _read_json(path: Path, board: Board | None) -> Corners:
    with os_errors(path):
        text = path.read_bytes()
    try:
        document = json.loads(text)
        own = parse_board(document["board"])
        points3D = np.array(document["points3D"], np.float64).reshape(-1, 3)
        shift = 0.5 - float(document.get("pixel_center", 0.5))
        seen = {name: _detection(name, values, len(points3D), path) for name, values in document["images"].items()}
    except ConfigError as error:
        raise FormatError(f"names no board: {error.cause}", path=path, remedy=error.remedy) from error
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise FormatError("is not what `calib detect -o` writes", path=path) from error
    if board is not None and not _same(board.points3D, own.points3D):
        raise InputError(f"its corners are of {own.spec}, not of {board.spec}", path=path, remedy="leave --board out")
    _check_points(points3D, own, path)
    views = tuple(_view(d, shift, path) for d in seen.values() if isinstance(d, Detection))
    left_out = (RejectedView(name, d.reason, d.detail) for name, d in seen.items() if isinstance(d, Rejected))
    return own, points3D, views, tuple(left_out)


def _same(points: Points3D, others: Points3D) -> bool:
    return points.shape == others.shape and np.allclose(points, others, rtol=_SAME_BOARD, atol=0)


def _check_points(points3D: Points3D, board: Board, path: Path) -> None:
    if points3D.shape != board.points3D.shape:
        raise FormatError(f"has {len(points3D)} points of a board of {len(board.points3D)}", path=path)
    for number, point in enumerate(points3D.tolist()):
        if not np.isfinite(point).all() or point[2] != 0:
            raise FormatError(f"points3D: {number} must be [x, y, 0.0] in metres, got {point}", path=path)


def _detection(name: str, values: Mapping[str, Any], count: int, path: Path) -> Detection | Rejected:
    """What is written of a photo, called as the file calls it.

    Args:
        count: of the corners of the board.
    """
    if "reason" in values:
        return detection_from_json(values)
    for side in ("width", "height"):
        if type(values[side]) is not int or values[side] < 1:
            raise FormatError(f"{name}: {side} must be a whole number of px, got {values[side]!r}", path=path)
    for number in values["corner_ids"]:
        if type(number) is not int or not 0 <= number < count:
            raise FormatError(f"{name}: {number!r} is no corner of a board of {count}", path=path)
    return detection_from_json({**values, "name": name})


def _view(seen: Detection, shift: float, path: Path) -> BoardView:
    try:
        view = BoardView(seen.name, seen.width, seen.height, seen.corner_ids, seen.points2D + shift)
    except ValueError as error:
        raise FormatError(str(error), path=path) from error
    check_inside(view, path, "check width and height")
    return view
