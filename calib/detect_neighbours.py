"""What the neighbours of a corner say about it: the local scale of the image, and where the corner must be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from calib.detect_plane import LensedPlane, fit_plane
from sfm.core.arrays import Indices, Points2D

Affines = Float64[np.ndarray, "N 2 2"]
"""∂(image) / ∂(board) at each corner, px per metre."""

_NEAREST = 3
FOR_PREDICTION = 16
"""Neighbours that tell where a corner must be, if there are so many."""
_LEAST_FOR_QUADRATIC = 9
_DEGREES = ((2, 12), (3, 16))
"""Of the polynomials through the neighbours that tell how edges bend, and how many these are."""
_FAR = 3.0
"""Gain of errors from which on the neighbours do not tell how what a plane leaves bends."""
_UNSURE = 0.3
"""Part of a curvature that may be wrong where only one degree tells it."""
_STEP = 1e-3
"""Of numeric derivatives, by the distance of the neighbours."""
_ALIKE = 1.01
"""Distances on the board that differ by less are the same."""


def local_affines(
    board_points: Points2D, points2D: Points2D, at: Indices | None = None
) -> Float64[np.ndarray, "A 2 2"]:
    """The linear part of the map from board to image around each corner, from its nearest neighbours.

    Args:
        board_points: (x, y) on the board in metres; row by row the partners of `points2D`.
        at: rows of the corners that are asked for; all by default.
    Raises:
        ValueError: there are fewer than three corners, or all are on one line.
    """
    if len(board_points) < 3 or np.linalg.matrix_rank(board_points - board_points[0], tol=1e-9) < 2:
        raise ValueError(f"expected three corners that are not on one line, got {len(board_points)}")
    asked = np.arange(len(board_points)) if at is None else at
    between = board_points[None] - board_points[asked][:, None]
    moved = points2D[None] - points2D[asked][:, None]
    distance = np.linalg.norm(between, axis=2)
    near = distance <= _ALIKE * np.sort(distance, axis=1)[:, min(_NEAREST, len(board_points) - 1), None]
    affines, fits = _fitted_affines(between, moved, near)
    if not fits.all():  # neighbours on one line, as at the end of a torn row: then all corners are asked
        everywhere, _ = _fitted_affines(between, moved, np.ones_like(near))
        affines = np.where(fits[:, None, None], affines, everywhere)
    return affines


def predicted(
    targets: Points2D, board_points: Float64[np.ndarray, "K 2"], points2D: Float64[np.ndarray, "K 2"], degree: int = 2
) -> tuple[Points2D, Float64[np.ndarray, " N"]]:
    """Where corners must be in the image if board and lens are smooth, each from its nearest neighbours but itself.

    A quadratic function of the position on the board, an affine one where there are few neighbours.

    Args:
        targets: (x, y) on the board of the corners asked for.
        board_points: of those that are known.
        degree: of the function, 1 or 2.
    Returns:
        Their pixels; and by how much the errors of the neighbours are amplified: the deviation of a predicted
        from a measured place, where all errors are 1. At the border of a board it is several times that within.
    """
    wanted, gain, _ = foretold(targets, board_points, points2D, degree)
    return wanted, gain


def foretold(
    targets: Points2D, board_points: Float64[np.ndarray, "K 2"], points2D: Float64[np.ndarray, "K 2"],
    degree: int = 2,
) -> tuple[Points2D, Float64[np.ndarray, " N"], Int64[np.ndarray, "N M"]]:  # fmt: skip
    """What `predicted` says, and the rows of the neighbours that say it, at most `FOR_PREDICTION`."""
    order, steps, _ = _neighbourhoods(targets, board_points, FOR_PREDICTION)
    # Where neighbours are on a line, the pseudo-inverse takes the flattest function through them.
    weights = np.linalg.pinv(_terms(steps, degree if order.shape[1] >= _LEAST_FOR_QUADRATIC else 1), rcond=1e-4)[:, 0]
    return np.einsum("nk,nkd->nd", weights, points2D[order]), np.sqrt(1 + np.square(weights).sum(axis=1)), order


def predicted_through_lens(
    targets: Points2D, board_points: Float64[np.ndarray, "K 2"], points2D: Float64[np.ndarray, "K 2"],
    size: tuple[int, int],
) -> tuple[Points2D, Float64[np.ndarray, " N"]]:  # fmt: skip
    """As `predicted`, of what a plane before a lens leaves: a few corners tell what lies a square beside them.

    Far from all that are known, where a quadratic function amplifies errors, an affine one is taken.

    Args:
        size: width and height of the image, px.
    Returns:
        NaN where the plane has no image.
    """
    plane = fit_plane(board_points, points2D, size)
    remains = points2D - plane.image(board_points)
    left, gain = predicted(targets, board_points, remains)
    flat, flat_gain = predicted(targets, board_points, remains, degree=1)
    far = gain > _FAR
    return plane.image(targets) + np.where(far[:, None], flat, left), np.where(far, flat_gain, gain)


def local_curvatures(
    targets: Points2D, board_points: Float64[np.ndarray, "K 2"], points2D: Float64[np.ndarray, "K 2"],
    plane: LensedPlane, errors_px: float,
) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, "N 2"]]:  # fmt: skip
    """How the images of the board's lines along x and along y bend at each corner, by its neighbours but itself.

    With a and b the first and second derivative of the image by the place on the line, and n = (−a_y, a_x) / |a|,
    κ = −n·b / |a|². The derivatives are those of the plane's image and of polynomials through what that leaves.

    Args:
        plane: fitted to all known corners.
        errors_px: standard deviation of a coordinate of these.
    Returns:
        κ, 1 / px; and its standard deviation by the errors of the neighbours and by what the last degree of the
        polynomials has changed; inf where they do not tell.
    """
    curvatures, deviations = np.zeros((len(targets), 2)), np.full((len(targets), 2), np.inf)
    left = points2D - plane.image(board_points)
    for degree, near in _DEGREES:
        if len(board_points) <= near:
            break
        order, steps, scale = _neighbourhoods(targets, board_points, near)
        terms = _terms(steps, degree)
        weights = np.linalg.pinv(terms, rcond=1e-4)
        first, second = weights[:, 1:3] / scale, 2 * weights[:, [3, 5]] / scale**2
        a, b = _derivatives(plane, targets, scale[:, 0])
        a, b = a + first @ left[order], b + second @ left[order]
        square = np.square(a).sum(2)
        found = (a[..., 1] * b[..., 0] - a[..., 0] * b[..., 1]) / square**1.5
        changed = np.where(np.isfinite(deviations), found - curvatures, _UNSURE * found)
        spread = np.hypot(errors_px * np.linalg.norm(second, axis=2) / square, changed)
        tells = (np.linalg.matrix_rank(terms, tol=1e-3) == terms.shape[2])[:, None] & (spread < deviations)
        curvatures, deviations = np.where(tells, found, curvatures), np.where(tells, spread, deviations)
    return curvatures, deviations


def _derivatives(plane: LensedPlane, points: Points2D, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivative (N, 2, 2) of a plane's image along x and along y."""
    here, first, second = plane.image(points), [], []
    for axis in np.eye(2):
        step = _STEP * scale
        ahead, behind = plane.image(points + step * axis), plane.image(points - step * axis)
        first.append((ahead - behind) / (2 * step))
        second.append((ahead - 2 * here + behind) / step**2)
    return np.stack(first, axis=1), np.stack(second, axis=1)


