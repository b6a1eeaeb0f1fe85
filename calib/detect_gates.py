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
from calib.detect_neighbours import Affines, local_affines, predicted_through_lens
from calib.detect_places import LEAST_BEND, LEAST_BEND_PX, misplaced
from calib.detect_print import resemblances
from sfm.core.arrays import Mask, Points2D
from sfm.core.imaging.noise import noise_sigma

_LEAST_FOR_LENS = 6
"""Corners without which a plane before a lens, of nine parameters, fits anything."""
_FEW = 150
"""Corners up to which there is time to leave each out of the prediction of the others."""
_SUSPECTS = 8

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
    """Residuals of a corner's pixels less the noise of the photo, by its contrast: above, they show something else."""

    min_contrast: float = 0.2
    """Least contrast by the median of the board."""

    max_deviation: float = 0.05
    """A corner's standard deviation in its worst direction by the distance to its neighbours: above, its fit went
    astray, as when both edges become one."""

    max_turn_deg: float = 25.0
    """An edge of a crossing that is turned by more from where the neighbours of the corner lie is none of the board's:
    at the outer corners of the outer squares a fit finds two edges of its own. Photos of boards stay below 8."""

    min_resemblance: float = 0.35
    """Least correlation of the photo around a corner and what is printed there, for boards with markers: of corners it
    is 0.45 and more, where there is none -0.25 to 0.1."""

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

    def chosen(self, these: Mask) -> Corners:
        """A part of them, with what is held against it."""
        names = ("ids", "sought", "points2D", "covariances", "shapes", "misfit")
        stay = set(self.ids[these].tolist())
        reasons = {number: reason for number, reason in self.reasons.items() if number in stay}
        return Corners(*(getattr(self, name)[these] for name in names), reasons=reasons)

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
    """Corners near where they are sought, with a verdict on each, by itself and beside the others.

    Args: as `single_crossings`.
    """
    corners = single_crossings(grey, board, ids, sought, affines, config, expected)
    judge_together(grey, board, corners, config)
    return corners


def single_crossings(
    grey: np.ndarray, board: Board, ids: np.ndarray, sought: Points2D, affines: Affines, config: DetectConfig,
    expected: Expectations | None = None,
) -> Corners:  # fmt: skip
    """Corners near where they are sought, with a verdict on each by its own pixels.

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
    turned = _edges_turned_by(fitted.shapes[:, 2:4], affines)
    corners.reject(turned > np.radians(config.max_turn_deg), "edges that run otherwise")
    return corners


def _edges_turned_by(angles: Float64[np.ndarray, "N 2"], affines: Affines) -> Float64[np.ndarray, " N"]:
    """The greater turn of both edges against the board's lines, radians; of normals without a sign."""
    along = np.arctan2(affines[:, 0], -affines[:, 1])
    return np.abs((angles - along + np.pi / 2) % np.pi - np.pi / 2).max(axis=1)


def joined(first: Corners, second: Corners) -> Corners:
    """Corners of two lots, none of which is in both, in order of their ids."""
    order = np.argsort(np.concatenate([first.ids, second.ids]))
    names = ("ids", "sought", "points2D", "covariances", "shapes", "misfit")
    columns = (np.concatenate([getattr(first, name), getattr(second, name)])[order] for name in names)
    return Corners(*columns, reasons=first.reasons | second.reasons)


def judge_together(grey: np.ndarray, board: Board, corners: Corners, config: DetectConfig) -> None:
    """What corners of one board must have in common: colours, places on a smooth grid, the print around them."""
    _judge_colours(grey, board, corners, config)
    if board.has_markers:
        _judge_print(grey, board, corners, config)
    if board.has_markers and corners.kept.sum() <= _FEW:
        _judge_places_through_lens(board, corners, (grey.shape[1], grey.shape[0]), config)
    else:
        _judge_places(board, corners, config)


