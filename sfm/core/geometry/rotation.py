"""Rotations of space, SO(3).

Symbols: q = (w, x, y, z) a unit quaternion, ω a rotation vector of angle θ = |ω|, [ω]× its skew matrix.

    exp(ω) = I + (sin θ / θ) [ω]× + ((1 − cos θ) / θ²) [ω]×²
    Jl(ω)  = I + ((1 − cos θ) / θ²) [ω]× + ((θ − sin θ) / θ³) [ω]×²        exp(ω + δ) ≈ exp(Jl(ω) δ) exp(ω)

Below θ = 1e-4 the coefficients are taken from their Taylor series, exact there to rounding.

Reference:
    Solà, Deray & Atchuthan, A micro Lie theory for state estimation in robotics, arXiv:1812.01537.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from sfm.core.arrays import FloatArray, Value, readonly

_SMALL_ANGLE = 1e-4


def skew(vectors: FloatArray) -> FloatArray:
    """Skew-symmetric matrices (..., 3, 3) with `skew(a) @ b == cross(a, b)`, of vectors (..., 3)."""
    a = np.asarray(vectors, dtype=np.float64)
    out = np.zeros((*a.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -a[..., 2], a[..., 1]
    out[..., 1, 0], out[..., 1, 2] = a[..., 2], -a[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -a[..., 1], a[..., 0]
    return out


def left_jacobian(omega: FloatArray) -> FloatArray:
    """Jl (..., 3, 3) of SO(3) at rotation vectors (..., 3)."""
    omega = np.asarray(omega, dtype=np.float64)
    theta = np.linalg.norm(omega, axis=-1)[..., None, None]
    small = theta < _SMALL_ANGLE
    t = np.where(small, 1.0, theta)
    b = np.where(small, 0.5 - theta**2 / 24, 2 * np.sin(t / 2) ** 2 / t**2)  # 1 − cos t would cancel
    c = np.where(small, 1 / 6 - theta**2 / 120, (t - np.sin(t)) / t**3)
    k = skew(omega)
    return np.eye(3) + b * k + c * (k @ k)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Rotation3(Value):
    """A rotation, or a batch of them: `b_from_a`.

    `wxyz` has shape (..., 4); it is normalised at construction and q and −q are the same rotation.

    Raises:
        ValueError: the last axis is not 4, or a quaternion is zero or not finite.
    """

    wxyz: FloatArray

    def __post_init__(self) -> None:
        q = np.asarray(self.wxyz, dtype=np.float64)
        if q.shape[-1:] != (4,):
            raise ValueError(f"expected quaternions (..., 4), got {q.shape}")
        norm = np.linalg.norm(q, axis=-1, keepdims=True)
        if not np.all((norm > 0) & np.isfinite(norm)):
            raise ValueError("a quaternion is zero or not finite")
        # A unit quaternion is left untouched to the last bit, so that a round trip through a file is exact.
        unit = np.where(np.abs(norm - 1) < 4e-16, q, q / norm)
        object.__setattr__(self, "wxyz", readonly(unit, (..., 4)))

    @staticmethod
    def identity(shape: tuple[int, ...] = ()) -> Rotation3:
        """The identity, repeated to the batch shape."""
        q = np.zeros((*shape, 4))
        q[..., 0] = 1
        return Rotation3(q)

    @staticmethod
    def from_matrix(matrix: FloatArray) -> Rotation3:
        """From rotation matrices (..., 3, 3), by the largest of the four quaternion entries.

        Matrices that are only nearly orthogonal are not projected: the result is then only nearly theirs.

        Reference:
            Shepperd, Quaternion from rotation matrix, J. Guidance and Control 1(3), 1978.
        """
        m = np.asarray(matrix, dtype=np.float64)
        d = np.diagonal(m, axis1=-2, axis2=-1)
        trace = d.sum(-1)
        # Rows of the symmetric matrix 4 q qᵀ; any row is parallel to q, the one of the largest entry is accurate.
        x, y, z = d[..., 0], d[..., 1], d[..., 2]
        rows = np.empty((*m.shape[:-2], 4, 4))
        rows[..., 0, 0], rows[..., 1, 1] = 1 + trace, 1 + x - y - z
        rows[..., 2, 2], rows[..., 3, 3] = 1 - x + y - z, 1 - x - y + z
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            rows[..., 0, k + 1] = rows[..., k + 1, 0] = m[..., j, i] - m[..., i, j]
            rows[..., i + 1, j + 1] = rows[..., j + 1, i + 1] = m[..., i, j] + m[..., j, i]
        best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), -1)
        q = np.take_along_axis(rows, best[..., None, None], -2)[..., 0, :]
        return Rotation3(np.where(q[..., :1] < 0, -q, q))

    @staticmethod
    def exp(omega: FloatArray) -> Rotation3:
        """From rotation vectors (..., 3) in radians."""
        omega = np.asarray(omega, dtype=np.float64)
        theta = np.linalg.norm(omega, axis=-1, keepdims=True)
        small = theta < _SMALL_ANGLE
        t = np.where(small, 1.0, theta)
        half_sinc = np.where(small, 0.5 - theta**2 / 48, np.sin(t / 2) / t)
        return Rotation3(np.concatenate([np.cos(theta / 2), half_sinc * omega], -1))

    def log(self) -> FloatArray:
        """Rotation vectors (..., 3) in radians, of length at most π."""
        q = np.where(self.wxyz[..., :1] < 0, -self.wxyz, self.wxyz)
        v = q[..., 1:]
        s = np.linalg.norm(v, axis=-1, keepdims=True)
        small = s < _SMALL_ANGLE
        t = np.where(small, 1.0, s)
        scale = np.where(small, 2 + s**2 / 3, 2 * np.arctan2(t, q[..., :1]) / t)
        return scale * v

    @property
    def matrix(self) -> FloatArray:
        """Rotation matrices (..., 3, 3)."""
        w, x, y, z = np.moveaxis(self.wxyz, -1, 0)
        m = np.empty((*w.shape, 3, 3))
        m[..., 0, 0], m[..., 0, 1], m[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        m[..., 1, 0], m[..., 1, 1], m[..., 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        m[..., 2, 0], m[..., 2, 1], m[..., 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        return m

    @property
    def shape(self) -> tuple[int, ...]:
        """The batch shape; () for a single rotation."""
        return self.wxyz.shape[:-1]

    @property
    def angle(self) -> FloatArray:
        """Angles of rotation in radians, in [0, π], with the batch shape."""
        return np.asarray(2 * np.arctan2(np.linalg.norm(self.wxyz[..., 1:], axis=-1), np.abs(self.wxyz[..., 0])))

    def inverse(self) -> Rotation3:
        """`a_from_b`."""
        return Rotation3(self.wxyz * np.array([1.0, -1.0, -1.0, -1.0]))

    def adjoint(self) -> FloatArray:
        """Ad (..., 3, 3) with `R @ exp(ω) == exp(Ad ω) @ R`."""
        return self.matrix

    def __matmul__(self, other: Any) -> Any:
        """`c_from_b @ b_from_a` composes; `b_from_a @ x_in_a` rotates points.

        With a batch (I,), points must broadcast against it: a batch of one rotation each takes (I, 3), and
        points (N, 3) for every rotation are given as (N, 1, 3) or by indexing the batch with `[:, None]`.
        """
        if isinstance(other, Rotation3):
            w1, x1, y1, z1 = np.moveaxis(self.wxyz, -1, 0)
            w2, x2, y2, z2 = np.moveaxis(other.wxyz, -1, 0)
            return Rotation3(
                np.stack(
                    [
                        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
                        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
                        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
                        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
                    ],
                    -1,
                )
            )
        if isinstance(other, np.ndarray):
            if other.shape[-1:] != (3,):
                raise ValueError(f"expected points (..., 3), got {other.shape}")
            if self.shape == ():
                return other @ self.matrix.T
            return np.einsum("...ij,...j->...i", self.matrix, other)
        return NotImplemented

    def __getitem__(self, index: Any) -> Rotation3:
        """Selects from the batch."""
        return Rotation3(np.expand_dims(self.wxyz, -2)[index][..., 0, :])

    def __len__(self) -> int:
        return self.wxyz.shape[0] if self.wxyz.ndim > 1 else _no_length("Rotation3")


def _no_length(name: str) -> int:
    raise TypeError(f"a single {name} has no length")
