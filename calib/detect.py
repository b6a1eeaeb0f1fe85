"""The corners of a board in a photo: found, made precise, judged one by one.

    candidates (finders of OpenCV)  →  orientation  →  fit of every corner to its pixels  →  corners that the finder
    missed, where markers tell them apart  →  gates

See `detect_gates` for what a corner must pass to stay.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from calib.boards import Board
from calib.detect_crossings import expectations, fit_crossings
from calib.detect_gates import (
    Corners,
    DetectConfig,
    fitted_circles,
    fitted_crossings,
    joined,
    judge_together,
    on_board,
    single_crossings,
)
from calib.detect_grids import Found, candidates
from calib.detect_lines import absent_lines, moved
from calib.detect_neighbours import Affines, local_affines, predicted, predicted_through_lens
from sfm.core.arrays import Points2D, Value, readonly
from sfm.core.errors import Rejected

_ROUNDS_OF_COMPLETION = 24
_LEAST_TO_START = 4
"""Corners to complete a board from, those of one tag."""
_LARGEST_GAIN = 3.0
"""Corners that are sought without a marker are within or next to those that are known: errors of the neighbours are
amplified by no more than this. Farther out, something else would be found and agree with itself."""
_LEAST_NEIGHBOURS = 10
"""Corners that a board must have for these to say something about each other."""
_MEDIAN_LENGTH = 1.17741
"""Of a pair of unit normal numbers."""
_FLAT_PX = 0.5
"""Corners that are as near to each other as this are no board."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Detection(Value):
    """The corners of a board in one image.

    Attributes:
        corner_ids: rows of `Board.points3D`, ascending.
        points2D: px; the centre of the first pixel is (0.5, 0.5).
        covariances: px², from the residuals of each corner's pixels. What all corners of a neighbourhood have in
            common (bent paper, distortion within the window) is not in it.
        rejected: the reason for each corner that was found but did not stay, by its id, ascending.
        rejected2D: where these were sought.
        finder: which finder saw the board.
        blur_px: median standard deviation of the blur of the edges; NaN for circles.
    """

    name: str
    width: int
    height: int
    corner_ids: Int64[np.ndarray, " N"]
    points2D: Points2D
    covariances: Float64[np.ndarray, "N 2 2"]
    rejected: Mapping[int, str] = dataclasses.field(default_factory=dict)
    rejected2D: Float64[np.ndarray, "R 2"] = dataclasses.field(default_factory=lambda: np.empty((0, 2)))
    finder: str = ""
    blur_px: float = float("nan")

    def __post_init__(self) -> None:
        count = len(self.corner_ids)
        object.__setattr__(self, "corner_ids", readonly(self.corner_ids, (count,), np.int64))
        object.__setattr__(self, "points2D", readonly(self.points2D, (count, 2)))
        object.__setattr__(self, "covariances", readonly(self.covariances, (count, 2, 2)))
        object.__setattr__(self, "rejected", MappingProxyType(dict(sorted(self.rejected.items()))))
        object.__setattr__(self, "rejected2D", readonly(self.rejected2D, (len(self.rejected), 2)))


def detect_board(
    grey: UInt8[np.ndarray, "H W"], board: Board, config: DetectConfig = DetectConfig(), *, name: str = ""
) -> Detection | Rejected:
    """Finds a board in a photo.

    Finders are asked in turn until one sees the whole board and all its corners pass; else the best is taken.

    Args:
        name: of the image, for the result.
    Returns:
        The corners that passed, or why there are too few: `no_board` (no finder saw one) or `too_few_corners`.
    """
    best: Corners | None = None
    best_finder = ""
    for found in candidates(grey, board):
        corners = _precise(grey, board, found, config)
        if corners is not None and board.kind == "chessboard":
            corners = _with_all_lines(grey, board, corners, config)
        if corners is not None and (best is None or corners.kept.sum() > best.kept.sum()):
            best, best_finder = corners, found[0]
        if best is not None and best.kept.sum() == len(board.points3D):
            break
    if best is None:
        return Rejected("no_board", f"no finder sees {board.spec}")
    least = config.min_corners if board.has_markers else max(4, int(np.ceil(config.min_share * len(board.points3D))))
    kept = best.kept
    if kept.sum() < least:
        return Rejected("too_few_corners", _too_few(board, best, least))
    blur = best.shapes[kept, 4]
    return Detection(
        name,
        grey.shape[1],
        grey.shape[0],
        best.ids[kept],
        best.points2D[kept],
        best.covariances[kept],
        best.reasons,
        best.sought[~kept],
        best_finder,
        float(np.median(blur)) if np.isfinite(blur).any() else float("nan"),
    )


def _too_few(board: Board, corners: Corners, least: int) -> str:
    """How many corners passed, and why the others did not, the most frequent reason first."""
    told = f"{corners.kept.sum()} of {len(board.points3D)} passed, {least} needed"
    counts = Counter(corners.reasons[number] for number in sorted(corners.reasons))
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts.most_common())
    return f"{told}; rejected: {reasons}" if reasons else told


