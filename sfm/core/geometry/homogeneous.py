"""Homogeneous coordinates of points and lines in the plane."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Matrix3, Points2D


def to_homogeneous(points: FloatArray) -> FloatArray:
    """Points (..., D) with a 1 appended, (..., D + 1)."""
    points = np.asarray(points, dtype=np.float64)
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1)


def from_homogeneous(points: FloatArray) -> FloatArray:
    """Points (..., D + 1) divided by their last coordinate, (..., D); NaN for points at infinity."""
    w = points[..., -1:]
    return np.divide(points[..., :-1], w, out=np.full_like(points[..., :-1], np.nan), where=w != 0)


def transform_points(matrix: Matrix3, points2D: Points2D) -> Points2D:
    """The points x' ~ H x; NaN where x' lies at infinity."""
    return from_homogeneous(to_homogeneous(points2D) @ matrix.T)


def normalise_lines(lines: FloatArray) -> FloatArray:
    """Lines (..., 3) scaled to a unit normal, so that l · (x, y, 1) is the signed distance of (x, y)."""
    return lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)


def normalising_transform(points2D: Points2D) -> Matrix3:
    """T that centres points at the origin with a mean distance of √2; T of coincident points only centres.

    Reference:
        Hartley, In defense of the eight-point algorithm, PAMI 1997.
    """
    center = points2D.mean(0)
    distance = np.linalg.norm(points2D - center, axis=1).mean()
    scale = np.sqrt(2) / distance if distance > 0 else 1.0
    return np.array([[scale, 0, -scale * center[0]], [0, scale, -scale * center[1]], [0, 0, 1]])
