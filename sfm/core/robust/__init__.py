"""Estimation in the presence of wrong data: sampling, local optimisation, one problem per file."""

from sfm.core.robust.absolute_pose import AbsolutePoseEstimate, estimate_absolute_pose, refine_absolute_pose
from sfm.core.robust.alignment import align_robust
from sfm.core.robust.focal_absolute_pose import estimate_absolute_pose_with_focal
from sfm.core.robust.focal_pose import (
    FocalPoseEstimate,
    estimate_relative_pose_one_focal,
    estimate_relative_pose_shared_focal,
)
from sfm.core.robust.fundamental import MatrixEstimate, estimate_fundamental, estimate_homography
from sfm.core.robust.ransac import RansacConfig
from sfm.core.robust.relative_pose import RelativePoseEstimate, estimate_relative_pose, refine_relative_pose

__all__ = [
    "AbsolutePoseEstimate",
    "FocalPoseEstimate",
    "MatrixEstimate",
    "RansacConfig",
    "RelativePoseEstimate",
    "align_robust",
    "estimate_absolute_pose",
    "estimate_absolute_pose_with_focal",
    "estimate_fundamental",
    "estimate_homography",
    "estimate_relative_pose",
    "estimate_relative_pose_one_focal",
    "estimate_relative_pose_shared_focal",
    "refine_absolute_pose",
    "refine_relative_pose",
]
