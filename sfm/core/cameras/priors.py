"""First guesses of a camera: from what a photo says of its lens, or from nothing at all."""

from __future__ import annotations

import math

import numpy as np

from sfm.core.cameras.camera import Camera
from sfm.core.cameras.models import model_by_name

DEFAULT_FOCAL_RATIO = 1.2
"""Focal length over the longer side where nothing is known (45° across): COLMAP's, good for most snapshots."""

_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_EUCM_AS_PINHOLE = {"alpha": 0.0, "beta": 1.0}


def infer_camera(model: str, width: int, height: int, focal_px: float | None = None) -> Camera:
    """A camera without distortion whose principal point is the centre of the image.

    Args:
        focal_px: the focal length, if known; then `has_prior_focal_length` is set.
    Raises:
        ValueError: the model is unknown, or the focal length is not positive and finite.
    """
    if focal_px is not None and not 0.0 < focal_px < math.inf:
        raise ValueError(f"expected a positive focal length in px, got {focal_px}")
    focal = DEFAULT_FOCAL_RATIO * max(width, height) if focal_px is None else focal_px
    values = {"f": focal, "fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    values |= _EUCM_AS_PINHOLE
    info = model_by_name(model)
    params = np.array([values.get(name, 0.0) for name in info.param_names], dtype=np.float64)
    return Camera(model, width, height, params, focal_px is not None and bool(info.focal_indices))


def focal_from_35mm(focal_35mm: float, width: int, height: int) -> float:
    """Focal length in px of a 35 mm equivalent, which is defined by the diagonal: f₃₅ √(w² + h²) / √(36² + 24²)."""
    return focal_35mm * math.hypot(width, height) / _DIAGONAL_35MM


def focal_from_sensor(focal_mm: float, sensor_width_mm: float, width: int, height: int) -> float:
    """Focal length in px from that in mm and the longer side of the sensor, whichever way the image is turned.

    Raises:
        ValueError: the sensor's width is not positive.
    """
    if not sensor_width_mm > 0.0:
        raise ValueError(f"expected a positive sensor width in mm, got {sensor_width_mm}")
    return focal_mm * max(width, height) / sensor_width_mm
