"""What all pairs together say about cameras that a single pair cannot tell."""

from sfm.viewgraph.calibration import FocalConfig, calibrate_focal_lengths, poses_under

__all__ = ["FocalConfig", "calibrate_focal_lengths", "poses_under"]
