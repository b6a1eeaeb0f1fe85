"""Tables of corners as other programs write them.

    .vnl        mrcal's and mrgingham's "filename x y level": all corners of a photo row by row, - for those that are
                missing
    .csv        one row a corner, columns by their names; one file for all photos, or a folder of one for each

A .csv has x, y and the corner's id, or tag and corner (0 … 3 of that tag); `image` where it is of several photos; and
the corner's place on the board as board_x, board_y[, board_z] in metres where no board is named; board_z is 0, since
what a board is bent by is estimated. The names kp_x, kp_y, p_x, p_y, p_z, tag_id, corner_idx, ts mean the same.
The centre of the first pixel is (0, 0), as in OpenCV, and the sizes of the photos are not known.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from calib.boards import Board
from calib.refine_reject import RejectedView
from calib.refine_views import BoardView
from sfm.core.arrays import Points3D
from sfm.core.errors import ConfigError, FormatError, InputError
from sfm.io.atomic import os_errors

_ALIASES = {
    "filename": "image", "ts": "image", "name": "image", "kp_x": "x", "kp_y": "y", "u": "x", "v": "y",
    "p_x": "board_x", "p_y": "board_y", "p_z": "board_z", "tag_id": "tag", "corner_idx": "corner", "corner_id": "id",
}  # fmt: skip
_SAME_PLACE_M = 1e-6
_OPENCV_HALF = 0.5
_MOST_CORNERS = 160_000
"""Of the largest board that `Board` allows."""

Corners: TypeAlias = tuple[Board | None, Points3D, tuple[BoardView, ...], tuple[RejectedView, ...]]
"""The board, its points, views of it, and photos that show none."""


@dataclasses.dataclass(frozen=True, slots=True)
class Row:
    """A corner: which photo, which corner, where; `place` on the board in metres, None where the file does not say.

    `corner` is −1 for a photo without any. `path` and `number` say where it was read.
    """

    path: Path
    number: int
    image: str
    corner: int
    x: float
    y: float
    place: tuple[float, float, float] | None = None


def read_tables(files: Mapping[str, Path], board: Board | None, size: tuple[int, int] | None) -> Corners:
    """Corners of all files; arguments and errors are those of `read_corners`."""
    path = next(iter(files.values()))
    if size is None:
        raise ConfigError("corners without photos need --size", path=path, remedy="for example --size 752x480")
    rows = [row for path in files.values() for row in _rows(path, board)]
    if not rows:
        raise FormatError("holds no corner", path=path)
    points3D = board.points3D if board is not None else _board_of(rows)
    _check_places(rows, points3D)
    images: dict[str, list[Row]] = {}
    for row in rows:
        images.setdefault(row.image, []).append(row)
    views = [_view(name, of_image, size) for name, of_image in images.items()]
    seen = tuple(view for view in views if len(view.corner_ids))
    left_out = tuple(RejectedView(view.name, "no_board", "no corners") for view in views if not len(view.corner_ids))
    return board, points3D, seen, left_out


def check_inside(view: BoardView, path: Path, remedy: str) -> None:
    """Raises InputError where corners cannot be of a photo of this size, be they cut by its border."""
    size = (view.width, view.height)
    if not ((view.points2D > -1) & (view.points2D < np.add(size, 1))).all():
        told = f"corners of {view.name} lie outside of {size[0]}x{size[1]} px"
        raise InputError(told, path=path, remedy=remedy)


def _rows(path: Path, board: Board | None) -> Iterable[Row]:
    with os_errors(path):
        content = path.read_bytes()
    try:
        told = enumerate(content.decode("utf-8-sig").splitlines(), 1)
        lines = [(number, line.strip()) for number, line in told if line.strip()]
        return _vnl_rows(lines, board, path) if path.suffix.lower() == ".vnl" else list(_csv_rows(lines, path))
    except (ValueError, csv.Error) as error:
        raise FormatError(f"is no table of corners: {error}", path=path, remedy="see docs/calibrate.md") from error


def _csv_rows(lines: Sequence[tuple[int, str]], path: Path) -> Iterable[Row]:
    if not lines:
        return
    words = next(csv.reader([lines[0][1].lstrip("# ").lower()]))
    header = [_ALIASES.get(word.strip(), word.strip()) for word in words]
    needed = ["x", "y", *(["id"] if "id" in header or "tag" not in header else ["corner"])]
    needed += ["board_y"] if "board_x" in header else []
    if missing := [name for name in needed if name not in header]:
        raise ValueError(f"there is no column {', '.join(missing)}")
    for (number, _), cells in zip(lines[1:], csv.reader(line for _, line in lines[1:]), strict=True):
        try:
            yield _csv_row(dict(zip(header, cells, strict=True)), path, number)
        except ValueError as error:
            told = f"{len(cells)} cells for {len(header)} columns" if len(cells) != len(header) else str(error)
            raise ValueError(f"row {number}: {told}") from error


def _csv_row(row: Mapping[str, str], path: Path, number: int) -> Row:
    corner = int(row["id"]) if "id" in row else 4 * int(row["tag"]) + int(row["corner"])
    if not 0 <= corner < _MOST_CORNERS:
        raise ValueError(f"corner {corner}")
    place = None
    if "board_x" in row:
        place = _finite(row, "board_x"), _finite(row, "board_y"), _finite(row, "board_z") if "board_z" in row else 0.0
        if place[2] != 0:
            raise ValueError(f"board_z must be 0, got {place[2]:g}: boards are flat before their shape is estimated")
    return Row(path, number, row.get("image", path.stem), corner, _finite(row, "x"), _finite(row, "y"), place)


def _finite(row: Mapping[str, str], column: str) -> float:
    value = float(row[column])
    if not math.isfinite(value):
        raise ValueError(f"{column} must be finite, got {row[column]}")
    return value


def _vnl_rows(lines: Sequence[tuple[int, str]], board: Board | None, path: Path) -> list[Row]:
    """All corners of the board row by row; a photo without any has one line of dashes."""
    if board is None:
        raise ConfigError("does not say what board it is of", path=path, remedy="name it with --board")
    seen: dict[str, list[tuple[int, list[str]]]] = {}
    for number, line in lines:
        if not line.startswith("#"):
            name, *words = line.split()
            seen.setdefault(name, []).append((number, words))
    rows = []
    for name, corners in seen.items():
        if len(corners) not in (1, len(board.points3D)):
            raise ValueError(f"{name} has {len(corners)} rows for a board of {len(board.points3D)} corners")
        told = [(k, number, words) for k, (number, words) in enumerate(corners) if words[:1] != ["-"]]
        for k, number, words in told:
            if len(words) < 2 or not all(math.isfinite(float(word)) for word in words[:2]):
                raise ValueError(f"row {number}: expected a name, x and y, got {' '.join([name, *words])}")
            rows.append(Row(path, number, name, k, float(words[0]), float(words[1])))
        rows += [] if told else [Row(path, corners[0][0], name, -1, 0.0, 0.0)]
    return rows


def _board_of(rows: Sequence[Row]) -> Points3D:
    """Points by id, from their places in the rows; (0, 0, 0) for those that no photo shows.

    Raises:
        ConfigError: the rows do not say where on the board they are.
    """
    for row in rows:
        if row.place is None:
            raise ConfigError("does not say what board it is of", path=row.path, remedy="name it with --board")
    points = np.zeros((max(row.corner for row in rows) + 1, 3))
    for row in rows:
        points[row.corner] = row.place
    return points


def _check_places(rows: Sequence[Row], points3D: Points3D) -> None:
    for row in rows:
        told = f"row {row.number}: corner {row.corner}"
        if row.corner >= len(points3D):
            raise InputError(f"{told} of a board of {len(points3D)}", path=row.path, remedy="check --board")
        if row.place is not None and np.abs(points3D[row.corner] - row.place).max() > _SAME_PLACE_M:
            where = " ".join(f"{1000 * value:g}" for value in points3D[row.corner])
            there = " ".join(f"{1000 * value:g}" for value in row.place)
            raise InputError(
                f"{told} lies at ({there}) mm, that of the board at ({where}) mm", path=row.path,
                remedy="check --board",
            )  # fmt: skip


def _view(name: str, rows: Sequence[Row], size: tuple[int, int]) -> BoardView:
    path = rows[0].path
    rows = sorted((row for row in rows if row.corner >= 0), key=lambda row: row.corner)
    points2D = np.array([(row.x, row.y) for row in rows], np.float64).reshape(-1, 2) + _OPENCV_HALF
    try:
        view = BoardView(name, *size, np.array([row.corner for row in rows], np.int64), points2D)
    except ValueError as error:
        raise FormatError(str(error), path=path) from error
    check_inside(view, path, "check --size")
    return view
