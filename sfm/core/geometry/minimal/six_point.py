"""Six-point solvers for relative pose with an unknown focal length."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sfm.core.arrays import FloatArray, Points2D, Vector
from sfm.core.geometry.minimal._samples import sample_of
from sfm.core.geometry.minimal._six_point_kernels import (
    MAX_ONE_SIDED_SOLUTIONS,
    MAX_SHARED_SOLUTIONS,
    six_point_one_sided_focal,
    six_point_shared_focal,
)

_SIZE = 0.5
"""To which the median of the coordinates is brought: the solver is most exact there."""


def solve_six_point_shared_focal(points2D_1: Points2D, points2D_2: Points2D) -> tuple[FloatArray, Vector]:
    """All fundamental matrices (S ≤ 15, 3, 3) of unit norm and focal lengths (S,) that two views by one camera allow.

    With K = diag(f, f, 1), p2ᵀ F p1 = 0 for six pairs of points and K F K is an essential matrix. Two views with
    parallel optical axes, or whose axes meet at one distance from both, leave f undetermined: solutions are then
    missing or mean nothing, but are never NaN.

    Args:
        points2D_1: (6, 2) from the principal point, in any unit, which is that of f; points2D_2 their partners.
    Raises:
        ValueError: there are not six pairs.
    Reference:
        Kukelova, Bujnak & Pajdla, Polynomial eigenvalue solutions to the 5-pt and 6-pt relative pose problems,
        BMVC 2008.
    """
    data, sample = sample_of((points2D_1, (6, 2)), (points2D_2, (6, 2)))
    scale = _scale(data)
    matrices, focals = _solved(six_point_shared_focal, data * scale, sample, MAX_SHARED_SOLUTIONS)
    return _unit(matrices * _corners(scale, scale)), focals / scale


def solve_six_point_one_sided_focal(points2D_1: Points2D, rays2D_2: Points2D) -> tuple[FloatArray, Vector]:
    """All fundamental matrices (S ≤ 9, 3, 3) of unit norm and focal lengths (S,) of camera 1 if camera 2 is calibrated.

    With K = diag(f, f, 1), p2ᵀ F p1 = 0 for six pairs of points and F K is an essential matrix. Where the optical axis
    of camera 1 passes through the centre of camera 2, f is undetermined: solutions are then missing or mean nothing,
    but are never NaN.

    Args:
        points2D_1: (6, 2) from the principal point, in any unit, which is that of f.
        rays2D_2: (6, 2) their partners as x / z, y / z in the frame of camera 2.
    Raises:
        ValueError: there are not six pairs.
    Reference:
        Bujnak, Kukelova & Pajdla, 3D reconstruction from image collections with a single known focal length, ICCV 2009.
    """
    data, sample = sample_of((points2D_1, (6, 2)), (rays2D_2, (6, 2)))
    scale = _scale(data[:2])
    data[:2] *= scale
    matrices, focals = _solved(six_point_one_sided_focal, data, sample, MAX_ONE_SIDED_SOLUTIONS)
    return _unit(matrices * _corners(scale, 1.0)), focals / scale


def _solved(
    kernel: Callable[[FloatArray, np.ndarray, FloatArray], int], data: FloatArray, sample: np.ndarray, most: int
) -> tuple[FloatArray, Vector]:
    models = np.zeros((most, 10))
    count = kernel(data, sample, models)
    return models[:count, :9].reshape(-1, 3, 3), np.exp(models[:count, 9])


def _scale(coordinates: FloatArray) -> float:
    middle = float(np.median(np.abs(coordinates)))
    return _SIZE / middle if 0 < middle < np.inf else 1.0


def _corners(scale1: float, scale2: float) -> FloatArray:
    """The factors of F by which coordinates that were multiplied by these scales are brought back."""
    return np.outer([scale2, scale2, 1.0], [scale1, scale1, 1.0])


def _unit(matrices: FloatArray) -> FloatArray:
    return matrices / np.linalg.norm(matrices, axis=(1, 2), keepdims=True)
