"""Boards: what is printed, and where its corners are.

All boards are flat. Corners lie in the plane z = 0 of a frame whose origin is the first corner, x along the rows.
In chessboards, ChArUco boards and circle grids y runs down the page as in images, so that z points into the paper, and
corners are numbered row by row. In an AprilGrid, as in Kalibr, y runs up and z out of the paper; tags are numbered
from the bottom left, row by row, and tag t has the corners 4t … 4t + 3: bottom left, bottom right, top right, top left.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, TypeAlias

import numpy as np

from sfm.core.arrays import Points2D, Points3D, Value, readonly

BoardKind: TypeAlias = Literal["chessboard", "charuco", "aprilgrid", "circles", "acircles"]
KINDS: tuple[BoardKind, ...] = ("chessboard", "charuco", "aprilgrid", "circles", "acircles")
DEFAULT_DICTIONARY = {"charuco": "DICT_5X5_1000", "aprilgrid": "DICT_APRILTAG_36h11"}
"""Names of the sets of markers, as OpenCV has them."""

_TAG_BORDER = 0.2
"""Black border of a Kalibr tag by its side: 2 of 10 cells."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Board(Value):
    """A calibration board.

    Attributes:
        columns, rows: inner corners of a chessboard, squares of a ChArUco board, tags of an AprilGrid, circles; of
            asymmetric circles the number in a row, and the number of rows.
        pitch_m: side of a square or tag, distance of neighbouring circles; of asymmetric circles half of that within
            a row, which is the distance of the rows.
        detail_m: side of the ChArUco markers, gap between tags, diameter of the circles; 0 for a chessboard.
        dictionary: OpenCV's name of the set of markers, empty where there are none.
        points3D: corners, or centres of the circles; the row is the corner's id.

    Raises:
        ValueError: a number is out of its range.
    """

    kind: BoardKind
    columns: int
    rows: int
    pitch_m: float
    detail_m: float = 0.0
    dictionary: str = ""
    points3D: Points3D = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        _check(self)
        if not self.dictionary:
            object.__setattr__(self, "dictionary", DEFAULT_DICTIONARY.get(self.kind, ""))
        flat = _corners(self)
        object.__setattr__(self, "points3D", readonly(np.column_stack([flat, np.zeros(len(flat))]), (None, 3)))

    def __reduce__(self) -> tuple[object, ...]:
        return Board, (self.kind, self.columns, self.rows, self.pitch_m, self.detail_m, self.dictionary)

    @property
    def grid(self) -> tuple[int, int]:
        """(columns, rows) of the corners."""
        match self.kind:
            case "charuco":
                return self.columns - 1, self.rows - 1
            case "aprilgrid":
                return 2 * self.columns, 2 * self.rows
        return self.columns, self.rows

    @property
    def has_markers(self) -> bool:
        """Whether corners have names of their own, so that a part of the board can be recognised."""
        return self.kind in ("charuco", "aprilgrid")

    @property
    def has_circles(self) -> bool:
        """Whether the points are centres of circles."""
        return self.kind in ("circles", "acircles")

    @property
    def clear_radius_m(self) -> float:
        """Around a corner nothing else is printed but its own two edges, or its own circle, up to this distance.

        For a chessboard it is half of that, so that the pixels of a corner are no other's.
        """
        match self.kind:
            case "chessboard":
                return self.pitch_m / 2
            case "charuco":
                return (self.pitch_m - self.detail_m) / np.sqrt(2)
            case "aprilgrid":
                return min(self.detail_m, np.sqrt(2) * _TAG_BORDER * self.pitch_m)
        nearest = self.pitch_m * (np.sqrt(2) if self.kind == "acircles" else 1)
        return nearest - self.detail_m / 2

    @property
    def diagonal_is_black(self) -> np.ndarray:
        """Of each corner, whether the two quadrants in which x y > 0 are black, rather than the other two."""
        numbers = np.arange(len(self.points3D))
        if self.kind == "aprilgrid":
            return numbers % 2 == 0
        return (numbers % self.grid[0] + numbers // self.grid[0]) % 2 == 0

    @property
    def spec(self) -> str:
        """The board in one word, which `boards_text.parse_board` reads."""
        lengths = [self.pitch_m, self.detail_m] if self.detail_m else [self.pitch_m]
        words = [self.kind, f"{self.columns}x{self.rows}", *(f"{1000 * length:.9g}mm" for length in lengths)]
        own = [] if self.dictionary == DEFAULT_DICTIONARY.get(self.kind, "") else [self.dictionary]
        return ":".join(words + own)


def chessboard(columns: int, rows: int, square_m: float) -> Board:
    """A chessboard with `columns` × `rows` inner corners."""
    return Board("chessboard", columns, rows, square_m)


def charuco(columns: int, rows: int, square_m: float, marker_m: float, dictionary: str = "") -> Board:
    """A chessboard of `columns` × `rows` squares with a marker in each white one; the corner at the top left is black.

    This is the layout of OpenCV since 4.6. In the older one boards with an even number of rows start with white;
    detection tries both.
    """
    return Board("charuco", columns, rows, square_m, marker_m, dictionary)


def aprilgrid(columns: int, rows: int, tag_m: float, gap_m: float, dictionary: str = "") -> Board:
    """Kalibr's grid of AprilTags with borders of 2 cells and black squares in the gaps between their corners.

    Kalibr's `tagSpacing` is gap_m / tag_m.
    """
    return Board("aprilgrid", columns, rows, tag_m, gap_m, dictionary)


def circle_grid(columns: int, rows: int, distance_m: float, diameter_m: float = 0.0) -> Board:
    """A rectangular grid of black circles; without a diameter that of half the distance."""
    return Board("circles", columns, rows, distance_m, diameter_m or distance_m / 2)


def asymmetric_circle_grid(columns: int, rows: int, row_distance_m: float, diameter_m: float = 0.0) -> Board:
    """Rows of circles, `row_distance_m` apart, every second one shifted by this much; within a row twice as far.

    `columns` counts the circles of one row, as OpenCV does.
    """
    return Board("acircles", columns, rows, row_distance_m, diameter_m or round(row_distance_m * 0.7, 9))


def _check(board: Board) -> None:
    least = 3 if board.kind in ("chessboard", "charuco") else 1 if board.kind == "aprilgrid" else 2
    if board.kind not in KINDS:
        raise ValueError(f"unknown kind of board {board.kind!r}; known are {', '.join(KINDS)}")
    if min(board.columns, board.rows) < least or max(board.columns, board.rows) > 200:
        raise ValueError(f"expected {least} to 200 columns and rows, got {board.columns}x{board.rows}")
    if not (np.isfinite(board.pitch_m) and 1e-5 <= board.pitch_m <= 100):
        raise ValueError(f"expected a distance of 0.01 mm to 100 m, got {board.pitch_m} m")
    widest = {"chessboard": 0.0, "aprilgrid": 10.0, "acircles": np.sqrt(2)}.get(board.kind, 1.0) * board.pitch_m
    if board.kind == "chessboard":
        if board.detail_m:
            raise ValueError(f"a chessboard has no second length, got {board.detail_m} m")
    elif not 0 < board.detail_m < widest:
        raise ValueError(f"expected a second length between 0 and {widest:g} m, got {board.detail_m} m")


def _corners(board: Board) -> Points2D:
    """(x, y) of all corners by id, in metres."""
    columns, rows = board.grid
    if board.kind == "aprilgrid":
        step = board.pitch_m + board.detail_m
        square = board.pitch_m * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
        tags = _grid(board.columns, board.rows) * step
        return (tags[:, None] + square).reshape(-1, 2)
    places = _grid(columns, rows)
    if board.kind == "acircles":
        places[:, 0] = 2 * places[:, 0] + places[:, 1] % 2
    return places * board.pitch_m


def _grid(columns: int, rows: int) -> Points2D:
    y, x = np.mgrid[:rows, :columns]
    return np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
