"""Bundle adjustment; and `refine_motion`, poses from the matches of pairs alone, before there are points."""

from sfm.bundle.adjustment import adjust, squared_errors
from sfm.bundle.covariance import BundleCovariance, covariance, covariance_bytes
from sfm.bundle.motion_only import MotionConfig, MotionResult, refine_motion
from sfm.bundle.motion_problem import MotionProblem, motion_problem
from sfm.bundle.problem import BundleConfig, BundleProblem, BundleResult
from sfm.bundle.reconstruction import free_params_of, problem_from_reconstruction, update_reconstruction
from sfm.bundle.rig_arrays import RigArrays

__all__ = [
    "BundleConfig",
    "BundleCovariance",
    "BundleProblem",
    "BundleResult",
    "MotionConfig",
    "MotionProblem",
    "MotionResult",
    "RigArrays",
    "adjust",
    "covariance",
    "covariance_bytes",
    "free_params_of",
    "motion_problem",
    "problem_from_reconstruction",
    "refine_motion",
    "squared_errors",
    "update_reconstruction",
]
