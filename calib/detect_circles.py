"""Centres of circles to a fraction of a pixel.

The image of a circle is about an ellipse whose centroid is found from its darkness, pixel by pixel. But the centroid is
not the image of the circle's centre: perspective draws the near half larger, and lenses bend what is left. With f the
map from board to image, the centroid of the area inside f(rim) is known, and so is its difference from f(centre), which
is taken off. Of f this needs the curvature: it is that of a lens with one coefficient (`detect_plane`) which fits all
circles of the photo. What such a lens cannot say is redone where a camera is known; see `circle_shifts`.

Reference:
    Heikkilä, Geometric camera calibration using circular control points, PAMI 2000.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64, UInt8

from calib.boards import Board
from calib.detect_neighbours import Affines
from calib.detect_plane import fit_plane_closely
from sfm.core.arrays import Points2D

ImageOfBoard: TypeAlias = Callable[[Points2D], Points2D]
"""From (x, y) on the board in metres to px."""

_ROUNDS = 4
_DARK, _LIGHT = 0.25, 0.75
"""Between these parts of the contrast darkness is counted in proportion; beyond, noise has no say."""
_ROUNDING_VARIANCE = 1 / 12
_LEAST_CONTRAST = 12.0
_SAMPLING_PX = 0.007
"""Deviation that remains without noise, since pixels sample the rim coarsely: measured with a blur of 0.5 px."""
_RIM_POINTS = 64
_ROUNDS_OF_SHIFTS = 5
"""A shift changes by a hundredth when the points are shifted by it, by a tenth where a fisheye is widest."""
_MARGIN = 0.2
"""Of the blank up to the next circle, the part that belongs to the window; more may reach beyond the board's edge."""


def fit_circles(
    grey: UInt8[np.ndarray, "H W"], points2D: Points2D, affines: Affines, board: Board, noise: float
) -> tuple[Points2D, Float64[np.ndarray, "N 2 2"], Float64[np.ndarray, " N"]]:
    """Centroids of the dark ellipses near `points2D`, their covariances and their areas in px²; NaN where there is
    none.

    Args:
        affines: of the map from board to image at the circles.
        noise: standard deviation of the grey values, which reach from 0 to 255.
    """
    radius = board.detail_m / 2 + _MARGIN * (board.clear_radius_m - board.detail_m / 2)
    centres, covariances = np.full_like(points2D, np.nan), np.full((len(points2D), 2, 2), np.nan)
    areas = np.full(len(points2D), np.nan)
    for i, (point, affine) in enumerate(zip(points2D, affines, strict=True)):
        fitted = _centroid(grey, point, affine * radius, noise)
        if fitted is not None:
            centres[i], covariances[i], areas[i] = fitted
    return centres, covariances, areas


def with_dark_circles(
    grey: UInt8[np.ndarray, "H W"], points2D: Points2D, affines: Affines, board: Board
) -> UInt8[np.ndarray, "H W"]:
    """The photo, or its negative where circles are lighter than the blank around them."""
    around = np.arange(8) * (np.pi / 4)
    ring = (board.detail_m / 2 + board.clear_radius_m) / 2
    blank = points2D[:, None] + np.einsum(
        "nij,kj->nki", affines, ring * np.column_stack([np.cos(around), np.sin(around)])
    )
    most = np.array([grey.shape[1], grey.shape[0]]) - 1

    def at(points: np.ndarray) -> np.ndarray:
        x, y = np.moveaxis(np.clip(points.astype(int), 0, most), -1, 0)
        return grey[y, x].astype(np.float64)

    return 255 - grey if np.median(at(points2D) - np.median(at(blank), axis=1)) > 0 else grey


def centroid_shifts(image: ImageOfBoard, board_points: Points2D, radius_m: float) -> Points2D:
    """Centroid of each disc's image less the image of its centre, in px.

    Discs are polygons of `_RIM_POINTS` corners with the discs' moments of inertia by their areas, so that centroids are
    those of the discs up to the fourth order.
    """
    rims = _rims(image, board_points, radius_m)
    after, areas = np.roll(rims, -1, axis=1), _doubled_areas(rims)
    return ((rims + after) * areas[..., None]).sum(axis=1) / (3 * areas.sum(axis=1))[:, None]


