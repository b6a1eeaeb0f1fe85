"""Bundle adjustment."""

from sfm.bundle.adjustment import adjust, squared_errors
from sfm.bundle.covariance import BundleCovariance, covariance, covariance_bytes
from sfm.bundle.problem import BundleConfig, BundleProblem, BundleResult
from sfm.bundle.reconstruction import free_params_of, problem_from_reconstruction, update_reconstruction
from sfm.bundle.rig_arrays import RigArrays

__all__ = [
    "BundleConfig",
    "BundleCovariance",
    "BundleProblem",
    "BundleResult",
    "RigArrays",
    "adjust",
    "covariance",
    "covariance_bytes",
    "free_params_of",
    "problem_from_reconstruction",
    "squared_errors",
    "update_reconstruction",
]
