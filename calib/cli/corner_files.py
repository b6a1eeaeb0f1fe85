"""Corners that were found before, by `calib detect` or by another program.

    .json       what `calib detect -o` writes: corners with the board, the sizes of the photos and the pixel convention
    .vnl        mrcal's and mrgingham's table "filename x y level": all corners of a photo row by row, - for those that
                are missing
    .csv        one row a corner, columns by their names; one file for all photos, or a folder of one for each

A .csv has x, y and the corner's id, or tag and corner (0 … 3 of that tag); `image` where it is of several photos; and
the corner's place on the board as board_x, board_y[, board_z] in metres where no board is named. The names kp_x, kp_y,
p_x, p_y, p_z, tag_id, corner_idx, ts mean the same.
In .vnl and .csv the centre of the first pixel is (0, 0), as in OpenCV, and the sizes of the photos are not known.
"""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.boards import Board
from calib.boards_text import parse_board
from calib.cli.photos import detection_from_json
from calib.detect import Detection
from calib.refine_reject import RejectedView
from calib.refine_views import BoardView
from sfm.core.arrays import Points3D
from sfm.core.errors import ConfigError, FormatError, InputError, Rejected
from sfm.io.atomic import os_errors

SUFFIXES = (".json", ".vnl", ".csv")
_ALIASES = {
    "filename": "image", "ts": "image", "name": "image", "kp_x": "x", "kp_y": "y", "u": "x", "v": "y",
    "p_x": "board_x", "p_y": "board_y", "p_z": "board_z", "tag_id": "tag", "corner_idx": "corner", "corner_id": "id",
}  # fmt: skip
_SAME_PLACE_M = 1e-6
_OPENCV_HALF = 0.5