def areas_by_one_lens(
    points2D: Points2D, board_points: Points2D, radius_m: float, size: tuple[int, int]
) -> Float64[np.ndarray, " N"]:
    """Areas of the discs' images in px², by the lens with one coefficient that fits them best."""
    rims = _rims(fit_plane_closely(board_points, points2D, size).image, board_points, radius_m)
    return np.abs(_doubled_areas(rims).sum(axis=1)) / 2


def _rims(image: ImageOfBoard, board_points: Points2D, radius_m: float) -> np.ndarray:
    """Corners (N, `_RIM_POINTS`, 2) of the polygons in the image, from the images of the centres."""
    step = 2 * np.pi / _RIM_POINTS
    around, reach_m = step * np.arange(_RIM_POINTS), radius_m * np.sqrt(3 / (2 + np.cos(step)))
    rims = board_points[:, None] + reach_m * np.stack([np.cos(around), np.sin(around)], axis=1)
    return image(rims.reshape(-1, 2)).reshape(*rims.shape) - image(board_points)[:, None]


def _doubled_areas(rims: np.ndarray) -> np.ndarray:
    """Twice the signed areas of the triangles of each edge with the centre."""
    after = np.roll(rims, -1, axis=1)
    return rims[..., 0] * after[..., 1] - rims[..., 1] * after[..., 0]


def without_shifts(points2D: Points2D, board_points: Points2D, radius_m: float, size: tuple[int, int]) -> Points2D:
    """Images of the circles' centres from centroids of their images.

    Args:
        size: width and height of the image, px.
    """
    centres = points2D
    for _ in range(_ROUNDS_OF_SHIFTS):
        centres = points2D - shifts_by_one_lens(centres, board_points, radius_m, size)
    return centres


def shifts_by_one_lens(centres: Points2D, board_points: Points2D, radius_m: float, size: tuple[int, int]) -> Points2D:
    """What `without_shifts` has taken off if these are the images of the centres that it gave; zero where unknown."""
    if len(board_points) < 4:
        return np.zeros_like(centres)
    shifts = centroid_shifts(fit_plane_closely(board_points, centres, size).image, board_points, radius_m)
    return np.where(np.isfinite(shifts), shifts, 0.0)


def _centroid(
    grey: UInt8[np.ndarray, "H W"], point: np.ndarray, semi_axes: np.ndarray, noise: float
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Centroid of the darkness in an ellipse that follows it, its covariance, and the darkness in px²."""
    centre, inverse = point, np.linalg.inv(semi_axes)
    reach = np.linalg.norm(semi_axes, axis=1)
    weight = offset = slope = np.empty(0)
    for _ in range(_ROUNDS):
        low, high = np.floor(centre - reach).astype(int), np.ceil(centre + reach).astype(int)
        if (low < 0).any() or (high[::-1] > grey.shape).any():
            return None
        y, x = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
        offset = np.stack([x - centre[0], y - centre[1]], axis=2)
        inside = (np.square(offset @ inverse.T).sum(axis=2)) <= 1
        values, offset = grey[low[1] : high[1], low[0] : high[0]][inside].astype(np.float64), offset[inside]
        if len(values) < 12:
            return None
        dark, light = np.percentile(values, [5, 95])
        if light - dark < _LEAST_CONTRAST:
            return None
        lightness = ((values - dark) / (light - dark) - _DARK) / (_LIGHT - _DARK)
        weight = 1 - np.clip(lightness, 0, 1)
        slope = ((lightness > 0) & (lightness < 1)) / ((_LIGHT - _DARK) * (light - dark))
        step = weight @ offset / weight.sum()
        centre = centre + step
        if np.abs(step).max() < 1e-4:
            break
    spread = (offset * slope[:, None]) / weight.sum()
    covariance = (noise**2 + _ROUNDING_VARIANCE) * spread.T @ spread + _SAMPLING_PX**2 * np.eye(2)
    return centre, covariance, float(weight.sum())
