"""What the neighbours of a corner say about it: the local scale of the image, and where the corner must be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from sfm.core.arrays import Points2D

Affines = Float64[np.ndarray, "N 2 2"]
"""∂(image) / ∂(board) at each corner, px per metre."""

_NEAREST = 3
_FOR_PREDICTION = 16
_LEAST_FOR_QUADRATIC = 9
_ALIKE = 1.01
"""Distances on the board that differ by less are the same."""


def local_affines(board_points: Points2D, points2D: Points2D) -> Affines:
    """The linear part of the map from board to image around each corner, from its nearest neighbours.

    Args:
        board_points: (x, y) on the board in metres; row by row the partners of `points2D`.
    Raises:
        ValueError: there are fewer than three corners, or all are on one line.
    """
    if len(board_points) < 3 or np.linalg.matrix_rank(board_points - board_points[0], tol=1e-9) < 2:
        raise ValueError(f"expected three corners that are not on one line, got {len(board_points)}")
    between, distance = _distances(board_points)
    near = distance <= _ALIKE * np.sort(distance, axis=1)[:, min(_NEAREST, len(distance) - 1), None]
    affines, fits = _fitted_affines(between, points2D, near)
    if not fits.all():  # neighbours on one line, as at the end of a torn row: then all corners are asked
        everywhere, _ = _fitted_affines(between, points2D, np.ones_like(near))
        affines = np.where(fits[:, None, None], affines, everywhere)
    return affines


def predicted(
    targets: Points2D, board_points: Float64[np.ndarray, "K 2"], points2D: Float64[np.ndarray, "K 2"]
) -> tuple[Points2D, Float64[np.ndarray, " N"]]:
    """Where corners must be in the image if board and lens are smooth, each from its nearest neighbours but itself.

    A quadratic function of the position on the board, an affine one where there are few neighbours.

    Args:
        targets: (x, y) on the board of the corners asked for.
        board_points: of those that are known.
    Returns:
        Their pixels; and by how much the errors of the neighbours are amplified: the deviation of a predicted
        from a measured place, where all errors are 1. At the border of a board it is several times that within.
    """
    offset = board_points[None] - targets[:, None]
    distance = np.linalg.norm(offset, axis=2)
    distance[distance < 1e-9] = np.inf
    order = np.argsort(distance, axis=1, kind="stable")[:, :_FOR_PREDICTION]
    order = order[:, : max(1, np.isfinite(np.take_along_axis(distance, order, 1)).sum(axis=1).min())]
    scale = np.take_along_axis(distance, order, 1).mean(axis=1)[:, None, None]
    x, y = np.moveaxis(np.take_along_axis(offset, order[:, :, None], 1) / scale, 2, 0)
    terms = [np.ones_like(x), x, y]
    if order.shape[1] >= _LEAST_FOR_QUADRATIC:
        terms += [x * x, x * y, y * y]
    design = np.stack(terms, axis=2)
    # Where neighbours are on a line, the pseudo-inverse takes the flattest function through them.
    weights = np.linalg.pinv(design, rcond=1e-4)[:, 0]
    return np.einsum("nk,nkd->nd", weights, points2D[order]), np.sqrt(1 + np.square(weights).sum(axis=1))


def _distances(board_points: Points2D) -> tuple[np.ndarray, np.ndarray]:
    between = board_points[None] - board_points[:, None]
    return between, np.linalg.norm(between, axis=2)


def _fitted_affines(
    between: np.ndarray, points2D: Points2D, near: np.ndarray
) -> tuple[Affines, Bool[np.ndarray, " N"]]:
    """Least squares over the neighbours, and whether they determine it."""
    moved = points2D[None] - points2D[:, None]
    spread = np.einsum("ij,ijk,ijl->ikl", near, between, between)
    image = np.einsum("ij,ijk,ijl->ikl", near, moved, between)
    determinant = np.linalg.det(spread)
    fits = determinant > 1e-3 * (np.trace(spread, axis1=1, axis2=2) / 2) ** 2
    spread[~fits] = np.eye(2)
    return image @ np.linalg.inv(spread), fits
