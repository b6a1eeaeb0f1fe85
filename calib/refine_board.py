"""The shape of a printed board: linear families of displacements of its points.

    flat         none
    scale        y is longer than x by a factor: printers stretch paper
    paraboloid   z = a (1 − ξ²) + b (1 − η²), ξ and η from −1 to 1 across the board, and the stretch: glued boards bend
    height       every point has its own z
    free         every point has its own x, y and z

Displacements that a movement of the whole board would undo are left out, and for `free` those of a change of size,
which nothing in photos tells: what remains is orthogonal to them, point by point with the same weight. So the true
board is the given one with the least displacement.

Reference:
    Strobl & Hirzinger, More accurate pinhole camera calibration with imperfect planar target, ICCV workshops 2011.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Float64

from sfm.core.arrays import BoolArray, FloatArray, Value, Vector, readonly
from sfm.core.geometry.rotation import skew

ShapeKind: TypeAlias = Literal["flat", "scale", "paraboloid", "height", "free"]
SHAPES: tuple[ShapeKind, ...] = get_args(ShapeKind)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BoardShape(Value):
    """Points `given + basis @ coefficients`.

    Attributes:
        given: (P, 3) as designed.
        basis: (P, 3, S) in units of the board.
        coefficients: (S,), for `scale` and `paraboloid` relative to the board: a stretch, and heights in its units.
    """

    kind: ShapeKind
    given: Float64[np.ndarray, "P 3"]
    basis: Float64[np.ndarray, "P 3 S"]
    coefficients: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", readonly(self.coefficients, (self.basis.shape[2],)))

    @property
    def displacements(self) -> Float64[np.ndarray, "P 3"]:
        """What is added to the given points."""
        return self.basis @ self.coefficients

    @property
    def points3D(self) -> Float64[np.ndarray, "P 3"]:
        """The points of the board in this shape."""
        return self.given + self.displacements

    @property
    def bend(self) -> float:
        """Highest over lowest point along z, in the unit of the board."""
        return float(np.ptp(self.displacements[:, 2])) if len(self.given) else 0.0


def board_shape(kind: ShapeKind, points: FloatArray, movable: BoolArray | None = None) -> BoardShape:
    """The undeformed board of a family.

    Args:
        points: (P, 3) as designed.
        movable: (P,) points that enough views show; of the others' places photos tell nothing. All of them by default.
    Raises:
        ValueError: the family is unknown.
    """
    if kind not in SHAPES:
        raise ValueError(f"unknown board shape {kind!r}; known are {', '.join(SHAPES)}")
    used = np.ones(len(points), bool) if movable is None else movable
    basis = _basis(kind, points, used)
    return BoardShape(kind, readonly(points, (None, 3)), basis, np.zeros(basis.shape[2]))


def _basis(kind: ShapeKind, points: FloatArray, used: np.ndarray) -> FloatArray:
    count = len(points)
    if kind == "flat" or not used.any():
        return np.zeros((count, 3, 0))
    low, high = points[used].min(0), points[used].max(0)
    center, reach = (low + high) / 2, np.maximum((high - low) / 2, 1e-300)
    stretch = np.zeros((count, 3, 1))
    stretch[:, 1, 0] = points[:, 1] - center[1]
    if kind == "scale":
        return stretch
    if kind == "paraboloid":
        bends = np.zeros((count, 3, 2))
        bends[:, 2] = 1 - ((points - center) / reach)[:, :2] ** 2
        return np.concatenate([stretch, bends], 2)
    moves = _movements(points, center, kind == "free")
    axes = [2] if kind == "height" else [0, 1, 2]
    at = (np.flatnonzero(used)[:, None] * 3 + axes).ravel()
    # An orthonormal basis of what is orthogonal to the movements.
    q, _ = np.linalg.qr(moves[at], mode="complete")
    basis = np.zeros((3 * count, len(at) - moves.shape[1]))
    basis[at] = q[:, moves.shape[1] :]
    return np.ascontiguousarray(basis.reshape(count, 3, -1))


def _movements(points: FloatArray, center: FloatArray, free: bool) -> FloatArray:
    """(3P, m) what movements do to the points: along z and the two tilts, or all six and the change of size."""
    arms = points - center
    turns = -skew(arms)
    shifts = np.broadcast_to(np.eye(3), turns.shape)
    if not free:
        return np.concatenate([shifts[:, :, 2:], turns[:, :, :2]], 2).reshape(3 * len(points), -1)
    return np.concatenate([shifts, turns, arms[:, :, None]], 2).reshape(3 * len(points), -1)
