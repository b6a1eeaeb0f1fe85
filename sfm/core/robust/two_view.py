"""The problems of two views for the sampling loop: essential, fundamental and homography matrices."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Points2D, Rays
from sfm.core.robust import _two_view_kernels as kernels
from sfm.core.robust.ransac import CompiledProblem, Solver


def essential_matrix(
    rays1: Rays, rays2: Rays, jacobians1: FloatArray, jacobians2: FloatArray, max_error_px: float
) -> CompiledProblem:
    """x2ᵀ E x1 = 0 on unit rays, with errors in px by their derivatives (N, 3, 2)."""
    data = np.empty((18, len(rays1)))
    data[:3], data[3:6] = rays1.T, rays2.T
    data[6:12], data[12:] = jacobians1.reshape(-1, 6).T, jacobians2.reshape(-1, 6).T
    return CompiledProblem(
        kernels.TwoViews(kernels.ESSENTIAL, data), Solver(5, 10, restarts=4, reach=3.0), max_error_px
    )


def fundamental_matrix(columns: FloatArray, max_error: float) -> CompiledProblem:
    """x2ᵀ F x1 = 0 on points (4, N) near the origin."""
    return CompiledProblem(
        kernels.TwoViews(kernels.FUNDAMENTAL, np.ascontiguousarray(columns)),
        Solver(7, 3, restarts=4),
        max_error,
    )


def homography_matrix(columns: FloatArray, max_error: float) -> CompiledProblem:
    """x2 ~ H x1 on points (4, N) near the origin."""
    return CompiledProblem(
        kernels.TwoViews(kernels.HOMOGRAPHY, np.ascontiguousarray(columns)),
        Solver(4, 1, restarts=1, effort=0.5),
        max_error,
    )


def common_normalisation(points2D_1: Points2D, points2D_2: Points2D) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres both point sets and scales both by one number, so that errors of both images keep one unit.

    Returns:
        Columns (4, N) of normalised points, and the matrices T1, T2 with normalised = T pixel.
    """
    center1, center2 = points2D_1.mean(0), points2D_2.mean(0)
    spread = max(np.abs(points2D_1 - center1).mean(), np.abs(points2D_2 - center2).mean())
    scale = 1 / spread if spread > 0 else 1.0
    columns = np.concatenate([(points2D_1 - center1) * scale, (points2D_2 - center2) * scale], axis=1).T
    matrices = [np.array([[scale, 0, -scale * c[0]], [0, scale, -scale * c[1]], [0, 0, 1]]) for c in (center1, center2)]
    return columns, matrices[0], matrices[1]