def _judge_print(grey: np.ndarray, board: Board, corners: Corners, config: DetectConfig) -> None:
    """Markers around a corner that are others than printed there, or none."""
    kept = np.flatnonzero(corners.kept)
    if len(kept) < 4 or np.linalg.matrix_rank(np.diff(on_board(board, corners.ids[kept]), axis=0), tol=1e-9) < 2:
        return
    found = np.full(len(corners.ids), np.nan)
    found[kept] = resemblances(grey, board, corners.ids[kept], corners.points2D[kept])
    corners.reject(found < config.min_resemblance, "other print around it")


def _judge_colours(grey: np.ndarray, board: Board, corners: Corners, config: DetectConfig) -> None:
    """Contrast, its sign and what the model and the noise of the photo leave of the pixels."""
    signed = np.where(board.diagonal_is_black[corners.ids], 1, -1) * corners.shapes[:, 6]
    if np.nansum(np.sign(signed)) < 0:  # the older ChArUco layout, or a board printed in reverse
        signed = -signed
    typical = np.nanmedian(np.abs(signed)) if np.isfinite(signed).any() else 0.0
    corners.reject(signed < 0, "black where white should be")
    corners.reject(np.abs(signed) < config.min_contrast * typical, "too little contrast")
    unlike = corners.misfit > config.max_misfit
    if unlike.any():
        left, contrast = corners.misfit * np.abs(signed), np.abs(signed)
        noise = min(255 * noise_sigma(np.ascontiguousarray(grey)), float(np.nanmedian(left)))
        unlike &= np.sqrt(np.maximum(left**2 - noise**2, 0)) > config.max_misfit * contrast
    corners.reject(unlike, "unlike a crossing")


def _judge_places(board: Board, corners: Corners, config: DetectConfig) -> None:
    """What neighbours say of the corners that are left."""
    bad = corners.kept
    bad[bad] = misplaced(
        on_board(board, corners.ids[bad]), corners.points2D[bad], board.clear_radius_m, config.max_bend
    )
    corners.reject(bad, "off the grid of its neighbours")


def _judge_places_through_lens(board: Board, corners: Corners, size: tuple[int, int], config: DetectConfig) -> None:
    """As `_judge_places`, for boards of which a few corners may be all that is seen.

    Of these each pulls the prediction of all others towards itself. So those that are farthest off are left out one
    by one, and the one that the rest contradicts most, by what the rest leaves of itself, is rejected.
    """
    while (kept := np.flatnonzero(corners.kept)).size > _LEAST_FOR_LENS:
        known, points2D = on_board(board, corners.ids[kept]), corners.points2D[kept]
        off = _off(known, known, points2D, points2D, size)
        scale = np.median(np.linalg.svd(local_affines(known, points2D), compute_uv=False)) * 2 * board.clear_radius_m
        least = max(LEAST_BEND * float(scale), LEAST_BEND_PX)
        if off.max() <= least:
            return
        worst, most = -1, 1.0
        for suspect in np.argsort(-off, kind="stable")[:_SUSPECTS]:
            rest = np.arange(len(kept)) != suspect
            others = known[rest], points2D[rest]
            typical = float(np.median(_off(known[rest], *others, points2D[rest], size)))
            own = float(_off(known[[suspect]], *others, points2D[[suspect]], size)[0])
            excess = own / max(config.max_bend * typical, least)
            if excess > most:
                worst, most = int(kept[suspect]), excess
        if worst < 0:
            return
        corners.reject(np.arange(len(corners.ids)) == worst, "off the grid of its neighbours")


def _off(
    targets: Points2D, known: np.ndarray, points2D: np.ndarray, seen: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """How far corners are from where others want them, by the gain of these; px."""
    wanted, gain = predicted_through_lens(targets, known, points2D, size)
    return np.nan_to_num(np.linalg.norm(wanted - seen, axis=1) / gain, nan=np.inf)


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
