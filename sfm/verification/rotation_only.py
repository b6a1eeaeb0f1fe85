"""Pairs without parallax: images that differ by a rotation of the camera only, for any camera model."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Matrix3, Rays, Vector
from sfm.core.geometry.rotation import Rotation3
from sfm.core.robust.relative_pose import Bearings

_REWEIGHTINGS = 10


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


def _weighted_rotation(rays1: Rays, rays2: Rays, by_ray: FloatArray, weights: Vector) -> tuple[Matrix3, Vector]:
    """R and the squared errors under it, infinite where R r1 points away from r2."""
    u, _, vt = np.linalg.svd((rays2 * weights[:, None]).T @ rays1)
    matrix = (u * [1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    turned = rays1 @ matrix.T
    along = np.einsum("ni,ni->n", turned, rays2)
    squares = np.square(np.einsum("nij,nj->ni", by_ray, turned)).sum(1) / np.maximum(along, 1e-9) ** 2
    return matrix, np.where(along > 0, squares, np.inf)
