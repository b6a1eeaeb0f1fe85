"""Robust relative pose of two calibrated cameras of any model."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool

from sfm.core.arrays import FloatArray, Mask, Matrix3, Points2D, Rays, Value, Vector, readonly
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.epipolar import decompose_essential, essential_from_pose, pose_from_essential, ray_jacobians
from sfm.core.geometry.rigid import Rigid3
from sfm.core.robust._problem_kernels import SIZE
from sfm.core.robust.ransac import CompiledProblem, Estimate, RansacConfig, polish, ransac
from sfm.core.robust.two_view import essential_matrix


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RelativePoseEstimate(Value):
    """A relative pose and the pairs that agree with it.

    Attributes:
        cam2_from_cam1: with a translation of unit length; most inliers lie in front of both cameras.
        essential: [t]× R.
        inliers: (N,) within the error bound, whichever side of the cameras they lie on.
        in_front: (N,) inliers that lie in front of both cameras.
        iterations: samples that were drawn.
    """

    cam2_from_cam1: Rigid3
    essential: Matrix3
    inliers: Mask
    in_front: Mask
    iterations: int

    def __post_init__(self) -> None:
        n = len(self.inliers)
        object.__setattr__(self, "essential", readonly(self.essential, (3, 3)))
        object.__setattr__(self, "inliers", readonly(self.inliers, (n,), np.bool_))
        object.__setattr__(self, "in_front", readonly(self.in_front, (n,), np.bool_))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Bearings:
    """Keypoints as a calibrated camera sees them.

    Attributes:
        rays: (N, 3) unit rays.
        jacobians: (N, 3, 2) derivatives of the rays by the pixel.
        pixels_by_ray: (N, 2, 3) derivatives of the pixel by a point on the unit ray.
        valid: (N,) False where the keypoint has no ray; the other rows then mean nothing.
    """

    rays: Rays
    jacobians: FloatArray
    pixels_by_ray: FloatArray
    valid: Mask

    @staticmethod
    def of(points2D: Points2D, camera: Camera) -> Bearings:
        """The bearings of keypoints in the frame of their camera."""
        rays, valid = camera.unproject(points2D)
        _, by_point, _, projects = camera.project_with_jacobians(rays)
        jacobians = ray_jacobians(by_point)
        valid = valid & projects & np.isfinite(jacobians).all((1, 2))
        return Bearings(rays, jacobians, by_point, valid)


def check_lengths(first: np.ndarray, second: np.ndarray) -> None:
    """Raises `ValueError` if the number of rows differs."""
    if len(first) != len(second):
        raise ValueError(f"{len(first)} points against {len(second)}")


def finite_rows(points: FloatArray) -> Mask:
    """Which rows of (N, D) have no NaN and no infinity."""
    return np.asarray(np.isfinite(points).all(axis=1))


def chosen(values: Vector | None, rows: Mask) -> Vector | None:
    """The values of the rows that are True.

    Raises:
        ValueError: there is not one value for each row.
    """
    if values is None:
        return None
    check_lengths(rows, values)
    return values[rows]


def scatter(mask: Bool[np.ndarray, " K"], rows: Mask) -> Mask:
    """`mask`, which holds for the rows that are True, on all rows."""
    out = np.zeros(len(rows), dtype=np.bool_)
    out[rows] = mask
    return out


def estimate_relative_pose(
    points2D_1: Points2D,
    points2D_2: Points2D,
    camera1: Camera,
    camera2: Camera,
    config: RansacConfig = RansacConfig(),
    *,
    rng: np.random.Generator,
    quality: Vector | None = None,
) -> RelativePoseEstimate | Rejected:
    """The relative pose that most pairs of keypoints agree with, by the five-point solver and LO-RANSAC.

    Errors are tangent Sampson errors in px, whatever the camera models. Keypoints without a ray are never inliers.

    Args:
        quality: (N,) larger for pairs that are more likely right (see `ransac`).
    Raises:
        ValueError: the point sets or the qualities differ in length.
    """
    check_lengths(points2D_1, points2D_2)
    return relative_pose_of_bearings(
        Bearings.of(points2D_1, camera1), Bearings.of(points2D_2, camera2), config, rng=rng, quality=quality
    )


def relative_pose_of_bearings(
    bearings1: Bearings,
    bearings2: Bearings,
    config: RansacConfig = RansacConfig(),
    *,
    rng: np.random.Generator,
    quality: Vector | None = None,
) -> RelativePoseEstimate | Rejected:
    """As `estimate_relative_pose`, for keypoints that have been turned into bearings."""
    problem, usable = essential_problem(bearings1, bearings2, config.max_error_px)
    estimate = ransac(problem, config, rng, chosen(quality, usable))
    if not isinstance(estimate, Estimate):
        return estimate
    inliers = scatter(estimate.inliers, usable)
    pose, front = pose_from_essential(
        estimate.model[:9].reshape(3, 3), bearings1.rays[inliers], bearings2.rays[inliers]
    )
    essential = essential_from_pose(pose)
    return RelativePoseEstimate(pose, essential, inliers, scatter(front, inliers), estimate.iterations)


def refine_relative_pose(
    points2D_1: Points2D,
    points2D_2: Points2D,
    camera1: Camera,
    camera2: Camera,
    cam2_from_cam1: Rigid3,
    max_error_px: float = 4.0,
) -> Rigid3:
    """The pose, of unit translation, that minimises a robust loss of the tangent Sampson errors, from a start.

    Raises:
        ValueError: the point sets differ in length, or the start has no translation.
    """
    check_lengths(points2D_1, points2D_2)
    length = np.linalg.norm(cam2_from_cam1.translation)
    if not length > 0:
        raise ValueError("a pose without translation has no essential matrix")
    bearings1, bearings2 = Bearings.of(points2D_1, camera1), Bearings.of(points2D_2, camera2)
    problem, _ = essential_problem(bearings1, bearings2, max_error_px)
    model, _ = polish(problem, flat(essential_from_pose(cam2_from_cam1) / length))
    poses = decompose_essential(model[:9].reshape(3, 3))
    # The start tells which of the four poses of E is meant.
    turns = (poses.rotation.inverse() @ cam2_from_cam1.rotation).angle
    nearest = turns - 1e-9 * (poses.translation @ cam2_from_cam1.translation)
    return poses[int(np.argmin(nearest))]


def flat(matrix: Matrix3) -> FloatArray:
    """The model of a matrix, by rows."""
    model = np.zeros(SIZE)
    model[:9] = matrix.ravel()
    return model


def essential_problem(first: Bearings, second: Bearings, max_error_px: float) -> tuple[CompiledProblem, Mask]:
    """The sampling problem of the pairs of which both keypoints have a ray, and which these are."""
    usable = first.valid & second.valid
    problem = essential_matrix(
        first.rays[usable], second.rays[usable], first.jacobians[usable], second.jacobians[usable], max_error_px
    )
    return problem, usable
