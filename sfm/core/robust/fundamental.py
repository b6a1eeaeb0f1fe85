"""Robust fundamental matrices and homographies between pixels."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import Mask, Matrix3, Points2D, Value, Vector, readonly
from sfm.core.errors import Rejected
from sfm.core.robust.ransac import Estimate, RansacConfig, ransac
from sfm.core.robust.relative_pose import check_lengths, chosen, finite_rows, scatter
from sfm.core.robust.two_view import common_normalisation, fundamental_matrix, homography_matrix


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MatrixEstimate(Value):
    """A matrix between pixels, of unit norm, the pairs (N,) that agree with it and the samples drawn."""

    matrix: Matrix3
    inliers: Mask
    iterations: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", readonly(self.matrix, (3, 3)))
        object.__setattr__(self, "inliers", readonly(self.inliers, (len(self.inliers),), np.bool_))


def estimate_fundamental(
    points2D_1: Points2D,
    points2D_2: Points2D,
    config: RansacConfig = RansacConfig(),
    *,
    rng: np.random.Generator,
    quality: Vector | None = None,
) -> MatrixEstimate | Rejected:
    """F of rank two with x2ᵀ F x1 = 0, by the seven-point solver and LO-RANSAC on Sampson errors in px.

    A planar scene leaves F undetermined: the result then explains the pairs, but its epipoles mean nothing.

    Args:
        quality: (N,) larger for pairs that are more likely right (see `ransac`).
    Raises:
        ValueError: the point sets or the qualities differ in length.
    """
    check_lengths(points2D_1, points2D_2)
    usable = finite_rows(points2D_1) & finite_rows(points2D_2)
    if not usable.any():
        return Rejected("too_few_points", "no finite pair of points")
    columns, t1, t2 = common_normalisation(points2D_1[usable], points2D_2[usable])
    estimate = ransac(fundamental_matrix(columns, config.max_error_px * t1[0, 0]), config, rng, chosen(quality, usable))
    if not isinstance(estimate, Estimate):
        return estimate
    matrix = t2.T @ estimate.model[:9].reshape(3, 3) @ t1
    return MatrixEstimate(matrix / np.linalg.norm(matrix), scatter(estimate.inliers, usable), estimate.iterations)


def estimate_homography(
    points2D_1: Points2D,
    points2D_2: Points2D,
    config: RansacConfig = RansacConfig(),
    *,
    rng: np.random.Generator,
    quality: Vector | None = None,
) -> MatrixEstimate | Rejected:
    """H with x2 ~ H x1, by four points and LO-RANSAC on Sampson errors in px, which treat both images alike.

    The sign of H is such that the inliers have w > 0.

    Args:
        quality: (N,) larger for pairs that are more likely right (see `ransac`).
    Raises:
        ValueError: the point sets or the qualities differ in length.
    """
    check_lengths(points2D_1, points2D_2)
    usable = finite_rows(points2D_1) & finite_rows(points2D_2)
    if not usable.any():
        return Rejected("too_few_points", "no finite pair of points")
    columns, t1, t2 = common_normalisation(points2D_1[usable], points2D_2[usable])
    estimate = ransac(homography_matrix(columns, config.max_error_px * t1[0, 0]), config, rng, chosen(quality, usable))
    if not isinstance(estimate, Estimate):
        return estimate
    h = estimate.model[:9].reshape(3, 3)
    w = h[2, :2] @ columns[:2, estimate.inliers] + h[2, 2]
    matrix = np.linalg.solve(t2, h) @ t1 * (1.0 if np.median(w) > 0 else -1.0)
    return MatrixEstimate(matrix / np.linalg.norm(matrix), scatter(estimate.inliers, usable), estimate.iterations)
