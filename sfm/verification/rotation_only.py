"""Pairs without parallax: images that differ by a rotation of the camera only, for any camera model.

Where focal lengths are only guessed, a rotation shows as a homography H with  K2⁻¹ H K1 ∝ R  for some common factor of
the focal lengths. A plane in general position has no such factor: H has eight degrees of freedom, K R K⁻¹ four.
"""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Matrix3, Rays, Vector
from sfm.core.geometry.rotation import Rotation3
from sfm.core.robust.relative_pose import Bearings

_REWEIGHTINGS = 10

_FACTORS = np.log(0.4), np.log(2.0)
"""Range of focal lengths that are tried, as factors of the guess: 24° to 92° of view. Beyond, a plane that slides past
looks as if the camera turned."""
_GRID, _ZOOMS = 33, 3
_IDENTITY = np.eye(3)


def fit_rotation(
    bearings1: Bearings, bearings2: Bearings, inliers: Mask, max_error_px: float
) -> tuple[Rotation3, Mask]:
    """`cam2_from_cam1` as a pure rotation that fits the inliers robustly, and the inliers it explains.

    The error is the tangent reprojection error in px of image 2, B (R r1) / (r2 · R r1), where B is the derivative of
    the pixel by the ray r2. Least squares over rays, Σ w |R r1 − r2|², are solved in closed form and reweighted.

    Reference:
        Kabsch, A solution for the best rotation to relate two sets of vectors, 1976.
    """
    rays1, rays2, by_ray = bearings1.rays[inliers], bearings2.rays[inliers], bearings2.pixels_by_ray[inliers]
    weights = np.ones(len(rays1))
    matrix, squares = _weighted_rotation(rays1, rays2, by_ray, weights)
    for _ in range(_REWEIGHTINGS):
        matrix, squares = _weighted_rotation(rays1, rays2, by_ray, 1 / (1 + squares / max_error_px**2))
    explained = np.zeros(len(inliers), dtype=np.bool_)
    explained[inliers] = squares < max_error_px**2
    return Rotation3.from_matrix(matrix), explained


def focal_factor_of_rotation(
    homography: Matrix3, calibration1: Matrix3, calibration2: Matrix3, free: tuple[bool, bool]
) -> float:
    """The factor s of the guessed focal lengths under which H comes closest to a rotation.

    With M = K2(s)⁻¹ H K1(s) of determinant one, that is where |MᵀM − I| is least: on a grid, then on finer ones.

    Args:
        free: which of the two focal lengths are guessed, hence scaled.
    """
    low, high = _FACTORS
    best = 0.0
    for _ in range(_ZOOMS):
        tried = np.linspace(low, high, _GRID)
        k1, k2 = (
            np.where(is_free, np.exp(tried), 1.0)[:, None, None] * matrix * [[1, 1, 0]] + matrix * [[0, 0, 1]]
            for matrix, is_free in zip((calibration1, calibration2), free, strict=True)
        )
        m = np.linalg.solve(k2, homography @ k1)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # of a singular H
            m = m / np.cbrt(np.linalg.det(m))[:, None, None]
            costs = np.square(np.swapaxes(m, 1, 2) @ m - _IDENTITY).sum((1, 2))
        if not np.isfinite(costs).any():
            return 1.0
        best = tried[np.nanargmin(costs)]
        step = (high - low) / (_GRID - 1)
        low, high = best - step, best + step
    return float(np.exp(best))


def _weighted_rotation(rays1: Rays, rays2: Rays, by_ray: FloatArray, weights: Vector) -> tuple[Matrix3, Vector]:
    """R and the squared errors under it, infinite where R r1 points away from r2."""
    u, _, vt = np.linalg.svd((rays2 * weights[:, None]).T @ rays1)
    matrix = (u * [1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    turned = rays1 @ matrix.T
    along = np.einsum("ni,ni->n", turned, rays2)
    squares = np.square(np.einsum("nij,nj->ni", by_ray, turned)).sum(1) / np.maximum(along, 1e-9) ** 2
    return matrix, np.where(along > 0, squares, np.inf)
