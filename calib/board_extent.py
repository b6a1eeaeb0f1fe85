"""Whether a photo shows a board of another size than the one that was found in it.

A finder that is asked for fewer columns or rows than there are takes a part of the board, and one that is asked for
more may take corners of the outermost squares for crossings. Both look like a board that was found. The print tells:
around the corners of a chessboard there is one more ring of squares that alternate, and no second one. In 141 photos of
eight sets the mean difference of neighbours in these rings is 0.8 to 1.05 and below 0.35 of that within. Around a grid
of circles there are none; what is darker than its surroundings at the places of further circles is one of them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, UInt8

from calib.boards import Board
from calib.detect_neighbours import predicted
from calib.refine_views import BoardView
from sfm.core.arrays import Points2D, Vector

_ALTERNATES, _DOES_NOT = 0.6, 0.3
"""Mean difference of neighbouring squares, by that of squares within, from which on, and up to which, it is clear."""
_PATCH, _CLOSE = 0.1, 0.25
"""Of a square: where it is looked at, beside its middle, in the four directions; and how far from their corners the
outer ones are, which may be cut narrow."""
_BEYOND = 2
"""Lines of circles that are looked for beyond each side."""
_IN_CIRCLE = 0.5
"""Of the radius, where a circle is looked at."""
_DIRECTIONS = np.array([[np.cos(a), np.sin(a)] for a in np.arange(8) * np.pi / 4])
_FEWEST, _MOSTLY = 3, 0.75
"""Photos that tell, and part of them that must agree, for the size to be certain."""


@dataclasses.dataclass(frozen=True, slots=True)
class ShownSize:
    """Columns and rows as `Board` counts them, and how many of the photos that tell show them."""

    columns: int
    rows: int
    count: int
    total: int

    @property
    def is_certain(self) -> bool:
        """Whether most photos, and more than two, agree."""
        return self.count >= _FEWEST and self.count >= _MOSTLY * self.total


def size_that_is_shown(board: Board, photos: Sequence[tuple[UInt8[np.ndarray, "_ _"], BoardView]]) -> ShownSize | None:
    """The columns, and the rows, that more than half of the photos show; None if it is the board, or cannot be told.

    Args:
        board: that was found in the photos; of boards with markers nothing need be said.
    """
    if board.has_markers:
        return None
    in_photo = _of_circles if board.has_circles else _of_squares
    told = [size for size in (in_photo(grey, board, seen) for grey, seen in photos) if size is not None]
    sides = [
        [side for side in sorted(set(sides)) if sides.count(side) > len(told) / 2] for sides in zip(*told, strict=True)
    ]
    if not told or not all(sides) or (sides[0][0], sides[1][0]) == board.grid:
        return None
    size = sides[0][0], sides[1][0]
    return ShownSize(*size, told.count(size), len(told))


def _of_squares(grey: UInt8[np.ndarray, "H W"], board: Board, seen: BoardView) -> tuple[int, int] | None:
    """None where nothing can be told; sides that are not in the photo, or undecided, are taken for right."""
    columns, rows = board.grid
    x, y = np.meshgrid(np.arange(-2, columns + 1), np.arange(-2, rows + 1))
    places = np.column_stack([_looked_at(columns)[x + 2].ravel(), _looked_at(rows)[y + 2].ravel()])
    bright = _brightness(grey, board, seen, places).reshape(x.shape)
    bright *= np.where((x + y) % 2 == 0, 1.0, -1.0)
    usual = np.nanmedian(_differences(bright[2:-2, 2:-2]))
    if not abs(usual) > 0:
        return None
    sizes = [columns, rows]
    for axis, grid in enumerate((bright.T, bright)):
        sizes[axis] += _change(grid[:2], usual) + _change(grid[:-3:-1], usual)
    return sizes[0], sizes[1]


def _looked_at(corners: int) -> Vector:
    """Where squares are looked at, in squares from the first corner: the rings close to their corners."""
    within = np.arange(corners - 1) + 0.5
    return np.concatenate([[-1 - _CLOSE, -_CLOSE], within, [corners - 1 + _CLOSE, corners + _CLOSE]])


def _change(rings: Float64[np.ndarray, "2 K"], usual: float) -> int:
    """By how many lines the board is larger at one side: by the second ring beyond its corners, and the first one."""
    second, first = (_clear_mean(_differences(ring[None, 2:-2])) / usual for ring in rings)
    if first > _ALTERNATES and second > _ALTERNATES:
        return 1
    return -1 if first < _DOES_NOT else 0


def _clear_mean(values: Vector) -> float:
    """NaN where most of the values are."""
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if 2 * len(known) > len(values) else math.nan


def _differences(bright: Float64[np.ndarray, "R C"]) -> Vector:
    """Of neighbours in a row, whose signs alternate with the squares: twice the contrast where there are squares."""
    return (bright[:, 1:] + bright[:, :-1]).ravel()


def _brightness(grey: UInt8[np.ndarray, "H W"], board: Board, seen: BoardView, places: Points2D) -> Vector:
    """(N,) of squares at places given in squares from the first corner; NaN outside the photo."""
    steps = _PATCH * np.array([[0.0, 0.0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
    return _looked_up(grey, board, seen, places, steps).mean(axis=1)


def _of_circles(grey: UInt8[np.ndarray, "H W"], board: Board, seen: BoardView) -> tuple[int, int] | None:
    """As `_of_squares`; a line of circles beyond the ones that were found may be followed by a second one."""
    columns, rows = board.grid
    column, row = np.meshgrid(np.arange(-_BEYOND, columns + _BEYOND), np.arange(-_BEYOND, rows + _BEYOND))
    staggered = board.kind == "acircles"
    places = np.column_stack([(2 * column + row % 2 if staggered else column).ravel(), row.ravel()]).astype(np.float64)
    radius, blank = board.detail_m / 2 / board.pitch_m, board.clear_radius_m / board.pitch_m
    inside = _looked_up(grey, board, seen, places, _IN_CIRCLE * radius * _DIRECTIONS).mean(axis=1)
    outside = np.array(
        [_clear_mean(part) for part in _looked_up(grey, board, seen, places, (radius + blank) / 2 * _DIRECTIONS)]
    )
    contrast = (outside - inside).reshape(column.shape)
    within = slice(_BEYOND, -_BEYOND)
    usual = float(np.nanmedian(contrast[within, within]))
    if not usual:
        return None
    contrast, usual = contrast * np.sign(usual), abs(usual)  # light circles on black as well
    sizes = [columns, rows]
    for axis, grid in enumerate((contrast.T, contrast)):
        for lines in (grid[:_BEYOND][::-1], grid[-_BEYOND:]):
            there = [_clear_mean(line[within]) > _ALTERNATES * usual for line in lines]
            sizes[axis] += [*there, False].index(False)
    return sizes[0], sizes[1]


def _looked_up(
    grey: UInt8[np.ndarray, "H W"],
    board: Board,
    seen: BoardView,
    places: Float64[np.ndarray, "N 2"],
    steps: Float64[np.ndarray, "S 2"],
) -> Float64[np.ndarray, "N S"]:
    """The pixels at so many steps from places, all by `Board.pitch_m`; NaN outside the photo."""
    asked = (places[:, None] + steps).reshape(-1, 2) * board.pitch_m
    pixels, _ = predicted(asked, board.points3D[seen.corner_ids, :2], seen.points2D)
    at = np.floor(pixels).astype(int)
    inside = ((at >= 0) & (at < [grey.shape[1], grey.shape[0]])).all(axis=1)
    values = np.full(len(at), np.nan)
    values[inside] = grey[at[inside, 1], at[inside, 0]]
    return values.reshape(-1, len(steps))
