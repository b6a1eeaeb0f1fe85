"""What no camera has, and a file may say nevertheless: found before anything is computed, or allocated, from it."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray
from sfm.core.cameras import CameraModel

_LARGEST_SIDE = 1_000_000
"""Px; the longest panoramas of line cameras have a few hundred thousand."""
_LONGEST = 1e4
"""Times the longer side of the image: such a camera sees 0.006°, telescopes see more."""


def out_of_bounds(model: CameraModel, width: int, height: int, params: FloatArray) -> str:
    """Why there is no such camera, in words; empty where there may be one."""
    if min(width, height) <= 0:
        return f"the image size is {width} x {height}"
    if max(width, height) > _LARGEST_SIDE:
        return f"the image size is {width} x {height}, more than {_LARGEST_SIDE} px along a side"
    if not np.isfinite(params).all():
        return "a parameter is not finite"
    longest = _LONGEST * max(width, height)
    focal, center = (params[list(which)] for which in (model.focal_indices, model.principal_point_indices))
    if np.any(focal <= 0) or np.any(focal > longest):
        return f"the focal lengths are {focal.tolist()}, which must be between 0 and {longest:g} px"
    if np.any(np.abs(center) > longest):
        return f"the principal point is {center.tolist()}, more than {longest:g} px from the image"
    return ""
