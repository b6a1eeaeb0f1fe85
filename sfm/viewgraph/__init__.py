"""What all pairs together say about cameras that a single pair cannot tell."""

from sfm.viewgraph.calibration import FocalConfig, calibrate_focal_lengths, poses_under
from sfm.viewgraph.cycles import CycleConfig, CycleConsistency, cycle_consistency, without_contradictions

__all__ = [
    "CycleConfig",
    "CycleConsistency",
    "FocalConfig",
    "calibrate_focal_lengths",
    "cycle_consistency",
    "poses_under",
    "without_contradictions",
]
