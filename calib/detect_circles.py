"""Centres of circles to a fraction of a pixel.

The image of a circle is an ellipse whose centroid is found from its darkness, pixel by pixel. But the centroid of the
ellipse is not the image of the circle's centre: perspective draws the near half larger. With C the circle as a dual
conic and H the map from board to image, the ellipse is H C Hᵀ, and the last column of it is its centre; so the
difference from the image of the circle's centre is known and taken off.

Reference:
    Hartley & Zisserman, Multiple View Geometry, 2nd ed., result 2.14 (dual conics).
    Heikkilä, Geometric camera calibration using circular control points, PAMI 2000.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from calib.boards import Board
from calib.detect_neighbours import Affines
from sfm.core.arrays import Matrix3, Points2D

_ROUNDS = 4
_DARK, _LIGHT = 0.25, 0.75
"""Between these parts of the contrast darkness is counted in proportion; beyond, noise has no say."""
_ROUNDING_VARIANCE = 1 / 12
_LEAST_CONTRAST = 12.0
_SAMPLING_PX = 0.007
"""Deviation that remains without noise, since pixels sample the rim coarsely: measured with a blur of 0.5 px."""
_NEIGHBOURS = 12
_MARGIN = 0.2
"""Of the blank up to the next circle, the part that belongs to the window; more may reach beyond the board's edge."""


def fit_circles(
    grey: UInt8[np.ndarray, "H W"], points2D: Points2D, affines: Affines, board: Board, noise: float
) -> tuple[Points2D, Float64[np.ndarray, "N 2 2"]]:
    """Centroids of the dark ellipses near `points2D` and their covariances in px²; NaN where there is none.

    Args:
        affines: of the map from board to image at the circles.
        noise: standard deviation of the grey values, which reach from 0 to 255.
    """
    radius = board.detail_m / 2 + _MARGIN * (board.clear_radius_m - board.detail_m / 2)
    centres, covariances = np.full_like(points2D, np.nan), np.full((len(points2D), 2, 2), np.nan)
    for i, (point, affine) in enumerate(zip(points2D, affines, strict=True)):
        fitted = _centroid(grey, point, affine * radius, noise)
        if fitted is not None:
            centres[i], covariances[i] = fitted
    return centres, covariances


def centre_shifts(board_points: Points2D, radius_m: float, image_from_board: Matrix3) -> Points2D:
    """Centroid of each ellipse less the image of the circle's centre, in px."""
    x, y = board_points.T
    one = np.ones_like(x)
    conics = np.array([[x * x - radius_m**2, x * y, x], [x * y, y * y - radius_m**2, y], [x, y, one]])
    last_column = np.einsum("ij,jkn,k->in", image_from_board, conics, image_from_board[2])
    centre = image_from_board @ np.stack([x, y, one])
    return (last_column[:2] / last_column[2] - centre[:2] / centre[2]).T


def without_shifts(points2D: Points2D, board_points: Points2D, radius_m: float) -> Points2D:
    """Images of the circles' centres from centroids of their images.

    Perspective is taken off by the homography that fits all circles; what the lens bends beyond it, by the difference
    of the second-order shifts of what is seen and of the homography's own picture of it.
    """
    centres = points2D
    for _ in range(2):
        homography, _ = cv2.findHomography(board_points, centres)
        if homography is None:
            return points2D
        flat = np.column_stack([board_points, np.ones(len(board_points))]) @ homography.T
        bent = curvature_shifts(board_points, centres, radius_m)
        bent -= curvature_shifts(board_points, flat[:, :2] / flat[:, 2:], radius_m)
        centres = points2D - centre_shifts(board_points, radius_m, homography) - bent
    return centres


def curvature_shifts(board_points: Points2D, points2D: Points2D, radius_m: float) -> Points2D:
    """Centroid of the image of each disc less the image of its centre, to second order in the radius, for any lens.

    With f the map from board to image and J its Jacobian, the centroid is  f + r²/8 ∇²f + r²/4 J ∇ log det J; the
    derivatives are those of a quadratic function through the nearest neighbours. Zero where there are few.
    """
    if len(board_points) < _NEIGHBOURS:
        return np.zeros_like(points2D)
    offset = board_points[None] - board_points[:, None]
    order = np.argsort(np.linalg.norm(offset, axis=2), axis=1, kind="stable")[:, :_NEIGHBOURS]
    x, y = np.moveaxis(np.take_along_axis(offset, order[:, :, None], 1) / radius_m, 2, 0)
    design = np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=2)
    _, fx, fy, fxx, fxy, fyy = np.moveaxis(np.linalg.pinv(design, rcond=1e-4) @ points2D[order], 1, 0)
    determinant = _cross(fx, fy)
    along_x = (_cross(fxx, fy) + _cross(fx, fxy)) / determinant
    along_y = (_cross(fxy, fy) + _cross(fx, fyy)) / determinant
    return (fxx + fyy) / 8 + (fx * along_x[:, None] + fy * along_y[:, None]) / 4


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _centroid(
    grey: UInt8[np.ndarray, "H W"], point: np.ndarray, semi_axes: np.ndarray, noise: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Centroid of the darkness in an ellipse that follows it, and its covariance."""
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
    return centre, (noise**2 + _ROUNDING_VARIANCE) * spread.T @ spread + _SAMPLING_PX**2 * np.eye(2)
