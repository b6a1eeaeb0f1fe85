"""What the markers in photos say of the board: that they are of another dictionary, mirrored, or of another size."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from calib.boards import DEFAULT_DICTIONARY, Board
from calib.boards_artwork import marker_dictionary
from calib.refine_views import BoardView
from sfm.core.arrays import FloatArray, ImageU8
from sfm.core.errors import ImageError
from sfm.core.geometry.homogeneous import transform_points
from sfm.io.images import read_image

_PHOTOS, _FEWEST = 3, 4
"""Photos that are looked at, and markers in one of them that are not read by chance."""
_SEVERAL_SIZES = ("4X4", "5X5", "6X6", "7X7")
_SIZES = (50, 100, 250, 1000)
_OTHERS = ("DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11", "DICT_APRILTAG_25h9", "DICT_APRILTAG_16h5")
_DIFFERS = 0.1
"""Part of a marker's side; as measured it is right to 2 %."""
_LEAST_CORNERS, _ENOUGH = 6, 8


def marker_words(photos: Sequence[Path], board: Board) -> str:
    """What is to be done if the first photos show markers, but not those of the board; empty where they do not say."""
    for path in photos[:_PHOTOS]:
        try:
            grey = np.asarray(read_image(path, gray=True))
        except ImageError:
            continue
        named = len(_read(grey, board, board.dictionary)[0])
        flipped = np.ascontiguousarray(grey[:, ::-1])
        if len(_read(flipped, board, board.dictionary)[0]) >= max(_FEWEST, 2 * named):
            return "the photos are mirrored, since their markers can be read only in a mirror: turn mirroring off"
        for dictionary in _dictionaries(board):
            ids, _ = _read(grey, board, dictionary)
            if len(ids) < max(_FEWEST, 2 * named):
                continue
            shown = _smallest(dictionary, int(ids.max()), DEFAULT_DICTIONARY[board.kind])
            other = dataclasses.replace(board, dictionary=shown)
            return f"the photos show markers of {shown}, you named {board.dictionary}: try --board {other.spec}"
    return ""


def shown_marker_size(board: Board, photos: Sequence[tuple[ImageU8, BoardView]]) -> tuple[float, int] | None:
    """Side of the markers of a ChArUco board by its squares (m), and in how many photos; None where it is as named."""
    if board.kind != "charuco":
        return None
    measured = []
    for grey, view in photos:
        if len(view.corner_ids) < _LEAST_CORNERS:
            continue
        H, _ = cv2.findHomography(view.points2D, board.points3D[view.corner_ids, :2])
        _, quads = _read(np.asarray(grey), board, board.dictionary)
        sides = [_side(H, quad) for quad in quads if H is not None and _is_among(quad, view.points2D)]
        if len(sides) >= _FEWEST:
            measured.append(float(np.median(sides)))
    if len(measured) < 2:
        return None
    side = float(np.median(measured))
    agree = int(np.sum(np.abs(np.array(measured) - side) < 0.5 * _DIFFERS * side))
    differs = abs(side / board.detail_m - 1) > _DIFFERS and 2 * agree > len(measured)
    return (side, agree) if differs else None


def unseen_line(board: Board, views: Sequence[BoardView]) -> Board | None:
    """The ChArUco board without its last row or column, where no photo shows a corner of that but many of the next."""
    if board.kind != "charuco" or len(views) < _ENOUGH:
        return None
    across, down = board.grid
    lines = {
        "rows": (down, [view.corner_ids // across for view in views]),
        "columns": (across, [view.corner_ids % across for view in views]),
    }
    for what, (count, seen) in lines.items():
        unseen = not any(np.any(line == count - 1) for line in seen)
        if unseen and 2 * sum(bool(np.any(line == count - 2)) for line in seen) > len(views):
            try:
                return dataclasses.replace(board, **{what: getattr(board, what) - 1})
            except ValueError:
                return None
    return None


def _read(grey: np.ndarray, board: Board, dictionary: str) -> tuple[np.ndarray, list[FloatArray]]:
    """Ids of the markers in a photo, none twice, and their corners in pixels."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2 if board.kind == "aprilgrid" else 1
    quads, ids, _ = cv2.aruco.ArucoDetector(marker_dictionary(dictionary), parameters).detectMarkers(grey)
    if ids is None:
        return np.zeros(0, np.int64), []
    return np.unique(ids), [np.asarray(quad, np.float64).reshape(4, 2) + 0.5 for quad in quads]


def _dictionaries(board: Board) -> Iterator[str]:
    """The largest of each kind, which contains the others, but not the one that was named."""
    several = [name for name in _SEVERAL_SIZES if not board.dictionary.startswith(f"DICT_{name}_")]
    yield from (f"DICT_{name}_{_SIZES[-1]}" for name in several)
    yield from (name for name in _OTHERS if name != board.dictionary)


def _smallest(dictionary: str, largest_id: int, default: str) -> str:
    """The smallest dictionary of its kind with this id; rather the default one, which begins alike."""
    kind = dictionary.rsplit("_", 1)[0]
    if dictionary in _OTHERS or default.startswith(f"{kind}_"):
        return dictionary if dictionary in _OTHERS else default
    return f"{kind}_{next(size for size in _SIZES if largest_id < size)}"


def _side(H: FloatArray, quad: FloatArray) -> float:
    """Mean length of the sides on the board."""
    on_board = transform_points(H, quad)
    return float(np.mean(np.linalg.norm(on_board - np.roll(on_board, 1, axis=0), axis=1)))


def _is_among(quad: FloatArray, points: FloatArray) -> bool:
    """Whether it lies between corners that were found, where a homography holds for lenses that bend lines, too."""
    middle = quad.mean(0)
    return bool(np.all(middle > points.min(0)) and np.all(middle < points.max(0)) and math.isfinite(middle.sum()))