Corners = tuple[Board | None, Points3D, tuple[BoardView, ...], tuple[RejectedView, ...]]
"""The board, its points, views of it, and photos that show none."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Row:
    """A corner: which photo, which corner, where; `place` on the board in metres, NaN where the file does not say."""

    image: str
    corner: int
    x: float
    y: float
    place: tuple[float, float, float]


def corner_files(sources: Sequence[Path]) -> dict[str, Path]:
    """The files of corners that are named, or lie in a folder with nothing but them; empty where these are photos."""
    files: dict[str, Path] = {}
    for source in sources:
        found = [source]
        if source.is_dir():
            with os_errors(source):
                found = sorted(path for path in source.iterdir() if not path.name.startswith("."))
        if not found or not all(path.suffix.lower() in SUFFIXES for path in found):
            return {}
        files |= {path.name: path for path in found}
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
    if size is None:
        raise ConfigError("corners without photos need --size", path=path, remedy="for example --size 752x480")
    rows = [row for path in files.values() for row in _rows(path, board)]
    if not rows:
        raise FormatError("holds no corner", path=path)
    points3D = board.points3D if board is not None else _board_of(rows, path)
    _check_places(rows, points3D, path)
    images = dict.fromkeys(row.image for row in rows)
    views = tuple(_view(name, [row for row in rows if row.image == name], size, path) for name in images)
    seen = tuple(view for view in views if len(view.corner_ids))
    left_out = tuple(RejectedView(view.name, "no_board", "no corners") for view in views if not len(view.corner_ids))
    return board, points3D, seen, left_out


def _read_json(path: Path, board: Board | None) -> Corners:
    with os_errors(path):
        text = path.read_bytes()
    try:
        document = json.loads(text)
        own = parse_board(document["board"])
        points3D = np.array(document["points3D"], np.float64).reshape(-1, 3)
        shift = 0.5 - float(document.get("pixel_center", 0.5))
        seen = {name: detection_from_json(values) for name, values in document["images"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError("is not what `calib detect -o` writes", path=path) from error
    if board is not None and not np.array_equal(board.points3D, own.points3D):
        raise InputError(f"its corners are of {own.spec}, not of {board.spec}", path=path, remedy="leave --board out")
    if points3D.shape != own.points3D.shape:
        raise FormatError(f"has {len(points3D)} points of a board of {len(own.points3D)}", path=path)
    views = tuple(_moved(d, shift, len(points3D), path) for d in seen.values() if isinstance(d, Detection))
    left_out = (RejectedView(name, d.reason, d.detail) for name, d in seen.items() if isinstance(d, Rejected))
    return own, points3D, views, tuple(left_out)


def _moved(seen: Detection, shift: float, count: int, path: Path) -> BoardView:
    if len(seen.corner_ids) and not (seen.corner_ids.min() >= 0 and seen.corner_ids.max() < count):
        raise FormatError(f"{seen.name}: a corner is not of the board", path=path)
    try:
        return BoardView(seen.name, seen.width, seen.height, seen.corner_ids, seen.points2D + shift)
    except ValueError as error:
        raise FormatError(str(error), path=path) from error


def _rows(path: Path, board: Board | None) -> Iterable[_Row]:
    with os_errors(path):
        content = path.read_bytes()
    try:
        lines = [line.strip() for line in content.decode().splitlines() if line.strip()]
        if path.suffix.lower() == ".vnl":
            return _vnl_rows(lines, board, path)
        header = [_ALIASES.get(word, word) for word in next(csv.reader([lines[0].lstrip("# ").lower()]))]
        return [_csv_row(dict(zip(header, words, strict=True)), path) for words in csv.reader(lines[1:])]
    except (ValueError, KeyError, IndexError) as error:
        raise FormatError(f"is no table of corners: {error}", path=path, remedy="see docs/calibrate.md") from error


def _csv_row(row: dict[str, Any], path: Path) -> _Row:
    corner = int(row["id"]) if "id" in row else 4 * int(row["tag"]) + int(row["corner"])
    place = (float(row["board_x"]), float(row["board_y"]), float(row.get("board_z", 0))) if "board_x" in row else _NAN
    if corner < 0:
        raise ValueError(f"corner {corner}")
    return _Row(row.get("image", path.stem), corner, float(row["x"]), float(row["y"]), place)


_NAN = (float("nan"), float("nan"), float("nan"))


def _vnl_rows(lines: list[str], board: Board | None, path: Path) -> list[_Row]:
    """All corners of the board row by row; a photo without any has one line of dashes."""
    if board is None:
        raise ConfigError("does not say what board it is of", path=path, remedy="name it with --board")
    seen: dict[str, list[list[str]]] = {}
    for line in lines:
        if not line.startswith("#"):
            name, *words = line.split()
            seen.setdefault(name, []).append(words)
    rows = []
    for name, corners in seen.items():
        if len(corners) not in (1, len(board.points3D)):
            raise ValueError(f"{name} has {len(corners)} rows for a board of {len(board.points3D)} corners")
        told = [(k, words) for k, words in enumerate(corners) if words[0] != "-"]
        rows += [_Row(name, k, float(words[0]), float(words[1]), _NAN) for k, words in told]
        rows += [] if told else [_Row(name, -1, 0.0, 0.0, _NAN)]
    return rows


def _board_of(rows: list[_Row], path: Path) -> Points3D:
    """Points by id, from their places in the rows; (0, 0, 0) for those that no photo shows.

    Raises:
        ConfigError: the rows do not say where on the board they are.
    """
    placed = [row for row in rows if row.corner >= 0 and row.place is not _NAN]
    if len(placed) < len(rows):
        raise ConfigError("does not say what board it is of", path=path, remedy="name it with --board")
    points = np.zeros((max(row.corner for row in placed) + 1, 3))
    for row in placed:
        points[row.corner] = row.place
    return points


def _check_places(rows: list[_Row], points3D: Points3D, path: Path) -> None:
    for row in rows:
        if row.corner >= len(points3D):
            raise InputError(f"corner {row.corner} of a board of {len(points3D)}", path=path, remedy="check --board")
        if row.place is not _NAN and np.abs(points3D[row.corner] - row.place).max() > _SAME_PLACE_M:
            where = " ".join(f"{1000 * value:g}" for value in points3D[row.corner])
            there = " ".join(f"{1000 * value:g}" for value in row.place)
            raise InputError(
                f"corner {row.corner} lies at ({there}) mm, that of the board at ({where}) mm", path=path,
                remedy="check --board",
            )  # fmt: skip


def _view(name: str, rows: list[_Row], size: tuple[int, int], path: Path) -> BoardView:
    rows = sorted((row for row in rows if row.corner >= 0), key=lambda row: row.corner)
    points2D = np.array([(row.x, row.y) for row in rows], np.float64).reshape(-1, 2) + _OPENCV_HALF
    if len(rows) and not ((points2D > -1) & (points2D < np.add(size, 1))).all():
        raise InputError(f"corners of {name} lie outside of {size[0]}x{size[1]} px", path=path, remedy="check --size")
    try:
        return BoardView(name, *size, np.array([row.corner for row in rows], np.int64), points2D)
    except ValueError as error:
        raise FormatError(str(error), path=path) from error
