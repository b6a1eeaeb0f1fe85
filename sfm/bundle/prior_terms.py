"""Residuals of priors and their derivatives, for the damping loop.

An image with pose (R, t) and centre C = −Rᵀ t is moved by a tangent (ω, υ) in the axes of the world: a point X goes to
exp(ω)(X − C) + C + υ before the old pose sees it. So R becomes R exp(ω), C becomes C − exp(−ω) υ, and at zero

    ∂C/∂υ = −I        ∂C/∂ω = 0        ∂(R d)/∂ω = −R [d]×

With W as in `priors.whitening`, b the bias of a group, g the measured direction of gravity and p = R d the expected
one, both in the camera, and θ the angle between them:

    positions   W (C − position − b)                                    bias   b / σ_b
    gravity     θ / sin θ · (g × p) / σ        of length θ / σ
    distances   (|C_i − C_j| − distance) / σ

All have three rows, padded with zeros. Unknowns have numbers: the poses of the I images come first, then the biases of
the groups that have one, in the order of the groups, in the first three of their six columns.
A robust loss ρ scales rows by √ρ' (see `sfm.core.optim.losses`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64, Int32

from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior, Prior, whitening
from sfm.core.arrays import BoolArray, FloatArray, Value
from sfm.core.geometry.rotation import skew
from sfm.core.optim.losses import evaluate_loss

_SMALL_ANGLE = 1e-3
_OPPOSITE = 1e-9
"""Sine of an angle near π below which it is taken as π."""
_Rotations: TypeAlias = Float64[np.ndarray, "I 3 3"]
_Centers: TypeAlias = Float64[np.ndarray, "I 3"]
_Biases: TypeAlias = Float64[np.ndarray, "G 3"]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PriorTerms(Value):
    """Residuals of n terms, whitened and weighted, and their derivatives by at most two unknowns.

    Attributes:
        residuals: (n, 3).
        first, second: (n,) numbers of the unknowns, see the module; second is −1 where there is none.
        jacobian_first, jacobian_second: (n, 3, 6).
    """

    residuals: Float64[np.ndarray, "n 3"]
    first: Int32[np.ndarray, " n"]
    second: Int32[np.ndarray, " n"]
    jacobian_first: Float64[np.ndarray, "n 3 6"]
    jacobian_second: Float64[np.ndarray, "n 3 6"]


def bias_count(priors: Sequence[Prior]) -> int:
    """Number G of groups with a bias."""
    return sum(_has_bias(prior) for prior in priors)


def linearize_priors(
    priors: Sequence[Prior], rotations: _Rotations, centers: _Centers, biases: _Biases
) -> tuple[float, PriorTerms]:
    """Cost ½ Σ ρ of all groups, and their terms in the order of the groups; those of the biases come last.

    Args:
        rotations, centers: of the poses `cam_from_world`.
        biases: of the groups that have one.
    """
    cost, found, bias = 0.0, [], 0
    for prior in priors:
        unknown = len(centers) + bias if _has_bias(prior) else -1
        residuals = prior_residuals(prior, rotations, centers, biases[bias] if unknown >= 0 else np.zeros(3))
        rho, weight = evaluate_loss(prior.loss, np.square(residuals).sum(1), prior.loss_scale)
        cost += 0.5 * float(rho.sum())
        first, second, by_first, by_second = _derivatives(prior, rotations, centers, unknown)
        root = np.sqrt(weight)[:, None]
        found.append((residuals * root, first, second, by_first * root[..., None], by_second * root[..., None]))
        bias += _has_bias(prior)
    bias_cost, bias_terms = _bias_terms(priors, biases, len(centers))
    parts = zip(*found, bias_terms, strict=True)
    return cost + bias_cost, PriorTerms(*(np.concatenate(part) for part in parts))


def prior_cost(priors: Sequence[Prior], rotations: _Rotations, centers: _Centers, biases: _Biases) -> float:
    """The cost alone."""
    cost, bias = _bias_terms(priors, biases, len(centers))[0], 0
    for prior in priors:
        here = biases[bias] if _has_bias(prior) else np.zeros(3)
        squared = np.square(prior_residuals(prior, rotations, centers, here)).sum(1)
        cost += 0.5 * float(evaluate_loss(prior.loss, squared, prior.loss_scale)[0].sum())
        bias += _has_bias(prior)
    return cost


def prior_residuals(prior: Prior, rotations: _Rotations, centers: _Centers, bias: FloatArray) -> FloatArray:
    """(k, 3) residuals of a group in standard deviations, without the loss; `bias` (3,) is 0 where it has none."""
    match prior:
        case PositionPrior():
            return np.einsum("kab,kb->ka", whitening(prior.covariances), _off(prior, centers[prior.images] - bias))
        case GravityPrior():
            across, factor, _, _ = _angular(prior, rotations[prior.images] @ prior.down)
            return (factor / prior.sigmas_rad)[:, None] * across
        case DistancePrior():
            lengths = np.linalg.norm(centers[prior.first] - centers[prior.second], axis=1)
            return ((lengths - prior.distances) / prior.sigmas)[:, None] * np.array([1.0, 0.0, 0.0])


def point_prior_residuals(prior: PointPrior, points3D: Float64[np.ndarray, "P 3"]) -> FloatArray:
    """(k, 3) residuals of control points in standard deviations, without the loss."""
    return _point_residuals(prior, points3D)[1]


def linearize_point_priors(
    priors: Sequence[PointPrior], points3D: Float64[np.ndarray, "P 3"]
) -> tuple[float, FloatArray, FloatArray]:
    """Cost, and what control points add to the normal equations of all points.

    Returns:
        ½ Σ ρ; the information (P, 6) as (xx, xy, xz, yy, yz, zz); the gradient (P, 3).
    """
    cost, V, g = 0.0, np.zeros((len(points3D), 6)), np.zeros((len(points3D), 3))
    rows, columns = np.triu_indices(3)
    for prior in priors:
        W, residuals = _point_residuals(prior, points3D)
        rho, weight = evaluate_loss(prior.loss, np.square(residuals).sum(1), prior.loss_scale)
        cost += 0.5 * float(rho.sum())
        information = np.einsum("k,kca,kcb->kab", weight, W, W)
        np.add.at(V, prior.points, information[:, rows, columns])
        np.add.at(g, prior.points, np.einsum("k,kca,kc->ka", weight, W, residuals))
    return cost, V, g


def point_prior_cost(priors: Sequence[PointPrior], points3D: Float64[np.ndarray, "P 3"]) -> float:
    """The cost alone."""
    cost = 0.0
    for prior in priors:
        squared = np.square(_point_residuals(prior, points3D)[1]).sum(1)
        cost += 0.5 * float(evaluate_loss(prior.loss, squared, prior.loss_scale)[0].sum())
    return cost


def _has_bias(prior: Prior) -> bool:
    return isinstance(prior, PositionPrior) and prior.bias_sigma is not None


def _bias_terms(priors: Sequence[Prior], biases: FloatArray, images: int) -> tuple[float, tuple[np.ndarray, ...]]:
    """What keeps the biases near 0: the cost, and the columns of `PriorTerms`."""
    sigmas = [p.bias_sigma for p in priors if isinstance(p, PositionPrior) and p.bias_sigma is not None]
    if len(biases) != len(sigmas):
        raise ValueError(f"{len(biases)} biases for {len(sigmas)} groups that have one")
    precision = 1 / np.array(sigmas, np.float64).reshape(-1, 1)
    residuals, count = biases * precision, len(sigmas)
    by_bias = np.zeros((count, 3, 6))
    by_bias[:, :, :3] = precision[..., None] * np.eye(3)
    first = np.arange(images, images + count, dtype=np.int32)
    columns = residuals, first, np.full(count, -1, np.int32), by_bias, np.zeros((count, 3, 6))
    return 0.5 * float(np.square(residuals).sum()), columns


def _derivatives(
    prior: Prior, rotations: FloatArray, centers: FloatArray, bias: int
) -> tuple[np.ndarray, np.ndarray, FloatArray, FloatArray]:
    """Numbers of the unknowns of each row and the derivatives of the residuals by them; `bias` is −1 for none."""
    match prior:
        case PositionPrior():
            by_pose, by_bias = np.zeros((2, len(prior.images), 3, 6))
            by_pose[:, :, 3:] = -whitening(prior.covariances)
            if bias >= 0:
                by_bias[:, :, :3] = by_pose[:, :, 3:]
            return prior.images, np.full(len(prior.images), bias, np.int32), by_pose, by_bias
        case GravityPrior():
            by_pose, nothing = np.zeros((2, len(prior.images), 3, 6))
            by_pose[:, :, :3] = _gravity_by_rotation(prior, rotations[prior.images])
            return prior.images, np.full(len(prior.images), -1, np.int32), by_pose, nothing
        case DistancePrior():
            by_first, by_second = np.zeros((2, len(prior.first), 3, 6))
            apart = centers[prior.first] - centers[prior.second]
            lengths = np.linalg.norm(apart, axis=1)
            # Centres that coincide may part in any direction: no derivative, rather than a made-up one.
            scale = np.divide(1 / prior.sigmas, lengths, out=np.zeros(len(lengths)), where=lengths > 0)
            by_first[:, 0, 3:], by_second[:, 0, 3:] = -scale[:, None] * apart, scale[:, None] * apart
            return prior.first, prior.second, by_first, by_second


def _off(prior: PositionPrior | PointPrior, places: FloatArray) -> FloatArray:
    """(k, 3) differences from the expected positions, 0 in coordinates that were not measured."""
    measured = np.isfinite(np.einsum("kaa->ka", prior.covariances))
    return np.subtract(places, prior.positions, out=np.zeros_like(places), where=measured)


def _point_residuals(prior: PointPrior, points3D: FloatArray) -> tuple[FloatArray, FloatArray]:
    W = whitening(prior.covariances)
    return W, np.einsum("kab,kb->ka", W, _off(prior, points3D[prior.points]))


def _angular(prior: GravityPrior, expected: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """g × p (k, 3), f = θ / sin θ, df / d cos θ, and whether g and p are opposite (k,): these get any axis."""
    measured = prior.directions_in_camera
    across, along = np.cross(measured, expected), np.einsum("ka,ka->k", measured, expected)
    opposite = (np.linalg.norm(across, axis=1) < _OPPOSITE) & (along < 0)
    across[opposite] = _OPPOSITE * _any_normal(measured[opposite])
    sine = np.linalg.norm(across, axis=1)
    theta = np.arctan2(sine, along)
    small, safe = theta < _SMALL_ANGLE, np.where(theta < _SMALL_ANGLE, 1.0, sine)
    factor = np.where(small, 1 + theta**2 / 6 + 7 * theta**4 / 360, theta / safe)
    slope = np.where(small, -1 / 3 - 2 * theta**2 / 15, (along * theta / safe - 1) / safe**2)
    return across, factor, slope, opposite


def _any_normal(vectors: FloatArray) -> FloatArray:
    """(k, 3) unit vectors perpendicular to these."""
    axes = np.eye(3)[np.argmin(np.abs(vectors), axis=1)]
    normals = np.cross(vectors, axes)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _gravity_by_rotation(prior: GravityPrior, rotations: FloatArray) -> FloatArray:
    """(k, 3, 3): with p = R d, d(f g × p) = f g × dp + f' (g · dp) g × p and dp = −R [d]× ω.

    Opposite directions only get the derivative of the angle: that of the axis is infinite.
    """
    expected = rotations @ prior.down
    across, factor, slope, opposite = _angular(prior, expected)
    by_direction = factor[:, None, None] * skew(prior.directions_in_camera)
    by_direction += np.einsum("k,ka,kb->kab", slope, across, prior.directions_in_camera)
    axes = across[opposite] / _OPPOSITE
    by_direction[opposite] = np.einsum("ka,kb->kab", axes, np.cross(axes, expected[opposite]))
    return -by_direction @ (rotations @ skew(prior.down)) / prior.sigmas_rad[:, None, None]
