"""Errors of camera poses: absolute after an alignment, relative between pairs, and along a trajectory.

Absolute, for camera k with estimate and truth in the same frame:

    rotation  ∠(R_k (R_k*)ᵀ)            position  ‖c_k − c_k*‖

Relative, for an ordered pair (i, j) with R_ij = R_j R_iᵀ and t_ij = t_j − R_ij t_i; needs no alignment:

    rotation  ∠(R_ij (R_ij*)ᵀ)          direction  ∠(t_ij, t_ij*)          error  e_ij = max of the two.

The direction keeps its sign: a reconstruction knows front from back, unlike an essential matrix. Where the true
baseline ‖t_ij*‖ is below a given length its direction means nothing, and the error is that of the rotation alone.
A pair of which an image is missing has error ∞. All of this is what COLMAP's benchmark does.

Trajectory, for images in order: ATE is the root mean square of the position errors after alignment; RPE compares
the motion over `step` images, D_k = P_k (P_{k+step})⁻¹ with P = cam_from_world,

    rotation  ∠(R_D (R_D*)ᵀ)            translation  ‖D_k⁻¹ D_k*‖ (its translation part).

References:
    COLMAP, benchmark/reconstruction/evaluation (relative errors).
    Sturm, Engelhard, Endres, Burgard & Cremers, A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import FloatArray, Value, Vector, readonly
from sfm.core.geometry.rigid import Rigid3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RelativePoseErrors(Value):
    """Errors of the K (K − 1) ordered pairs (i, j), i ≠ j, of K images, in lexicographic order, in degrees.

    Attributes:
        rotation_deg: ∞ where an image of the pair is missing.
        direction_deg: of the translation; 0 where the true baseline is too short, ∞ where an image is missing.
    """

    rotation_deg: Vector
    direction_deg: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation_deg", readonly(self.rotation_deg, (None,)))
        object.__setattr__(self, "direction_deg", readonly(self.direction_deg, (len(self.rotation_deg),)))

    @property
    def error_deg(self) -> Vector:
        """The larger of the two."""
        return np.maximum(self.rotation_deg, self.direction_deg)


def absolute_pose_errors(cams_from_world: Rigid3, true_cams_from_world: Rigid3) -> tuple[Vector, Vector]:
    """Rotation errors in degrees and position errors in scene units of poses (K,) given in the true world."""
    rotation = (cams_from_world.rotation @ true_cams_from_world.rotation.inverse()).angle
    return np.rad2deg(rotation), np.linalg.norm(cams_from_world.center - true_cams_from_world.center, axis=-1)


def relative_pose_errors(
    cams_from_world: Rigid3,
    true_cams_from_world: Rigid3,
    *,
    present: np.ndarray | None = None,
    min_baseline: float = 0.0,
) -> RelativePoseErrors:
    """Errors of the relative poses of all ordered pairs.

    Args:
        cams_from_world: estimates (K,), in any frame and scale.
        true_cams_from_world: (K,)
        present: (K,) False where there is no estimate (the row of `cams_from_world` is then ignored).
        min_baseline: length in units of the truth below which a pair's direction does not count.
    Raises:
        ValueError: the batches differ in length.
    """
    count = len(true_cams_from_world)
    if len(cams_from_world) != count:
        raise ValueError(f"{len(cams_from_world)} poses against {count}")
    registered = np.ones(count, dtype=bool) if present is None else np.asarray(present, dtype=bool)
    rows = [_errors_from(i, cams_from_world, true_cams_from_world, registered, min_baseline) for i in range(count)]
    rotation = np.stack([row[0] for row in rows]) if rows else np.zeros((0, 0))
    direction = np.stack([row[1] for row in rows]) if rows else np.zeros((0, 0))
    others = ~np.eye(count, dtype=bool)
    return RelativePoseErrors(rotation[others], direction[others])


def _errors_from(
    i: int, cams_from_world: Rigid3, true_cams_from_world: Rigid3, registered: np.ndarray, min_baseline: float
) -> tuple[Vector, Vector]:
    """Errors of the pairs (i, j) for all j."""
    others_from_this = cams_from_world @ cams_from_world[i].inverse()
    true_others_from_this = true_cams_from_world @ true_cams_from_world[i].inverse()
    rotation = np.rad2deg((others_from_this.rotation @ true_others_from_this.rotation.inverse()).angle)
    direction = np.rad2deg(angle_between(others_from_this.translation, true_others_from_this.translation))
    direction[np.linalg.norm(true_others_from_this.translation, axis=1) < min_baseline] = 0
    missing = ~(registered & registered[i])
    rotation[missing] = direction[missing] = np.inf
    return rotation, direction


def angle_between(vectors1: FloatArray, vectors2: FloatArray) -> FloatArray:
    """Angles in radians between vectors (..., 3), accurate at 0 and π; 0 between two zero vectors, π/2 to one.

    Reference:
        Kahan, How futile are mindless assessments of roundoff in floating-point computation?, 2006, §12.
    """
    length1 = np.linalg.norm(vectors1, axis=-1, keepdims=True)
    length2 = np.linalg.norm(vectors2, axis=-1, keepdims=True)
    p, q = vectors1 * length2, vectors2 * length1
    angle = 2 * np.arctan2(np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1))
    lone_zero = (length1[..., 0] == 0) ^ (length2[..., 0] == 0)
    return np.where(lone_zero, np.pi / 2, angle)


def trajectory_errors(cams_from_world: Rigid3, true_cams_from_world: Rigid3, *, step: int = 1) -> tuple[Vector, Vector]:
    """RPE: errors of the motions over `step` images of a sequence, in degrees and in scene units.

    The estimate must have the truth's scale (align it first).

    Raises:
        ValueError: `step` is not positive.
    """
    if step < 1:
        raise ValueError(f"step must be positive, got {step}")
    count = max(0, len(cams_from_world) - step)
    motions = cams_from_world[:count] @ cams_from_world[len(cams_from_world) - count :].inverse()
    true_motions = true_cams_from_world[:count] @ true_cams_from_world[len(cams_from_world) - count :].inverse()
    difference = motions.inverse() @ true_motions
    return np.rad2deg(difference.rotation.angle), np.linalg.norm(difference.translation, axis=-1)
