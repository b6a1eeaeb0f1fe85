"""The corners of a board in a photo: found, made precise, judged one by one.

    candidates (finders of OpenCV)  →  orientation  →  fit of every corner to its pixels  →  corners that the finder
    missed, where markers tell them apart  →  gates

A corner stays only if its pixels show a crossing of the right colours near where it was sought, and if its neighbours
agree on where it is. All that go are named with the reason.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from calib.boards import Board
from calib.detect_circles import fit_circles, without_shifts
from calib.detect_crossings import Expectations, expectations, fit_crossings
from calib.detect_grids import Found, candidates
from calib.detect_neighbours import Affines, local_affines, predicted
from sfm.core.arrays import Mask, Points2D, Value, readonly
from sfm.core.errors import Rejected
from sfm.core.imaging.noise import noise_sigma

_ROUNDS_OF_COMPLETION = 8
_LARGEST_GAIN = 3.0
"""Corners that are sought without a marker are within or next to those that are known: errors of the neighbours are
amplified by no more than this. Farther out, something else would be found and agree with itself."""
_LEAST_BEND = 0.08
"""Of the distance of neighbours; at the edge of a fisheye image the best quadratic function is off by 0.06."""
_LEAST_NEIGHBOURS = 10
"""Corners that a board must have for these to say something about each other."""
_MEDIAN_LENGTH = 1.17741
"""Of a pair of unit normal numbers."""
_FLAT_PX = 0.5
"""Corners that are as near to each other as this are no board."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class DetectConfig:
    """How corners are found and judged."""

    window: float = 0.8
    """Semi-axis of the window by `Board.clear_radius_m`: 1 would touch the next print. For a chessboard it is 0.4
    squares; RMS of a calibration changes by 2 % between 0.3 and 0.45."""

    max_window_px: float = 12.0
    """Longest semi-axis of the window. Of 8, 12 and no limit 12 is best or within 2 % of it on four sets of photos."""

    max_jump: float = 0.25
    """A corner that moves by more of the distance to its neighbours when it is made precise was none."""

    max_misfit: float = 0.35
    """Residuals of a corner's pixels by its contrast: above, they show something else."""

    min_contrast: float = 0.2
    """Least contrast by the median of the board."""

    max_deviation: float = 0.05
    """A corner's standard deviation in its worst direction by the distance to its neighbours: above, its fit went
    astray, as when both edges become one."""

    max_bend: float = 6.0
    """Most deviation from where the neighbours want a corner, by the median deviation of the board's corners."""

    min_corners: int = 8
    """Fewer say nothing about distortion and little about the pose."""

    min_share: float = 0.6
    """Least share of corners of a board without markers: with fewer it is likely another pattern."""


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


@dataclasses.dataclass(slots=True)
class _Corners:
    """Corners under judgement, in order of their ids; those that fell stay, with a reason.

    `shapes` and `misfit` are those of `Crossings`, NaN for circles.
    """

    ids: Int64[np.ndarray, " N"]
    sought: Points2D
    points2D: Points2D
    covariances: Float64[np.ndarray, "N 2 2"]
    shapes: Float64[np.ndarray, "N 11"]
    misfit: Float64[np.ndarray, " N"]
    reasons: dict[int, str] = dataclasses.field(default_factory=dict)

    @property
    def kept(self) -> Mask:
        return np.array([int(number) not in self.reasons for number in self.ids], bool)

    def reject(self, bad: Mask, reason: str) -> None:
        for number in self.ids[bad]:
            self.reasons.setdefault(int(number), reason)


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
    best: _Corners | None = None
    best_finder = ""
    for found in candidates(grey, board):
        corners = _precise(grey, board, found, config)
        if corners is not None and (best is None or corners.kept.sum() > best.kept.sum()):
            best, best_finder = corners, found[0]
        if best is not None and best.kept.sum() == len(board.points3D):
            break
    if best is None:
        return Rejected("no_board", f"no finder sees {board.spec}")
    least = config.min_corners if board.has_markers else max(4, int(np.ceil(config.min_share * len(board.points3D))))
    kept = best.kept
    if kept.sum() < least:
        return Rejected("too_few_corners", f"{kept.sum()} of {len(board.points3D)} passed, {least} needed")
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


