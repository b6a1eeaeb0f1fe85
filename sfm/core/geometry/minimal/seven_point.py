"""Minimal solvers between pixels: seven points for the fundamental matrix, four for the homography."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Matrix3, Points2D
from sfm.core.geometry.homogeneous import normalising_transform, transform_points
from sfm.core.geometry.minimal._samples import sample_of
from sfm.core.geometry.minimal._seven_point_kernels import MAX_SOLUTIONS, four_point, seven_point


def solve_seven_point(points2D_1: Points2D, points2D_2: Points2D) -> FloatArray:
    """All fundamental matrices (S ≤ 3, 3, 3) of unit norm with x2ᵀ F x1 = 0 for seven pairs of points.

    Raises:
        ValueError: there are not seven pairs.
    Reference:
        Hartley & Zisserman, Multiple View Geometry, 2nd ed., §11.1.2.
    """
    data, sample = sample_of((points2D_1, (7, 2)), (points2D_2, (7, 2)))
    t1, t2 = _normalise(data)
    models = np.empty((MAX_SOLUTIONS, 9))
    count = seven_point(data, sample, models)
    return _unit(t2.T @ models[:count].reshape(-1, 3, 3) @ t1)


def solve_four_point(points2D_1: Points2D, points2D_2: Points2D) -> FloatArray:
    """The homography (1, 3, 3) of unit norm that maps four points, or none (0, 3, 3) if three are collinear.

    Raises:
        ValueError: there are not four pairs.
    """
    data, sample = sample_of((points2D_1, (4, 2)), (points2D_2, (4, 2)))
    t1, t2 = _normalise(data)
    models = np.empty((1, 9))
    count = four_point(data, sample, models)
    return _unit(np.linalg.inv(t2) @ models[:count].reshape(-1, 3, 3) @ t1)


def _normalise(data: FloatArray) -> tuple[Matrix3, Matrix3]:
    """Normalises the points of both images in place and returns the transforms."""
    t1, t2 = normalising_transform(data[:2].T), normalising_transform(data[2:].T)
    data[:2], data[2:] = transform_points(t1, data[:2].T).T, transform_points(t2, data[2:].T).T
    return t1, t2


def _unit(matrices: FloatArray) -> FloatArray:
    return matrices / np.linalg.norm(matrices, axis=(1, 2), keepdims=True)
