"""What the corners of photos say of the uncertainty of what photos share, each by its own residual; see `uncertainty`.

A corner i has D_i (2, K), the derivatives by what is shared with those by the pose of its photo (or of its moment, in a
rig) projected out,

    D_i = J_i − P_i H⁻¹ W,      h_i = P_i H⁻¹ P_iᵀ + D_i Σ D_iᵀ

with P_i (2, 6) by the pose, J_i (2, K) by what is shared, and H, W, Σ of the normal equations. The covariance is

    Σ (Σ_i D_iᵀ r_i r_iᵀ D_i) Σ,      r_i = (I − h_i)^−½ e_i
"""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import BoolArray, FloatArray, Points3D
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import skew

_SURE = 1e-6
"""Least pivot, over the diagonal, of a matrix that is not suspected of being singular."""
_OPEN = 1e-10
"""Part of what was known of a direction, below which nothing is."""
_SMALL_PART, _NO_PART = 0.5, 1e-4
"""Of a unit vector that is open: what may lie in what is needed (the mean size of the board is held, and so that of a
rig hangs a little on the place of each point, by a tenth here), and what is nothing."""
_LEAST_FREEDOM = 1e-3
"""Of a residual's direction, below which the fit has followed all of it."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CornerDerivatives:
    """Of the n corners of a view, whitened: by the pose (n, 2, 6), the camera's free parameters (n, 2, k), the board's
    coefficients (n, 2, B), and residuals (n, 2)."""

    by_pose: FloatArray
    by_params: FloatArray
    by_shape: FloatArray
    residuals: FloatArray


def corner_derivatives(
    camera: Camera, columns: np.ndarray, cam_from_board: Rigid3, points3D: Points3D, basis: FloatArray,
    roots: FloatArray, residuals: FloatArray,
) -> CornerDerivatives:  # fmt: skip
    """Of one view; what is not seen counts nothing.

    Args:
        columns: positions of the free parameters.
        points3D: (n, 3) of the corners, in the board's frame, as it is bent.
        basis: (n, 3, B) by which the board's coefficients move them.
        roots: (n, 3) of the corners' weights, and residuals (n, 2) in px; see `Observations`.
    """
    points = cam_from_board @ points3D
    _, by_point, by_params, _ = camera.project_with_jacobians(points)
    a, b, c = roots.T
    whiten = np.stack([np.stack([a, b], -1), np.stack([np.zeros_like(c), c], -1)], -2)
    by_pose = np.concatenate([-by_point @ skew(points), by_point], axis=2)
    by_shape = by_point @ cam_from_board.rotation.matrix @ basis
    return CornerDerivatives(
        by_pose=np.nan_to_num(whiten @ by_pose),
        by_params=np.nan_to_num(whiten @ by_params[:, :, columns]),
        by_shape=np.nan_to_num(whiten @ by_shape),
        residuals=np.einsum("nij,nj->ni", whiten, np.nan_to_num(residuals)),
    )


def corner_scores(
    by_pose: FloatArray, by_shared: FloatArray, residuals: FloatArray, inverse: FloatArray, W: FloatArray,
    sigma: FloatArray,
) -> FloatArray:  # fmt: skip
    """(n, K) the rows (D_iᵀ r_i)ᵀ of corners with one pose.

    Args:
        by_pose: P (n, 2, 6); by_shared: J (n, 2, K); residuals: e (n, 2), all of them whitened.
        inverse: H⁻¹ (6, 6) of the pose; W: (6, K); sigma: Σ (K, K), with unit noise.
    """
    D = by_shared - by_pose @ (inverse @ W)
    leverages = by_pose @ inverse @ by_pose.swapaxes(1, 2) + D @ sigma @ D.swapaxes(1, 2)
    values, vectors = np.linalg.eigh(np.eye(2) - leverages)
    roots = vectors / np.sqrt(np.maximum(values, _LEAST_FREEDOM))[:, None] @ vectors.swapaxes(1, 2)
    return np.einsum("nik,nij,nj->nk", D, roots, residuals)


def scaled_inverse(S: FloatArray) -> FloatArray | None:
    """The inverse of a matrix of any scale, None where it is singular."""
    root = np.sqrt(np.diag(S))
    if not np.all(root > 0):
        return None
    values, vectors = np.linalg.eigh(S / np.outer(root, root))
    if not values[0] > 1e-15 * values[-1]:
        return None
    return (vectors / values) @ vectors.T / np.outer(root, root)


def jackknife(reduced: FloatArray, scores: FloatArray, needed: int) -> tuple[FloatArray, BoolArray] | None:
    """(V − 1)/V Σ (θ₋ᵥ − mean)(…)ᵀ, of views or moments that are left out in turn; and what that leaves open (K,).

    A view may be one of two that show a point of the board. Without it the place of this point is open, and the camera
    is not. What is open stays as it is when the view is left out: its own variance is then too small.

    Args:
        reduced: (V, K, K) what each adds to S, scores: (V, K) and to the gradient, with its pose eliminated.
        needed: the first so many must not be open, but for a small part; None where they are.
    """
    S, steps, left_open = reduced.sum(0), [], np.zeros(scores.shape[1], bool)
    if not np.all(np.diag(S) > 0):
        return None
    scale = 1 / np.sqrt(np.diag(S))
    scaled = S * np.outer(scale, scale)
    for part, score in zip(reduced, scores, strict=True):
        without, by = scaled - part * np.outer(scale, scale), scale * score
        step, ways = _solved(without, by), np.zeros((len(S), 0))
        if step is None:
            step, ways = _solved_but_open(scaled, without, by)
        if ways.shape[1] and np.linalg.norm(ways[:needed], 2) > _SMALL_PART:
            return None
        left_open[needed:] |= np.abs(ways[needed:]).max(1, initial=0.0) > _NO_PART
        steps.append(scale * step)
    apart = np.array(steps) - np.mean(steps, axis=0)
    return (len(steps) - 1) / len(steps) * apart.T @ apart, left_open


def _solved(S: FloatArray, score: FloatArray) -> FloatArray | None:
    """S⁻¹ s, None where S may be singular; its diagonal is about one."""
    try:
        root = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return None
    if not np.diag(root).min() ** 2 > _SURE:
        return None
    return np.linalg.solve(root.T, np.linalg.solve(root, score))


def _solved_but_open(S: FloatArray, without: FloatArray, score: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least step that solves what is left of S, and the directions (K, m) that are open in it, of unit length."""
    values, vectors = np.linalg.eigh(without)
    told = values > np.maximum(_OPEN * np.einsum("ik,ij,jk->k", vectors, S, vectors, optimize=True), 1e-15 * values[-1])
    known = vectors[:, told]
    return known @ ((known.T @ score) / values[told]), vectors[:, ~told]
