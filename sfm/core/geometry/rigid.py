"""Rigid motions, SE(3): `b_from_a @ x_in_a = R x + t`.

Tangent vectors are ξ = (ω, υ), rotation first; exp(ξ) = (exp(ω), Jl(ω) υ). Updates act on the left.
A camera's pose is `cam_from_world`; its centre in the world is −Rᵀ t.

Reference:
    Solà, Deray & Atchuthan, A micro Lie theory for state estimation in robotics, arXiv:1812.01537.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from sfm.core.arrays import FloatArray, Value, readonly
from sfm.core.geometry.rotation import Rotation3, left_jacobian, skew


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Rigid3(Value):
    """A rigid motion or a batch of them; `translation` (..., 3) has the batch shape of `rotation`."""

    rotation: Rotation3
    translation: FloatArray

    def __post_init__(self) -> None:
        t = readonly(self.translation, (..., 3))
        if t.shape[:-1] != self.rotation.shape:
            raise ValueError(f"rotations {self.rotation.shape} and translations {t.shape} differ in batch shape")
        object.__setattr__(self, "translation", t)

    @staticmethod
    def identity(shape: tuple[int, ...] = ()) -> Rigid3:
        """The identity, repeated to the batch shape."""
        return Rigid3(Rotation3.identity(shape), np.zeros((*shape, 3)))

    @staticmethod
    def from_matrix(matrix: FloatArray) -> Rigid3:
        """From matrices (..., 3, 4) or (..., 4, 4)."""
        m = np.asarray(matrix, dtype=np.float64)
        return Rigid3(Rotation3.from_matrix(m[..., :3, :3]), m[..., :3, 3])

    @staticmethod
    def stack(motions: list[Rigid3]) -> Rigid3:
        """A batch (I,) of single motions; an empty list gives an empty batch."""
        if not motions:
            return Rigid3.identity((0,))
        return Rigid3(
            Rotation3(np.stack([m.rotation.wxyz for m in motions])), np.stack([m.translation for m in motions])
        )

    @staticmethod
    def exp(xi: FloatArray) -> Rigid3:
        """From tangent vectors (..., 6), (ω, υ)."""
        xi = np.asarray(xi, dtype=np.float64)
        omega, upsilon = xi[..., :3], xi[..., 3:]
        t = np.einsum("...ij,...j->...i", left_jacobian(omega), upsilon)
        return Rigid3(Rotation3.exp(omega), t)

    def log(self) -> FloatArray:
        """Tangent vectors (..., 6), (ω, υ)."""
        omega = self.rotation.log()
        upsilon = np.linalg.solve(left_jacobian(omega), self.translation[..., None])[..., 0]
        return np.concatenate([omega, upsilon], -1)

    @property
    def matrix(self) -> FloatArray:
        """Matrices (..., 3, 4)."""
        return np.concatenate([self.rotation.matrix, self.translation[..., None]], -1)

    @property
    def shape(self) -> tuple[int, ...]:
        """The batch shape; () for a single motion."""
        return self.rotation.shape

    @property
    def center(self) -> FloatArray:
        """−Rᵀ t (..., 3): for a pose `cam_from_world`, the camera's centre in the world."""
        return -np.einsum("...ji,...j->...i", self.rotation.matrix, self.translation)

    def inverse(self) -> Rigid3:
        """`a_from_b`."""
        return Rigid3(self.rotation.inverse(), self.center)

    def adjoint(self) -> FloatArray:
        """Ad (..., 6, 6) with `T @ exp(ξ) == exp(Ad ξ) @ T`."""
        r = self.rotation.matrix
        ad = np.zeros((*self.shape, 6, 6))
        ad[..., :3, :3] = ad[..., 3:, 3:] = r
        ad[..., 3:, :3] = skew(self.translation) @ r
        return ad

    def __matmul__(self, other: Any) -> Any:
        """`c_from_b @ b_from_a` composes; `b_from_a @ x_in_a` moves points (see `Rotation3.__matmul__`)."""
        if isinstance(other, Rigid3):
            rotated = np.einsum("...ij,...j->...i", self.rotation.matrix, other.translation)
            return Rigid3(self.rotation @ other.rotation, rotated + self.translation)
        if isinstance(other, np.ndarray):
            return self.rotation @ other + self.translation
        return NotImplemented

    def __getitem__(self, index: Any) -> Rigid3:
        """Selects from the batch."""
        return Rigid3(self.rotation[index], np.expand_dims(self.translation, -2)[index][..., 0, :])

    def __len__(self) -> int:
        return len(self.rotation)
