"""Corners near where they are sought: fitted to their pixels, and judged one by one.

A corner stays only if its pixels show a crossing of the right colours near where it was sought, and if its neighbours
agree on where it is. All that go are named with the reason.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float64, Int64

from calib.boards import Board
from calib.detect_circles import areas_by_one_lens, fit_circles, with_dark_circles, without_shifts
from calib.detect_crossings import Expectations, fit_crossings
from calib.detect_neighbours import Affines, local_affines, predicted
from sfm.core.arrays import Mask, Points2D
from sfm.core.imaging.noise import noise_sigma

_LEAST_BEND = 0.08
"""Of the distance of neighbours; at the edge of a fisheye image the best quadratic function is off by 0.06."""

_ODD_AREA = 0.2
"""Of the median by what the board says: circles that are partly covered are off by less than neighbours can tell."""


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


@dataclasses.dataclass(slots=True)
class Corners:
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
        """Those without a reason against them."""
        return np.array([int(number) not in self.reasons for number in self.ids], bool)

    def reject(self, bad: Mask, reason: str) -> None:
        """Notes why these fall; of several reasons the first counts."""
        for number in self.ids[bad]:
            self.reasons.setdefault(int(number), reason)


def on_board(board: Board, ids: np.ndarray) -> Points2D:
    """Where corners lie on the flat board, metres."""
    return board.points3D[ids, :2]


def fitted_crossings(
    grey: np.ndarray, board: Board, ids: np.ndarray, sought: Points2D, affines: Affines, config: DetectConfig,
    expected: Expectations | None = None,
) -> Corners:  # fmt: skip
    """Corners near where they are sought, with a verdict on each.

    Args:
        sought: px; what a corner must not move far from.
        affines: from metres on the board to px, at each corner.
        expected: what the neighbours say of each, to start from and to hold the fit by.
    """
    starts = sought if expected is None else expected.shapes[:, :2]
    fitted = fit_crossings(grey, starts, affines, config.window * board.clear_radius_m, config.max_window_px, expected)
    corners = Corners(ids, sought, np.array(fitted.points2D), fitted.covariances, fitted.shapes, fitted.misfit)
    corners.reject(np.isnan(fitted.misfit), "cut off, or no crossing")
    spacing = np.linalg.svd(affines, compute_uv=False)[:, 1] * 2 * board.clear_radius_m
    jumped = np.linalg.norm(fitted.points2D - sought, axis=1) > np.maximum(config.max_jump * spacing, 1.0)
    corners.reject(jumped, "jumped")
    worst = np.sqrt(np.linalg.norm(np.nan_to_num(fitted.covariances), 2, axis=(1, 2)))
    corners.reject(worst > config.max_deviation * spacing, "too uncertain")
    _judge_colours(board, corners, config)
    _judge_places(board, corners, config)
    return corners


def _judge_colours(board: Board, corners: Corners, config: DetectConfig) -> None:
    """Contrast, its sign and what the model leaves of the pixels."""
    signed = np.where(board.diagonal_is_black[corners.ids], 1, -1) * corners.shapes[:, 6]
    if np.nansum(np.sign(signed)) < 0:  # the older ChArUco layout, or a board printed in reverse
        signed = -signed
    typical = np.nanmedian(np.abs(signed)) if np.isfinite(signed).any() else 0.0
    corners.reject(signed < 0, "black where white should be")
    corners.reject(np.abs(signed) < config.min_contrast * typical, "too little contrast")
    corners.reject(corners.misfit > config.max_misfit, "unlike a crossing")


def _judge_places(board: Board, corners: Corners, config: DetectConfig) -> None:
    """Rejects the corner that its neighbours disagree with most, until none stands out."""
    while (kept := corners.kept).sum() > 4:
        known, points2D = on_board(board, corners.ids[kept]), corners.points2D[kept]
        wanted, gain = predicted(known, known, points2D)
        off = np.linalg.norm(wanted - points2D, axis=1) / gain
        scale = np.median(np.linalg.svd(local_affines(known, points2D), compute_uv=False)) * 2 * board.clear_radius_m
        limit = max(config.max_bend * float(np.median(off)), _LEAST_BEND * scale, 0.5)
        if off.max() <= limit:
            return
        worst = np.zeros(len(kept), bool)
        worst[np.flatnonzero(kept)[np.argmax(off)]] = True
        corners.reject(worst, "off the grid of its neighbours")


def fitted_circles(
    grey: np.ndarray, board: Board, ids: np.ndarray, points2D: Points2D, affines: Affines, config: DetectConfig
) -> Corners:
    """Centres of circles near `points2D`, with a verdict on each."""
    noise = 255 * noise_sigma(np.ascontiguousarray(grey))
    grey = with_dark_circles(grey, points2D, affines, board)
    centroids, covariances, areas = fit_circles(grey, points2D, affines, board, noise)
    nothing = np.full(len(ids), np.nan)
    corners = Corners(ids, points2D, centroids, covariances, np.full((len(ids), 11), np.nan), nothing)
    corners.reject(np.isnan(centroids[:, 0]), "cut off, or no circle")
    spacing = np.linalg.svd(affines, compute_uv=False)[:, 1] * board.pitch_m
    corners.reject(np.linalg.norm(centroids - points2D, axis=1) > np.maximum(config.max_jump * spacing, 1.0), "jumped")
    size, kept = (grey.shape[1], grey.shape[0]), corners.kept
    if kept.sum() >= 4:
        expected = areas_by_one_lens(centroids[kept], on_board(board, ids[kept]), board.detail_m / 2, size)
        areas[kept] /= expected
        odd = np.abs(areas / np.median(areas[kept]) - 1) > _ODD_AREA
        corners.reject(kept & odd, "not the size of a circle")
    _judge_places(board, corners, config)
    kept = corners.kept
    if kept.sum() >= 4:
        corners.points2D = centroids.copy()
        corners.points2D[kept] = without_shifts(centroids[kept], on_board(board, ids[kept]), board.detail_m / 2, size)
    return corners
