"""Corners of squares to a fraction of a pixel: every crossing of two edges is fitted to its pixels.

The window is an ellipse: what a disc on the board looks like in the image. It holds nothing but the two edges of its
own corner, as large as that allows, in every image and at every corner: a square window of fixed size takes in
parts of the neighbours where the board is far or oblique.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float64, UInt8

from calib import _detect_kernels
from calib.detect_neighbours import Affines
from sfm.core.arrays import Points2D, Value, Vector

SMALLEST_WINDOW_PX = 2.9
"""Semi-axis below which there are too few pixels for the parameters of a crossing."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Crossings(Value):
    """Fitted crossings; NaN in all columns where there is none.

    Attributes:
        covariances: px², from the residuals of the fit, hence of whatever the model does not explain as well.
        blur_px: standard deviation of the blur of the edges.
        contrast: half of white less black, in [−½, ½]; positive where the quadrants with x y > 0 are black.
        misfit: root mean square of the residuals by the contrast.
    """

    points2D: Points2D
    covariances: Float64[np.ndarray, "N 2 2"]
    blur_px: Vector
    contrast: Vector
    misfit: Vector


def fit_crossings(
    grey: UInt8[np.ndarray, "H W"], points2D: Points2D, affines: Affines, radius_m: float, max_radius_px: float
) -> Crossings:
    """Fits the crossings near `points2D`.

    Args:
        affines: of the map from board to image at the corners.
        radius_m: of the disc on the board.
        max_radius_px: semi-axes of the window are cut to this length. Pixels far out say little about the corner, and
            the edges bend there.
    """
    windows = _windows(affines, radius_m, max_radius_px)
    # The first edge runs along the board's x, so that its normal is across it.
    angles = np.arctan2(affines[:, 0], -affines[:, 1])
    capacity = int((2 * max(max_radius_px, SMALLEST_WINDOW_PX) + 2) ** 2)
    count = len(points2D)
    fitted, covariances, measures = np.empty((count, 2)), np.empty((count, 2, 2)), np.empty((count, 4))
    _detect_kernels.fit_crossings(
        grey, np.ascontiguousarray(points2D), windows, angles, capacity, fitted, covariances, measures
    )
    contrast, misfit = measures[:, 1] / 255, measures[:, 2] / np.abs(measures[:, 1])
    return Crossings(fitted, covariances, measures[:, 0].copy(), contrast, misfit)


def _windows(affines: Affines, radius_m: float, max_radius_px: float) -> Affines:
    """W with |W d| ≤ 1 inside the ellipse."""
    u, semi_axes, vt = np.linalg.svd(affines * radius_m)
    semi_axes = np.clip(semi_axes, SMALLEST_WINDOW_PX, max(max_radius_px, SMALLEST_WINDOW_PX))
    return np.ascontiguousarray(np.linalg.inv(u * semi_axes[:, None, :] @ vt))