def local_slopes(
    targets: Points2D, board_points: Float64[np.ndarray, "K 2"], points2D: Float64[np.ndarray, "K 2"],
    values: Float64[np.ndarray, " K"],
) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, " N"]]:  # fmt: skip
    """Gradient in the image of what the nearest neighbours of a corner have values of, by the plane through these.

    Returns:
        The gradient, 1 / px; and what the plane leaves of the values by the distance of the neighbours: the gradient
        between two of them differs by so much. Inf where they do not tell.
    """
    order, _, _ = _neighbourhoods(targets, board_points, FOR_PREDICTION)
    near = points2D[order]
    near = near - near.mean(axis=1, keepdims=True)
    spread = near.swapaxes(1, 2) @ near
    if order.shape[1] < _LEAST_FOR_QUADRATIC:
        return np.zeros((len(targets), 2)), np.full(len(targets), np.inf)
    tells = np.linalg.det(spread) > 1e-3 * (np.trace(spread, axis1=1, axis2=2) / 2) ** 2
    spread[~tells] = np.eye(2)
    apart = values[order] - values[order].mean(axis=1, keepdims=True)
    slopes = np.linalg.solve(spread, near.swapaxes(1, 2) @ apart[..., None])[..., 0]
    left = apart - np.einsum("nkd,nd->nk", near, slopes)
    distance = np.sqrt(np.square(near).sum(2).mean(1))
    deviations = np.sqrt(np.square(left).sum(1) / (order.shape[1] - 3)) / distance
    return np.where(tells[:, None], slopes, 0.0), np.where(tells, deviations, np.inf)


def _neighbourhoods(
    targets: Points2D, board_points: Float64[np.ndarray, "K 2"], near: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each target: the nearest known corners (K,) but itself, the steps to them (K, 2) by their mean length, it."""
    offset = board_points[None] - targets[:, None]
    distance = np.linalg.norm(offset, axis=2)
    distance[distance < 1e-9] = np.inf
    order = np.argsort(distance, axis=1, kind="stable")[:, :near]
    order = order[:, : max(1, np.isfinite(np.take_along_axis(distance, order, 1)).sum(axis=1).min())]
    scale = np.take_along_axis(distance, order, 1).mean(axis=1)[:, None, None]
    return order, np.take_along_axis(offset, order[:, :, None], 1) / scale, scale


def _terms(steps: np.ndarray, degree: int) -> np.ndarray:
    """Monomials in x and y: 1, x, y, x², x y, y² …"""
    x, y = np.moveaxis(steps, 2, 0)
    return np.stack([x ** (n - k) * y**k for n in range(degree + 1) for k in range(n + 1)], axis=2)


def _fitted_affines(between: np.ndarray, moved: np.ndarray, near: np.ndarray) -> tuple[Affines, Bool[np.ndarray, " N"]]:
    """Least squares over the neighbours, and whether they determine it.

    Args:
        between, moved: (N, K, 2) from the corners that are asked for to all, on the board and in the image.
    """
    spread = np.einsum("ij,ijk,ijl->ikl", near, between, between)
    image = np.einsum("ij,ijk,ijl->ikl", near, moved, between)
    determinant = np.linalg.det(spread)
    fits = determinant > 1e-3 * (np.trace(spread, axis1=1, axis2=2) / 2) ** 2
    spread[~fits] = np.eye(2)
    return image @ np.linalg.inv(spread), fits
