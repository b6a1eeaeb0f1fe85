"""Corners of squares to a fraction of a pixel: every crossing of two edges is fitted to its pixels.

The window is an ellipse: what a disc on the board looks like in the image. It holds nothing but the two edges of its
own corner, as large as that allows, in every image and at every corner: a square window of fixed size takes in
parts of the neighbours where the board is far or oblique.

So small a window hardly tells a shift of the crossing from a bend of its edges or a gradient of the light. Both change
little from one crossing to the next: once all are fitted they are fitted again, with what their neighbours say.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float64, UInt8

from calib import _detect_kernels
from calib.detect_neighbours import Affines, local_curvatures, local_slopes
from calib.detect_plane import fit_plane
from sfm.core.arrays import Mask, Points2D, Value, Vector

SMALLEST_WINDOW_PX = 2.9
"""Semi-axis below which there are too few pixels for the parameters of a crossing."""


_LEAST_SLOPE = 0.02
"""Least deviation of an expected gradient, grey values per px."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Crossings(Value):
    """Fitted crossings; NaN in all columns where there is none.

    Attributes:
        covariances: px², from the residuals of the fit, hence of whatever the model does not explain as well.
        shapes: the parameters of `_detect_kernels`, in px and grey values.
        misfit: root mean square of the residuals by the contrast.
    """

    covariances: Float64[np.ndarray, "N 2 2"]
    shapes: Float64[np.ndarray, "N 11"]
    misfit: Vector

    @property
    def points2D(self) -> Points2D:
        """Where the edges cross, px."""
        return self.shapes[:, :2]

    @property
    def blur_px(self) -> Vector:
        """Standard deviation of the blur of the edges."""
        return self.shapes[:, 4]

    @property
    def contrast(self) -> Vector:
        """Half of white less black, in [−½, ½]; positive where the quadrants with x y > 0 are black."""
        return self.shapes[:, 6] / 255


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Expectations(Value):
    """What is known of crossings before they are fitted.

    Attributes:
        shapes: to start from; where there is none yet, NaN but for the place.
        values, deviations: of gx, gy, κ1, κ2 (see `_detect_kernels`); inf where nothing is known.
        noise: standard deviation of a pixel, grey values.
    """

    shapes: Float64[np.ndarray, "N 11"]
    values: Float64[np.ndarray, "N 4"]
    deviations: Float64[np.ndarray, "N 4"]
    noise: float


def expectations(
    board_points: Points2D, shapes: Float64[np.ndarray, "N 11"], known: Mask, size: tuple[int, int], errors_px: float,
    noise: float,
) -> Expectations:  # fmt: skip
    """What the neighbours of crossings say of them: how edges bend, and how the light falls off.

    The gradient is that of the mean μ from neighbour to neighbour.

    Args:
        known: which crossings to believe.
        size: width and height of the image, px.
        errors_px: standard deviation of a coordinate of theirs.
    """
    neighbours, places = board_points[known], shapes[known, :2]
    curvatures, spread = local_curvatures(
        board_points, neighbours, places, fit_plane(neighbours, places, size), errors_px
    )
    slopes, scatter = local_slopes(board_points, neighbours, places, shapes[known, 5])
    deviations = np.empty((len(shapes), 4))
    deviations[:, :2] = np.maximum(scatter, _LEAST_SLOPE)[:, None]
    deviations[:, 2:] = spread
    return Expectations(shapes, np.hstack([slopes, curvatures]), deviations, noise)


def fit_crossings(
    grey: UInt8[np.ndarray, "H W"], points2D: Points2D, affines: Affines, radius_m: float, max_radius_px: float,
    expected: Expectations | None = None,
) -> Crossings:  # fmt: skip
    """Fits the crossings near `points2D`.

    Args:
        affines: of the map from board to image at the corners.
        radius_m: of the disc on the board.
        max_radius_px: semi-axes of the window are cut to this length. Pixels far out say little about the corner, and
            the edges bend there.
        expected: of the crossings, if anything; it halves their errors.
    """
    windows, count = _windows(affines, radius_m, max_radius_px), len(points2D)
    starts, values, weights = np.zeros((count, _detect_kernels.PARAMETERS)), np.zeros((count, 4)), np.zeros((count, 4))
    if expected is not None:
        seen = np.isfinite(expected.shapes).all(1)
        starts[seen] = expected.shapes[seen]
        values, weights = expected.values, np.square(expected.noise / expected.deviations)
    starts[:, :2] = points2D
    # The first edge runs along the board's x, so that its normal is across it.
    starts[:, 2:4] = np.where(starts[:, 4:5] > 0, starts[:, 2:4], np.arctan2(affines[:, 0], -affines[:, 1]))
    capacity = int((2 * max(max_radius_px, SMALLEST_WINDOW_PX) + 2) ** 2)
    shapes, covariances, residuals = np.empty_like(starts), np.empty((count, 2, 2)), np.empty(count)
    _detect_kernels.fit_crossings(grey, windows, capacity, values, weights, starts, shapes, covariances, residuals)
    return Crossings(covariances, shapes, residuals / np.abs(shapes[:, 6]))


def _windows(affines: Affines, radius_m: float, max_radius_px: float) -> Affines:
    """W with |W d| ≤ 1 inside the ellipse."""
    u, semi_axes, vt = np.linalg.svd(affines * radius_m)
    semi_axes = np.clip(semi_axes, SMALLEST_WINDOW_PX, max(max_radius_px, SMALLEST_WINDOW_PX))
    return np.ascontiguousarray(np.linalg.inv(u * semi_axes[:, None, :] @ vt))