def _precise(grey: np.ndarray, board: Board, found: Found, config: DetectConfig) -> Corners | None:
    """A finder's corners, fitted and judged; None where they do not even span a plane."""
    _, ids, points2D = found
    order = np.argsort(ids, kind="stable")
    ids, points2D = np.asarray(ids, np.int64)[order], points2D[order]
    if board.kind != "chessboard":  # whose order tells which corner is which, so that all are kept for now
        inside = ((points2D > 0) & (points2D < [grey.shape[1], grey.shape[0]])).all(axis=1)
        ids, points2D = ids[inside], points2D[inside]
    try:
        affines = local_affines(on_board(board, ids), points2D)
    except ValueError:
        return None
    if np.linalg.svd(affines, compute_uv=False)[:, 1].min() * board.clear_radius_m < _FLAT_PX:
        return None
    if board.has_circles:
        return fitted_circles(grey, board, ids, points2D, affines, config)
    if board.kind == "chessboard":
        ids, points2D = _as_printed(grey, board, points2D, affines, config)
        affines = local_affines(on_board(board, ids), points2D)
    corners = fitted_crossings(grey, board, ids, points2D, affines, config)
    if board.has_markers:
        corners = _completed(grey, board, corners, config)
    return _by_neighbours(grey, board, corners, config)


def _with_all_lines(grey: np.ndarray, board: Board, corners: Corners, config: DetectConfig) -> Corners:
    """A chessboard as it is read if it has an outer line where the finder has put none."""
    for step, line in absent_lines(board, corners):
        found = moved(board, corners, step, line)
        other = _precise(grey, board, found, config) if found is not None else None
        if other is not None and not any(True for _ in absent_lines(board, other)):
            return other
    return corners


def _as_printed(
    grey: np.ndarray, board: Board, points2D: Points2D, affines: Affines, config: DetectConfig
) -> tuple[np.ndarray, Points2D]:
    """Ids of a chessboard's corners such that x, y run as on the print and the square before the first is black.

    Finders may see the board from its back, or start at the opposite end. Colours tell the ends apart if the number
    of rows is odd and that of columns even or the other way round; otherwise the board itself has no first corner.
    """
    columns, rows = board.grid
    ids = np.arange(len(points2D))
    if np.median(np.linalg.det(affines)) < 0:
        points2D = points2D[ids.reshape(rows, columns)[:, ::-1].reshape(-1)]
        affines = local_affines(on_board(board, ids), points2D)
    if (columns + rows) % 2:
        fitted = fit_crossings(grey, points2D, affines, config.window * board.clear_radius_m, config.max_window_px)
        if np.nansum(np.where(board.diagonal_is_black, 1, -1) * np.sign(fitted.contrast)) < 0:
            points2D = points2D[::-1].copy()
    return ids, points2D


def _completed(grey: np.ndarray, board: Board, corners: Corners, config: DetectConfig) -> Corners:
    """Adds corners whose markers were not read, where their neighbours say that they must be.

    What is not there after all fails the same gates; only corners that pass are added.
    """
    size = (grey.shape[1], grey.shape[0])
    for _ in range(_ROUNDS_OF_COMPLETION):
        kept = corners.kept
        absent = np.setdiff1d(np.arange(len(board.points3D)), corners.ids[kept])
        if kept.sum() < _LEAST_TO_START or not len(absent):
            return corners
        known, points2D = on_board(board, corners.ids[kept]), corners.points2D[kept]
        try:
            local_affines(known, points2D)
        except ValueError:
            return corners
        expected, gain = predicted_through_lens(on_board(board, absent), known, points2D, size)
        inside = (gain < _LARGEST_GAIN) & ((expected > 0) & (expected < size)).all(axis=1)
        if not inside.any():
            return corners
        places = np.concatenate([known, on_board(board, absent[inside])])
        affines = local_affines(places, np.concatenate([points2D, expected[inside]]))[len(known) :]
        tried = single_crossings(grey, board, absent[inside], expected[inside], affines, config)
        new = tried.chosen(tried.kept)
        if not len(new.ids):
            return corners
        again = joined(corners.chosen(~np.isin(corners.ids, new.ids)), new)
        judge_together(grey, board, again, config)
        is_old = np.isin(again.ids, corners.ids)
        if again.kept.sum() <= kept.sum():
            return corners
        corners = again.chosen(again.kept | is_old)
    return corners


def _by_neighbours(grey: np.ndarray, board: Board, corners: Corners, config: DetectConfig) -> Corners:
    """All corners fitted again with what their neighbours say of them, and judged anew."""
    kept = corners.kept
    if kept.sum() < _LEAST_NEIGHBOURS:
        return corners
    places = on_board(board, corners.ids)
    wanted, gain = predicted(places, places[kept], corners.points2D[kept])
    errors_px = float(np.median((np.linalg.norm(wanted - corners.points2D, axis=1) / gain)[kept])) / _MEDIAN_LENGTH
    noise = float(np.median(np.abs(corners.misfit * corners.shapes[:, 6])[kept]))
    shapes = corners.shapes.copy()
    shapes[~kept] = np.nan
    shapes[~kept, :2] = np.where(gain[~kept, None] < _LARGEST_GAIN, wanted[~kept], corners.sought[~kept])
    expected = expectations(places, shapes, kept, (grey.shape[1], grey.shape[0]), errors_px, noise)
    return fitted_crossings(
        grey, board, corners.ids, corners.sought, local_affines(places, shapes[:, :2]), config, expected
    )
