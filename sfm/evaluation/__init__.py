"""How good poses are: alignment, errors, and scores of a model against a reference."""

from sfm.evaluation.accuracy import THRESHOLDS_DEG, area_under_recall, mean_average_accuracy
from sfm.evaluation.alignment import Alignment, align_poses, average_rotation
from sfm.evaluation.compare import PoseComparison, compare_models
from sfm.evaluation.pose_errors import (
    RelativePoseErrors,
    absolute_pose_errors,
    relative_pose_errors,
    trajectory_errors,
)

__all__ = [
    "THRESHOLDS_DEG",
    "Alignment",
    "PoseComparison",
    "RelativePoseErrors",
    "absolute_pose_errors",
    "align_poses",
    "area_under_recall",
    "average_rotation",
    "compare_models",
    "mean_average_accuracy",
    "relative_pose_errors",
    "trajectory_errors",
]
