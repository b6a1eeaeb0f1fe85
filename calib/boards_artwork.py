"""What a board looks like: black and white rectangles and black circles, in metres.

The artwork's frame is that of a page: origin at the top left of the white margin, x right, y down.
"""

from __future__ import annotations

import dataclasses
from itertools import groupby

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from calib.boards import Board
from sfm.core.arrays import Points2D, Value, readonly

Rectangles = Float64[np.ndarray, "R 4"]
"""Left, top, width, height."""
Circles = Float64[np.ndarray, "C 3"]
"""Centre x, y and radius."""

_TAG_BORDER_CELLS = 2
_QUIET = 0.25
"""White margin of a chessboard by its squares; the paper adds its own. 9 × 6 corners of 25 mm then fit on A4."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Artwork(Value):
    """Shapes in the order in which they are painted on white: black, then white on top, and black circles.

    Attributes:
        width_m, height_m: with the white margin that detectors need.
        corners: the corners of the board by id, in the artwork's frame.
    """

    width_m: float
    height_m: float
    black: Rectangles
    white: Float64[np.ndarray, "W 4"]
    circles: Circles
    corners: Points2D

    def __post_init__(self) -> None:
        object.__setattr__(self, "black", readonly(np.reshape(self.black, (-1, 4)), (None, 4)))
        object.__setattr__(self, "white", readonly(np.reshape(self.white, (-1, 4)), (None, 4)))
        object.__setattr__(self, "circles", readonly(np.reshape(self.circles, (-1, 3)), (None, 3)))
        object.__setattr__(self, "corners", readonly(self.corners, (None, 2)))


def artwork(board: Board) -> Artwork:
    """The shapes of a board.

    Raises:
        ValueError: the set of markers is unknown to OpenCV, or has too few.
    """
    match board.kind:
        case "chessboard":
            return _chessboard(board, board.columns + 1, board.rows + 1, np.empty((0, 4)))
        case "charuco":
            return _chessboard(board, board.columns, board.rows, _charuco_markers(board))
        case "aprilgrid":
            return _aprilgrid(board)
    return _circles(board)


def older_charuco(board: Board) -> Artwork:
    """A ChArUco board in OpenCV's layout before 4.6: one with an even number of rows is white at the top left.

    Raises:
        ValueError: as `artwork`.
    """
    first = (board.rows + 1) % 2
    return _chessboard(board, board.columns, board.rows, _charuco_markers(board, first), first)


def marker_squares(columns: int, rows: int, first: int = 0) -> list[tuple[int, int]]:
    """(column, row) of the white squares of a chessboard, in the order of the markers.

    Args:
        first: 0 if the board is black at the top left, 1 if it is white there.
    """
    return [(column, row) for row in range(rows) for column in range(columns) if (column + row) % 2 != first]


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's set of markers of this name.

    Raises:
        ValueError: there is none.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(number, int):
        raise ValueError(f"unknown set of markers {name!r}; known are {', '.join(dictionary_names())}")
    return cv2.aruco.getPredefinedDictionary(number)


def dictionary_names(markers: int = 0) -> list[str]:
    """OpenCV's sets of at least so many markers, each by one name."""
    names = [word for word in dir(cv2.aruco) if word.startswith("DICT_")]
    once = {getattr(cv2.aruco, name): name for name in names}  # some are there as 36H11 and as 36h11
    return [name for name in once.values() if len(marker_dictionary(name).bytesList) >= markers]


def markers_of(board: Board) -> int:
    """How many markers a board has; their numbers are 0, 1, 2 …"""
    match board.kind:
        case "charuco":
            return len(marker_squares(board.columns, board.rows))
        case "aprilgrid":
            return board.columns * board.rows
    return 0


