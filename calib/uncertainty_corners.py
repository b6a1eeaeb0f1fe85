"""What a calibration's corners say of its uncertainty, each by its own residual; see `uncertainty`."""

from __future__ import annotations

import dataclasses

import numpy as np

from calib.refine import Calibration, CalibrationConfig
from sfm.core.arrays import FloatArray
from sfm.core.geometry.rotation import skew

_LEAST_FREEDOM = 1e-3
"""Of a residual's direction, below which the fit has followed all of it."""
_LEAST_SHARE = 0.8
_MEDIAN_LENGTH = 1.17741
"""Of a pair of unit normal numbers."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Of each view: H (6, 6), W (6, K), what it adds to S (K, K) and to the gradient (K,) with its pose eliminated."""

    H: FloatArray
    W: FloatArray
    reduced: FloatArray
    scores: FloatArray

    @property
    def S(self) -> FloatArray:
        """(K, K) of all views."""
        return self.reduced.sum(0)


def scaled_inverse(S: FloatArray) -> FloatArray | None:
    """The inverse of a matrix of any scale, None where it is singular."""
    root = np.sqrt(np.diag(S))
    if not np.all(root > 0):
        return None
    values, vectors = np.linalg.eigh(S / np.outer(root, root))
    if not values[0] > 1e-15 * values[-1]:
        return None
    return (vectors / values) @ vectors.T / np.outer(root, root)


def by_corner(calibration: Calibration, parts: Parts, sigma: FloatArray) -> FloatArray:
    """HC2, view by view; with what rejection has hidden."""
    observations, meat = calibration.observations, np.zeros_like(sigma)
    for v, inverse in enumerate(np.linalg.inv(parts.H)):
        rows = slice(observations.offsets[v], observations.offsets[v + 1])
        by_pose, by_shared, residuals = _whitened_derivatives(calibration, v, rows)
        D = by_shared - by_pose @ (inverse @ parts.W[v])
        leverages = by_pose @ inverse @ by_pose.swapaxes(1, 2) + D @ sigma @ D.swapaxes(1, 2)
        values, vectors = np.linalg.eigh(np.eye(2) - leverages)
        roots = vectors / np.sqrt(np.maximum(values, _LEAST_FREEDOM))[:, None] @ vectors.swapaxes(1, 2)
        scores = np.einsum("nik,nij,nj->nk", D, roots, residuals)
        meat += scores.T @ scores
    return sigma @ meat @ sigma / _share_kept(calibration) ** 2


def _whitened_derivatives(calibration: Calibration, v: int, rows: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of the corners of a view: (n, 2, 6) by its pose, (n, 2, K) by what views share, and (n, 2) residuals."""
    observations, shape = calibration.observations, calibration.shape
    pose = calibration.cams_from_board[v]
    at = observations.rows[rows]
    points = pose @ (observations.board[at] + shape.displacements[at])
    _, by_point, by_params, _ = calibration.camera.project_with_jacobians(points)
    by_pose = np.concatenate([-by_point @ skew(points), by_point], axis=2)
    by_shared = by_params[:, :, calibration.columns]
    if len(shape.coefficients):
        by_shared = np.concatenate([by_shared, by_point @ pose.rotation.matrix @ shape.basis[at]], axis=2)
    a, b, c = observations.roots[rows].T
    roots = np.stack([np.stack([a, b], -1), np.stack([np.zeros_like(c), c], -1)], -2)
    residuals = np.einsum("nij,nj->ni", roots, np.nan_to_num(calibration.residuals[rows]))
    return np.nan_to_num(roots @ by_pose), np.nan_to_num(roots @ by_shared), residuals


def _share_kept(calibration: Calibration) -> float:
    """1 − ½ c ρ, with ρ from the lengths between 0.8 c and c; 1 where none was rejected."""
    if not calibration.rejected_corners:
        return 1.0
    a, b, c = calibration.observations.roots.T
    u, v = np.nan_to_num(calibration.residuals).T
    lengths = np.hypot(a * u + b * v, c * v)
    limit = CalibrationConfig().keep_within_sigma * float(np.median(lengths)) / _MEDIAN_LENGTH
    return max(1 - float(np.mean(lengths > 0.8 * limit)) / 0.4, _LEAST_SHARE)
