"""The matched keypoints of a pair as pixels, as undistorted pixels and as rays, and the estimates made from them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from sfm.core.arrays import Mask, Matrix3, Points2D
from sfm.core.cameras import Camera
from sfm.core.cameras.undistortion import pinhole_pixels
from sfm.core.errors import Rejected
from sfm.core.geometry.homography import transfer_errors
from sfm.core.geometry.rigid import Rigid3
from sfm.core.robust.fundamental import MatrixEstimate, estimate_fundamental, estimate_homography
from sfm.core.robust.ransac import RansacConfig, required_iterations
from sfm.core.robust.relative_pose import Bearings


class MatchedPair:
    """The matched keypoints of two images, row by row, with what the models under test need of them.

    Attributes:
        perspective: both cameras have pixels of an undistorted pinhole camera, so that F and H make sense.
        guessed: for each camera, whether its focal length is only a guess.
        calibrated: the rays of both cameras are to be trusted.
    """

    def __init__(
        self,
        points1: Points2D,
        points2: Points2D,
        camera1: Camera,
        camera2: Camera,
        ransac: RansacConfig,
        *,
        trust_focal: bool,
        rng: np.random.Generator,
    ) -> None:
        self.points1, self.points2, self.camera1, self.camera2 = points1, points2, camera1, camera2
        self.ransac, self.rng = ransac, rng
        self.bearings1, self.bearings2 = Bearings.of(points1, camera1), Bearings.of(points2, camera2)
        self.count = len(points1)
        prior1, prior2 = camera1.has_prior_focal_length, camera2.has_prior_focal_length
        self.guessed = not (trust_focal or prior1), not (trust_focal or prior2)
        self.perspective = not (camera1.model_info.is_fisheye or camera2.model_info.is_fisheye)
        self.calibrated = not any(self.guessed) or not self.perspective

    def limited(self, sample_size: int, relevant: float) -> RansacConfig:
        """The sampling configuration, ended where `relevant` inliers would have been found."""
        inliers = min(math.ceil(relevant), self.count)
        limit = required_iterations(inliers, self.count, sample_size, self.ransac)
        return dataclasses.replace(self.ransac, max_iterations=max(limit, 1), min_inlier_ratio=0.0)

    def fundamental(self, ransac: RansacConfig) -> MatrixEstimate | Rejected:
        """F on undistorted pixels."""
        return estimate_fundamental(*self._ideal_points(), ransac, rng=self.rng)

    def homography(self, ransac: RansacConfig) -> MatrixEstimate | Rejected:
        """H on undistorted pixels."""
        return estimate_homography(*self._ideal_points(), ransac, rng=self.rng)

    def bearings_under(self, factor: float) -> tuple[Bearings, Bearings]:
        """Rays of both images with the guessed focal lengths multiplied by `factor`."""
        cameras = (self.camera1, self.camera2)
        first, second = (
            _with_focal_factor(camera, factor) if guessed else camera
            for camera, guessed in zip(cameras, self.guessed, strict=True)
        )
        return Bearings.of(self.points1, first), Bearings.of(self.points2, second)

    def transfer_error(self, homography: Matrix3, inliers: Mask) -> float:
        """Median distance in px at which a homography misses the inliers in image 2."""
        first, second = self._ideal_points()
        return float(np.nanmedian(transfer_errors(homography, first[inliers], second[inliers])))

    def transferred(self, homography: Matrix3) -> Mask:
        """The matches that a homography explains."""
        return transfer_errors(homography, *self._ideal_points()) <= self.ransac.max_error_px

    def tri_angle(self, pose: Rigid3, inliers: Mask) -> float:
        """Median angle in radians at which the rays of the inliers meet."""
        turned = pose.rotation @ self.bearings1.rays[inliers]
        cross = np.linalg.norm(np.cross(turned, self.bearings2.rays[inliers]), axis=1)
        cosine = np.einsum("ni,ni->n", turned, self.bearings2.rays[inliers])
        return float(np.median(np.arctan2(cross, cosine)))

    def with_rays(self, inliers: Mask) -> Mask:
        """The inliers that have rays in both images."""
        return inliers & self.bearings1.valid & self.bearings2.valid

    def _ideal_points(self) -> tuple[Points2D, Points2D]:
        first = _ideal_points(self.points1, self.bearings1, self.camera1)
        return first, _ideal_points(self.points2, self.bearings2, self.camera2)


def _with_focal_factor(camera: Camera, factor: float) -> Camera:
    params = camera.params.copy()
    params[list(camera.model_info.focal_indices)] *= factor
    return dataclasses.replace(camera, params=params)


def _ideal_points(points2D: Points2D, bearings: Bearings, camera: Camera) -> Points2D:
    """Pixels of the pinhole camera without the distortion; NaN where the keypoint has no ray in front."""
    if not camera.model_info.extra_indices:
        return points2D
    return pinhole_pixels(bearings.rays, bearings.valid, camera)
