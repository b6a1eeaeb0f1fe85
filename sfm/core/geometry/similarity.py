"""Similarities, Sim(3): `b_from_a @ x_in_a = s R x + t`, and their closed-form estimation.

Tangent vectors are ζ = (ω, υ, λ) with s = exp(λ); exp(ζ) = (exp(ω), W υ, exp λ), where
W = ∫₀¹ exp(τ (λ I + [ω]×)) dτ is evaluated as φ₁(λ I + [ω]×) through the augmented matrix exponential.

References:
    Solà, Deray & Atchuthan, arXiv:1812.01537. Eade, Lie groups for 2D and 3D transformations, 2013.
    Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 1991.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.linalg import expm

from sfm.core.arrays import FloatArray, Points3D, Value, readonly
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew


def _phi1(omega: FloatArray, lam: FloatArray) -> FloatArray:
    """W (..., 3, 3): the integral of the one-parameter group of λ I + [ω]×."""
    augmented = np.zeros((*omega.shape[:-1], 6, 6))
    augmented[..., :3, :3] = skew(omega) + lam[..., None, None] * np.eye(3)
    augmented[..., :3, 3:] = np.eye(3)
    return expm(augmented)[..., :3, 3:]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Sim3(Value):
    """A similarity or a batch of them; `scale` (...) is positive."""

    scale: FloatArray
    rotation: Rotation3
    translation: FloatArray

    def __post_init__(self) -> None:
        s, t = np.asarray(self.scale, dtype=np.float64), readonly(self.translation, (..., 3))
        if s.shape != self.rotation.shape or t.shape[:-1] != self.rotation.shape:
            raise ValueError(
                f"scales {s.shape}, rotations {self.rotation.shape} and translations {t.shape} differ in batch shape"
            )
        if not np.all(s > 0):
            raise ValueError("a scale is not positive")
        object.__setattr__(self, "scale", readonly(s, s.shape))
        object.__setattr__(self, "translation", t)

    @staticmethod
    def identity(shape: tuple[int, ...] = ()) -> Sim3:
        """The identity, repeated to the batch shape."""
        return Sim3(np.ones(shape), Rotation3.identity(shape), np.zeros((*shape, 3)))

    @staticmethod
    def from_rigid(motion: Rigid3) -> Sim3:
        """The same motion, with scale 1."""
        return Sim3(np.ones(motion.shape), motion.rotation, motion.translation)

    @staticmethod
    def exp(zeta: FloatArray) -> Sim3:
        """From tangent vectors (..., 7), (ω, υ, λ)."""
        zeta = np.asarray(zeta, dtype=np.float64)
        omega, upsilon, lam = zeta[..., :3], zeta[..., 3:6], zeta[..., 6]
        t = np.einsum("...ij,...j->...i", _phi1(omega, lam), upsilon)
        return Sim3(np.exp(lam), Rotation3.exp(omega), t)

    def log(self) -> FloatArray:
        """Tangent vectors (..., 7), (ω, υ, λ)."""
        omega, lam = self.rotation.log(), np.log(self.scale)
        upsilon = np.linalg.solve(_phi1(omega, lam), self.translation[..., None])[..., 0]
        return np.concatenate([omega, upsilon, lam[..., None]], -1)

    @property
    def matrix(self) -> FloatArray:
        """Matrices (..., 3, 4), s R | t."""
        linear = self.scale[..., None, None] * self.rotation.matrix
        return np.concatenate([linear, self.translation[..., None]], -1)

    @property
    def shape(self) -> tuple[int, ...]:
        """The batch shape; () for a single similarity."""
        return self.rotation.shape

    def inverse(self) -> Sim3:
        """`a_from_b`."""
        r, s = self.rotation.inverse(), 1 / self.scale
        t = -s[..., None] * np.einsum("...ij,...j->...i", r.matrix, self.translation)
        return Sim3(s, r, t)

    def adjoint(self) -> FloatArray:
        """Ad (..., 7, 7) with `S @ exp(ζ) == exp(Ad ζ) @ S`."""
        r = self.rotation.matrix
        ad = np.zeros((*self.shape, 7, 7))
        ad[..., :3, :3] = r
        ad[..., 3:6, 3:6] = self.scale[..., None, None] * r
        ad[..., 3:6, :3] = skew(self.translation) @ r
        ad[..., 3:6, 6] = -self.translation
        ad[..., 6, 6] = 1
        return ad

    def transform_pose(self, cam_from_world: Rigid3) -> Rigid3:
        """Poses in the new world: `new_from_world.transform_pose(cam_from_world)` is `cam_from_new`.

        Scene units change with the scale, so that points moved by this similarity project to the same pixels.
        """
        cam_from_new = cam_from_world.rotation @ self.rotation.inverse()
        rotated = np.einsum("...ij,...j->...i", cam_from_new.matrix, self.translation)
        return Rigid3(cam_from_new, self.scale[..., None] * cam_from_world.translation - rotated)

    def __matmul__(self, other: Any) -> Any:
        """`c_from_b @ b_from_a` composes; `b_from_a @ x_in_a` moves points (see `Rotation3.__matmul__`)."""
        if isinstance(other, Sim3):
            rotated = np.einsum("...ij,...j->...i", self.rotation.matrix, other.translation)
            return Sim3(
                self.scale * other.scale,
                self.rotation @ other.rotation,
                self.scale[..., None] * rotated + self.translation,
            )
        if isinstance(other, np.ndarray):
            return self.scale[..., None] * (self.rotation @ other) + self.translation
        return NotImplemented

    def __getitem__(self, index: Any) -> Sim3:
        """Selects from the batch."""
        translation = np.expand_dims(self.translation, -2)[index][..., 0, :]
        return Sim3(np.asarray(self.scale[index]), self.rotation[index], translation)

    def __len__(self) -> int:
        return len(self.rotation)


def estimate_similarity(points_in_a: Points3D, points_in_b: Points3D, *, with_scale: bool = True) -> Sim3 | Rejected:
    """The similarity that minimises Σ ‖s R a + t − b‖².

    Two distinct points do not fix the rotation about their line: rejected, as are collinear points.

    Returns:
        `b_from_a`, of scale 1 if not `with_scale`.
    Raises:
        ValueError: the sets differ in length.
    Reference:
        Umeyama, PAMI 1991, eq. 40-43.
    """
    if len(points_in_a) != len(points_in_b):
        raise ValueError(f"{len(points_in_a)} points against {len(points_in_b)}")
    if len(points_in_a) < 3:
        return Rejected("too_few_points", f"{len(points_in_a)} of 3 needed")
    mean_a, mean_b = points_in_a.mean(0), points_in_b.mean(0)
    a, b = points_in_a - mean_a, points_in_b - mean_b
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    spread_a, spread_b = np.sqrt(np.square(a).sum(1).mean()), np.sqrt(np.square(b).sum(1).mean())
    # Coordinates far from the origin are rounded, which lifts a collinear set off its line.
    rounding = 1e-15 * (np.linalg.norm(mean_a) * spread_b + np.linalg.norm(mean_b) * spread_a)
    if not d[1] > 1e-12 * d[0] + rounding:
        return Rejected("collinear_points", f"singular values {d[0]:.3g}, {d[1]:.3g}")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    r = (u * sign) @ vt
    s = float((d * sign).sum() / spread_a**2) if with_scale else 1.0
    return Sim3(np.asarray(s), Rotation3.from_matrix(r), mean_b - s * r @ mean_a)
