"""A board as a lens with one coefficient shows it: a first idea of how straight lines bend, in any image.

Let X = (x, y, 1) be a point of the board, q = (u, v) its pixel from the middle of the image, over half of the diagonal.
With a homography H and the coefficient λ of division,

    (u, v, 1 + λ |q|²) ∼ H X

which is linear in H for a given λ; λ is tried. Of pinhole cameras λ is 0, of wide fisheyes −1 and less. It need not be
exact: what is left is small and smooth, and functions of the place on the board describe it where they fail before the
whole. At the border of a board in the image of a fisheye, curvatures come out four times as exact.

Reference:
    Fitzgibbon, Simultaneous linear estimation of multiple view geometry and lens distortion, CVPR 2001: the lens.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize_scalar

from sfm.core.arrays import Points2D, Value

_TIE_PX = 1e-3
"""Of coefficients whose errors differ by less that nearest to zero is taken: four corners say nothing about it."""
_COEFFICIENTS = (0.1, 0.0, -0.03, -0.1, -0.2, -0.35, -0.5, -0.75, -1.0, -1.4, -2.0, -3.0)
_CLOSE = 1e-4
_NONE = 1e12
_LEAST_FOR_LENS = 9
"""Fewer corners hardly tell a lens from perspective."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class LensedPlane(Value):
    """The map from a board to an image.

    Attributes:
        homography: to (u, v, 1 + λ |q|²).
        coefficient: λ.
        middle, unit: of the image, px, and what |q| = 1 is there.
    """

    homography: Float64[np.ndarray, "3 3"]
    coefficient: float
    middle: Float64[np.ndarray, " 2"]
    unit: float

    def image(self, board_points: Points2D) -> Points2D:
        """Pixels of points (x, y) of the board; NaN where it has none."""
        lifted = board_points @ self.homography[:, :2].T + self.homography[:, 2]
        # q = m (lifted_x, lifted_y) with 1 + λ m² n = m lifted_z
        square, depth = np.square(lifted[:, :2]).sum(1), lifted[:, 2]
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = 2 / (depth + np.sqrt(depth**2 - 4 * self.coefficient * square))
            return self.middle + self.unit * factor[:, None] * lifted[:, :2]


def fit_plane(board_points: Points2D, points2D: Points2D, size: tuple[int, int]) -> LensedPlane:
    """The map that is nearest in the image, of those with one of a dozen coefficients.

    Args:
        board_points: (x, y) on the board, at least four; row by row the partners of `points2D`.
        size: width and height of the image, px.
    """
    planes = _planes(board_points, points2D, size)
    return min((planes(coefficient) for coefficient in _COEFFICIENTS), key=_error_at(board_points, points2D))


def fit_plane_closely(board_points: Points2D, points2D: Points2D, size: tuple[int, int]) -> LensedPlane:
    """As `fit_plane`, with the best of all coefficients; without any where there are few points."""
    planes, error = _planes(board_points, points2D, size), _error_at(board_points, points2D)
    if len(board_points) < _LEAST_FOR_LENS:
        return planes(0.0)
    errors = [error(planes(coefficient)) for coefficient in _COEFFICIENTS]
    at = int(np.argmin(errors))
    between = _COEFFICIENTS[min(at + 1, len(errors) - 1)], _COEFFICIENTS[max(at - 1, 0)]
    found = minimize_scalar(lambda x: error(planes(float(x))), bounds=between, options={"xatol": _CLOSE})
    return planes(float(found.x))


def _planes(board_points: Points2D, points2D: Points2D, size: tuple[int, int]) -> Callable[[float], LensedPlane]:
    """The map that is nearest for each coefficient."""
    middle, unit = np.array(size) / 2, float(np.hypot(*size)) / 2
    center = board_points.mean(axis=0)
    reach = float(np.abs(board_points - center).max())
    scale = np.array([[1 / reach, 0, -center[0] / reach], [0, 1 / reach, -center[1] / reach], [0, 0, 1]])
    normed = np.column_stack([(board_points - center) / reach, np.ones(len(board_points))])
    offsets = (points2D - middle) / unit
    return lambda x: LensedPlane(_homography(normed, offsets, x) @ scale, x, middle, unit)


def _error_at(board_points: Points2D, points2D: Points2D) -> Callable[[LensedPlane], float]:
    """Mean squared distance, px², with a little for the coefficient; beyond all measure where a point has no image."""

    def error(plane: LensedPlane) -> float:
        mean = float(np.square(plane.image(board_points) - points2D).mean())
        return mean + _TIE_PX**2 * abs(plane.coefficient) if np.isfinite(mean) else _NONE

    return error


def _homography(normed: Float64[np.ndarray, "N 3"], offsets: Points2D, coefficient: float) -> np.ndarray:
    """Least squares of the cross products of (u, v, 1 + λ |q|²) and H X; H such that the factor between is positive."""
    u, v = offsets.T[:, :, None]
    w = 1 + coefficient * (u**2 + v**2)
    nothing = np.zeros_like(normed)
    rows = np.concatenate(
        [np.hstack([nothing, -w * normed, v * normed]), np.hstack([w * normed, nothing, -u * normed])]
    )
    H = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    return H if np.sum((normed @ H.T) * np.hstack([u, v, w])) > 0 else -H