def _precise(grey: np.ndarray, board: Board, found: Found, config: DetectConfig) -> _Corners | None:
    """A finder's corners, fitted and judged; None where they do not even span a plane."""
    _, ids, points2D = found
    order = np.argsort(ids, kind="stable")
    ids, points2D = np.asarray(ids, np.int64)[order], points2D[order]
    inside = ((points2D > 0) & (points2D < [grey.shape[1], grey.shape[0]])).all(axis=1)
    ids, points2D = ids[inside], points2D[inside]
    try:
        affines = local_affines(_on_board(board, ids), points2D)
    except ValueError:
        return None
    if np.linalg.svd(affines, compute_uv=False)[:, 1].min() * board.clear_radius_m < _FLAT_PX:
        return None
    if board.has_circles:
        return _fitted_circles(grey, board, ids, points2D, affines, config)
    if board.kind == "chessboard":
        ids, points2D = _as_printed(grey, board, points2D, affines, config)
        affines = local_affines(_on_board(board, ids), points2D)
    corners = _fitted_crossings(grey, board, ids, points2D, affines, config)
    if board.has_markers:
        corners = _completed(grey, board, corners, config)
    return _by_neighbours(grey, board, corners, config)


def _on_board(board: Board, ids: np.ndarray) -> Points2D:
    return board.points3D[ids, :2]


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
        affines = local_affines(_on_board(board, ids), points2D)
    if (columns + rows) % 2:
        fitted = fit_crossings(grey, points2D, affines, config.window * board.clear_radius_m, config.max_window_px)
        if np.nansum(np.where(board.diagonal_is_black, 1, -1) * np.sign(fitted.contrast)) < 0:
            points2D = points2D[::-1].copy()
    return ids, points2D


def _fitted_crossings(
    grey: np.ndarray, board: Board, ids: np.ndarray, sought: Points2D, affines: Affines, config: DetectConfig,
    expected: Expectations | None = None,
) -> _Corners:  # fmt: skip
    """Corners near where they are sought, with a verdict on each."""
    starts = sought if expected is None else expected.shapes[:, :2]
    fitted = fit_crossings(grey, starts, affines, config.window * board.clear_radius_m, config.max_window_px, expected)
    corners = _Corners(ids, sought, np.array(fitted.points2D), fitted.covariances, fitted.shapes, fitted.misfit)
    corners.reject(np.isnan(fitted.misfit), "cut off, or no crossing")
    spacing = np.linalg.svd(affines, compute_uv=False)[:, 1] * 2 * board.clear_radius_m
    jumped = np.linalg.norm(fitted.points2D - sought, axis=1) > np.maximum(config.max_jump * spacing, 1.0)
    corners.reject(jumped, "jumped")
    worst = np.sqrt(np.linalg.norm(np.nan_to_num(fitted.covariances), 2, axis=(1, 2)))
    corners.reject(worst > config.max_deviation * spacing, "too uncertain")
    _judge_colours(board, corners, config)
    _judge_places(board, corners, config)
    return corners


def _judge_colours(board: Board, corners: _Corners, config: DetectConfig) -> None:
    """Contrast, its sign and what the model leaves of the pixels."""
    signed = np.where(board.diagonal_is_black[corners.ids], 1, -1) * corners.shapes[:, 6]
    if np.nansum(np.sign(signed)) < 0:  # the older ChArUco layout, or a board printed in reverse
        signed = -signed
    typical = np.nanmedian(np.abs(signed)) if np.isfinite(signed).any() else 0.0
    corners.reject(signed < 0, "black where white should be")
    corners.reject(np.abs(signed) < config.min_contrast * typical, "too little contrast")
    corners.reject(corners.misfit > config.max_misfit, "unlike a crossing")


def _judge_places(board: Board, corners: _Corners, config: DetectConfig) -> None:
    """Rejects the corner that its neighbours disagree with most, until none stands out."""
    while (kept := corners.kept).sum() > 4:
        known, points2D = _on_board(board, corners.ids[kept]), corners.points2D[kept]
        wanted, gain = predicted(known, known, points2D)
        off = np.linalg.norm(wanted - points2D, axis=1) / gain
        scale = np.median(np.linalg.svd(local_affines(known, points2D), compute_uv=False)) * 2 * board.clear_radius_m
        limit = max(config.max_bend * float(np.median(off)), _LEAST_BEND * scale, 0.5)
        if off.max() <= limit:
            return
        worst = np.zeros(len(kept), bool)
        worst[np.flatnonzero(kept)[np.argmax(off)]] = True
        corners.reject(worst, "off the grid of its neighbours")


