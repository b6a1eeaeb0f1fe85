"""Robust relative pose of perspective cameras with an unknown focal length, shared or of one of them."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Points2D, Value, Vector, readonly
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.epipolar import pose_from_essential
from sfm.core.geometry.minimal._six_point_kernels import (
    MAX_ONE_SIDED_SOLUTIONS,
    MAX_SHARED_SOLUTIONS,
)
from sfm.core.geometry.rigid import Rigid3
from sfm.core.robust._focal_views_kernels import FocalViews
from sfm.core.robust.focal import centered_pixels, with_focal_length
from sfm.core.robust.ransac import CompiledProblem, Estimate, RansacConfig, Solver, ransac
from sfm.core.robust.relative_pose import check_lengths, chosen, finite_rows, scatter


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class FocalPoseEstimate(Value):
    """A relative pose, the cameras with the focal length that belongs to it, and the pairs that agree with them.

    Attributes:
        cam2_from_cam1: with a translation of unit length; most inliers lie in front of both cameras.
        camera1: with the estimated focal length, as camera2 if it is shared.
        inliers: (N,) within the error bound, whichever side of the cameras they lie on.
        in_front: (N,) inliers that lie in front of both cameras.
        iterations: samples that were drawn.
    """

    cam2_from_cam1: Rigid3
    camera1: Camera
    camera2: Camera
    inliers: Mask
    in_front: Mask
    iterations: int

    def __post_init__(self) -> None:
        n = len(self.inliers)
        object.__setattr__(self, "inliers", readonly(self.inliers, (n,), np.bool_))
        object.__setattr__(self, "in_front", readonly(self.in_front, (n,), np.bool_))


def estimate_relative_pose_shared_focal(
    points2D_1: Points2D,
    points2D_2: Points2D,
    camera: Camera,
    config: RansacConfig = RansacConfig(),
    *,
    rng: np.random.Generator,
    quality: Vector | None = None,
) -> FocalPoseEstimate | Rejected:
    """The relative pose of two photos by one camera, and its focal length, by the six-point solver and LO-RANSAC.

    Errors are Sampson distances in px of the undistorted image. The focal length of `camera` is used for its
    distortion only. It stays undetermined, and the result is then any that explains the pairs, if the optical axes are
    parallel, if they meet at one distance from both cameras (an object on a turntable), or in a planar scene.

    Args:
        camera: perspective, with the true principal point and aspect.
        quality: (N,) larger for pairs that are more likely right (see `ransac`).
    Raises:
        ValueError: the point sets or the qualities differ in length, or the camera is not perspective.
    """
    unit_px = 0.5 * float(np.hypot(camera.width, camera.height))
    first, second = _centered(points2D_1, camera) / unit_px, _centered(points2D_2, camera) / unit_px
    solver = Solver(6, MAX_SHARED_SOLUTIONS)
    return _estimated(first, second, camera, camera, True, unit_px, solver, config, rng, quality)


def estimate_relative_pose_one_focal(
    points2D_1: Points2D,
    points2D_2: Points2D,
    camera1: Camera,
    camera2: Camera,
    config: RansacConfig = RansacConfig(),
    *,
    rng: np.random.Generator,
    quality: Vector | None = None,
) -> FocalPoseEstimate | Rejected:
    """As `estimate_relative_pose_shared_focal`, for the focal length of camera 1 beside a calibrated camera 2.

    It stays undetermined if the optical axis of camera 1 passes through the centre of camera 2.

    Raises:
        ValueError: the point sets or the qualities differ in length, or a camera is not perspective.
    """
    unit_px = camera2.mean_focal_length
    first, second = _centered(points2D_1, camera1) / unit_px, _centered(points2D_2, camera2) / unit_px
    solver = Solver(6, MAX_ONE_SIDED_SOLUTIONS)
    return _estimated(first, second, camera1, camera2, False, unit_px, solver, config, rng, quality)


def _estimated(
    first: Points2D,
    second: Points2D,
    camera1: Camera,
    camera2: Camera,
    shared: bool,
    unit_px: float,
    solver: Solver,
    config: RansacConfig,
    rng: np.random.Generator,
    quality: Vector | None,
) -> FocalPoseEstimate | Rejected:
    """The estimate from points that are counted from the principal points, in the unit of the focal length."""
    check_lengths(first, second)
    usable = finite_rows(first) & finite_rows(second)
    data = np.ascontiguousarray(np.concatenate([first, second], axis=1)[usable].T)
    problem = CompiledProblem(FocalViews(shared, data), solver, config.max_error_px / unit_px)
    estimate = ransac(problem, config, rng, chosen(quality, usable))
    if not isinstance(estimate, Estimate):
        return estimate
    inliers, focal = scatter(estimate.inliers, usable), float(np.exp(estimate.model[9]))
    back1, back2 = np.diag([focal, focal, 1.0]), np.diag([focal, focal, 1.0]) if shared else np.eye(3)
    essential = back2 @ estimate.model[:9].reshape(3, 3) @ back1
    pose, front = pose_from_essential(
        essential, _rays(first[inliers], focal), _rays(second[inliers], focal if shared else 1.0)
    )
    camera1 = with_focal_length(camera1, focal * unit_px)
    return FocalPoseEstimate(
        pose, camera1, camera1 if shared else camera2, inliers, scatter(front, inliers), estimate.iterations
    )


def _centered(points2D: Points2D, camera: Camera) -> Points2D:
    """`centered_pixels`, NaN where there is none."""
    pixels, valid = centered_pixels(points2D, camera)
    return np.where(valid[:, None], pixels, np.nan)


def _rays(points2D: Points2D, focal: float) -> FloatArray:
    rays = np.column_stack([points2D, np.full(len(points2D), focal)])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
