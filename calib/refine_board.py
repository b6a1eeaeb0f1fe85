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
from jaxtyping import Float64, Int64

from sfm.core.arrays import BoolArray, FloatArray, Value, Vector, readonly
from sfm.core.geometry.rotation import skew

ShapeKind: TypeAlias = Literal["flat", "scale", "paraboloid", "height", "free"]
SHAPES: tuple[ShapeKind, ...] = get_args(ShapeKind)
_VIEWS_THAT_TELL = 2
"""That show a point, below which photos tell nothing of its place."""
_DEGREE = 4
"""Of what counts as smooth: 38 coefficients for all three axes."""
_NOTHING = 1e-6
"""Part of a direction that is a rounding error."""


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

    def moved_as(self, displacements: Float64[np.ndarray, "P 3"]) -> BoardShape:
        """The board of this family that comes closest to some displacements of its points."""
        if not self.basis.shape[2]:
            return self
        basis, wanted = self.basis.reshape(-1, self.basis.shape[2]), displacements.ravel()
        orthonormal = self.kind in ("height", "free")
        coefficients = basis.T @ wanted if orthonormal else np.linalg.lstsq(basis, wanted, rcond=None)[0]
        return dataclasses.replace(self, coefficients=coefficients)

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


def shape_shown(kind: ShapeKind, points: FloatArray, views: Int64[np.ndarray, " P"]) -> BoardShape:
    """The undeformed board of a family of which so many views show each point; what fewer than two show stays."""
    return board_shape(kind, points, views >= _VIEWS_THAT_TELL)


def shape_still_shown(shape: BoardShape, views: Int64[np.ndarray, " P"]) -> BoardShape:
    """The same board, now that so many views show each point: what fewer than two show goes back to its place."""
    movable = views >= _VIEWS_THAT_TELL
    if shape.kind not in ("height", "free") or np.array_equal(np.any(shape.basis, axis=(1, 2)), movable):
        return shape
    return board_shape(shape.kind, shape.given, movable).moved_as(shape.displacements)


def smooth_shape(kind: ShapeKind, points: FloatArray, movable: BoolArray) -> BoardShape:
    """The undeformed board of what is smooth of a family: polynomials in x and y where every point has its own place.

    The basis is orthonormal, and what movements and a change of size do to the points that may move is left out.
    """
    basis = np.zeros((3 * len(points), 0))
    at = (np.flatnonzero(movable)[:, None] * 3 + [0, 1, 2]).ravel()
    if kind != "flat" and len(at):
        found = board_shape(kind, points, movable).basis if kind in ("scale", "paraboloid") else None
        ways = _smooth(points[movable], kind) if found is None else found.reshape(len(basis), -1)[at]
        moves, _ = np.linalg.qr(_movements(points, points[movable].mean(0), True)[at])
        ways = ways / np.maximum(np.linalg.norm(ways, axis=0), 1e-300)
        left, strengths, _ = np.linalg.svd(ways - moves @ (moves.T @ ways), full_matrices=False)
        basis = np.zeros((len(basis), int(np.sum(strengths > _NOTHING))))
        basis[at] = left[:, : basis.shape[1]]
    smooth = np.ascontiguousarray(basis.reshape(len(points), 3, -1))
    return BoardShape(kind, readonly(points, (None, 3)), smooth, np.zeros(smooth.shape[2]))


def _smooth(points: FloatArray, kind: ShapeKind) -> FloatArray:
    """(3P, m) orthonormal polynomials of up to some degree, for displacements along z or all three axes."""
    low, high = points.min(0), points.max(0)
    x, y = ((2 * points - low - high) / np.maximum(high - low, 1e-300))[:, :2].T
    powers = np.polynomial.legendre.legvander2d(x, y, (_DEGREE, _DEGREE))
    total = np.add.outer(np.arange(_DEGREE + 1), np.arange(_DEGREE + 1)).ravel()
    left, strengths, _ = np.linalg.svd(powers[:, total <= _DEGREE], full_matrices=False)
    left = left[:, strengths > _NOTHING * strengths[0]]
    axes = np.eye(3)[:, 2:] if kind == "height" else np.eye(3)
    return np.kron(left, axes)


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