def _completed(grey: np.ndarray, board: Board, corners: _Corners, config: DetectConfig) -> _Corners:
    """Adds corners whose markers were not read, where their neighbours say that they must be.

    What is not there after all fails the same gates; only corners that pass are added.
    """
    for _ in range(_ROUNDS_OF_COMPLETION):
        kept = corners.kept
        absent = np.setdiff1d(np.arange(len(board.points3D)), corners.ids[kept])
        if kept.sum() < config.min_corners or not len(absent):
            return corners
        known, points2D = _on_board(board, corners.ids[kept]), corners.points2D[kept]
        try:
            local_affines(known, points2D)
        except ValueError:
            return corners
        expected, gain = predicted(_on_board(board, absent), known, points2D)
        inside = (gain < _LARGEST_GAIN) & ((expected > 0) & (expected < [grey.shape[1], grey.shape[0]])).all(axis=1)
        ids = np.concatenate([corners.ids[kept], absent[inside]])
        order = np.argsort(ids)
        sought = np.concatenate([points2D, expected[inside]])[order]
        tried = _fitted_crossings(
            grey, board, ids[order], sought, local_affines(_on_board(board, ids[order]), sought), config
        )
        if tried.kept.sum() <= kept.sum():
            return corners
        is_old = np.isin(tried.ids, corners.ids)
        told = {number: reason for number, reason in tried.reasons.items() if number in set(tried.ids[is_old].tolist())}
        stays = tried.kept | is_old
        fields = (tried.ids, tried.sought, tried.points2D, tried.covariances, tried.shapes, tried.misfit)
        corners = _Corners(*(values[stays] for values in fields), reasons=told)
    return corners


def _by_neighbours(grey: np.ndarray, board: Board, corners: _Corners, config: DetectConfig) -> _Corners:
    """All corners fitted again with what their neighbours say of them, and judged anew."""
    kept = corners.kept
    if kept.sum() < _LEAST_NEIGHBOURS:
        return corners
    places = _on_board(board, corners.ids)
    wanted, gain = predicted(places, places[kept], corners.points2D[kept])
    errors_px = float(np.median((np.linalg.norm(wanted - corners.points2D, axis=1) / gain)[kept])) / _MEDIAN_LENGTH
    noise = float(np.median(np.abs(corners.misfit * corners.shapes[:, 6])[kept]))
    shapes = corners.shapes.copy()
    shapes[~kept] = np.nan
    shapes[~kept, :2] = np.where(gain[~kept, None] < _LARGEST_GAIN, wanted[~kept], corners.sought[~kept])
    expected = expectations(places, shapes, kept, (grey.shape[1], grey.shape[0]), errors_px, noise)
    return _fitted_crossings(
        grey, board, corners.ids, corners.sought, local_affines(places, shapes[:, :2]), config, expected
    )


def _fitted_circles(
    grey: np.ndarray, board: Board, ids: np.ndarray, points2D: Points2D, affines: Affines, config: DetectConfig
) -> _Corners:
    """Centres of circles near `points2D`, with a verdict on each."""
    noise = 255 * noise_sigma(np.ascontiguousarray(grey))
    centroids, covariances = fit_circles(grey, points2D, affines, board, noise)
    nothing = np.full(len(ids), np.nan)
    corners = _Corners(ids, points2D, centroids, covariances, np.full((len(ids), 11), np.nan), nothing)
    corners.reject(np.isnan(centroids[:, 0]), "cut off, or no circle")
    spacing = np.linalg.svd(affines, compute_uv=False)[:, 1] * board.pitch_m
    corners.reject(np.linalg.norm(centroids - points2D, axis=1) > np.maximum(config.max_jump * spacing, 1.0), "jumped")
    _judge_places(board, corners, config)
    kept = corners.kept
    if kept.sum() >= 4:
        corners.points2D = centroids.copy()
        corners.points2D[kept] = without_shifts(centroids[kept], _on_board(board, ids[kept]), board.detail_m / 2)
    return corners