def marker_cells(dictionary: str, marker: int, border: int) -> Bool[np.ndarray, "S S"]:
    """The cells of a marker, True for white, with a black border `border` cells wide.

    Raises:
        ValueError: the set has no marker of this number.
    """
    markers = marker_dictionary(dictionary)
    if marker >= len(markers.bytesList):
        raise ValueError(f"{dictionary} has {len(markers.bytesList)} markers, at least {marker + 1} are needed")
    return markers.generateImageMarker(marker, markers.markerSize + 2 * border, borderBits=border) > 127


def _chessboard(board: Board, columns: int, rows: int, white: Float64[np.ndarray, "W 4"], first: int = 0) -> Artwork:
    side, margin = board.pitch_m, _QUIET * board.pitch_m
    black = [
        (margin + column * side, margin + row * side, side, side)
        for row in range(rows)
        for column in range(columns)
        if (column + row) % 2 == first
    ]
    markers = [
        (margin + (column + 0.5) * side - board.detail_m / 2, margin + (row + 0.5) * side - board.detail_m / 2)
        for column, row in (marker_squares(columns, rows, first) if board.kind == "charuco" else [])
    ]
    black += [(x, y, board.detail_m, board.detail_m) for x, y in markers]
    return Artwork(
        columns * side + 2 * margin,
        rows * side + 2 * margin,
        np.array(black),
        white + np.array([margin, margin, 0, 0]),
        np.empty((0, 3)),
        board.points3D[:, :2] + margin + side,
    )


def _charuco_markers(board: Board, first: int = 0) -> Rectangles:
    """White cells of all markers; the squares of the board begin at the origin."""
    inset = (board.pitch_m - board.detail_m) / 2
    return np.concatenate(
        [
            _white_cells(marker_cells(board.dictionary, marker, 1), board.detail_m)
            + np.array([column * board.pitch_m + inset, row * board.pitch_m + inset, 0, 0])
            for marker, (column, row) in enumerate(marker_squares(board.columns, board.rows, first))
        ]
    )


def _aprilgrid(board: Board) -> Artwork:
    tag, gap = board.pitch_m, board.detail_m
    step = tag + gap
    margin = tag / 2
    width, height = (count * step + gap + 2 * margin for count in (board.columns, board.rows))
    black, white = [], []
    for number in range(board.columns * board.rows):
        row, column = divmod(number, board.columns)
        left, top = margin + gap + column * step, height - margin - gap - row * step - tag
        black.append((left, top, tag, tag))
        # Kalibr's tags stand on their heads beside OpenCV's: its first corner is at the bottom right here.
        cells = marker_cells(board.dictionary, number, _TAG_BORDER_CELLS)[::-1, ::-1]
        white.append(_white_cells(cells, tag) + np.array([left, top, 0, 0]))
    black += [
        (margin + column * step, margin + row * step, gap, gap)
        for row in range(board.rows + 1)
        for column in range(board.columns + 1)
    ]
    first = np.array([margin + gap, height - margin - gap])
    corners = first + board.points3D[:, :2] * [1, -1]
    return Artwork(width, height, np.array(black), np.concatenate(white), np.empty((0, 3)), corners)


def _circles(board: Board) -> Artwork:
    margin = board.pitch_m / 2 + board.detail_m / 2
    corners = board.points3D[:, :2] + margin
    width, height = corners.max(axis=0) + margin
    circles = np.column_stack([corners, np.full(len(corners), board.detail_m / 2)])
    return Artwork(float(width), float(height), np.empty((0, 4)), np.empty((0, 4)), circles, corners)


def _white_cells(cells: Bool[np.ndarray, "S S"], side: float) -> Rectangles:
    """Runs of white cells within the rows of a marker, whose corner is the origin."""
    cell = side / len(cells)
    runs = []
    for row, line in enumerate(cells):
        column = 0
        for is_white, run in groupby(line):
            length = len(list(run))
            if is_white:
                runs.append((column * cell, row * cell, length * cell, cell))
            column += length
    return np.array(runs, np.float64).reshape(-1, 4)
