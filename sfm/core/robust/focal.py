"""Perspective cameras of which the focal length is unknown."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import Mask, Points2D
from sfm.core.cameras import Camera


def centered_pixels(points2D: Points2D, camera: Camera) -> tuple[Points2D, Mask]:
    """Undistorted pixels from the principal point, of a camera of square pixels of the same mean focal length.

    A point at (x, y, z) is seen at f (x, y) / z, whatever f is, exactly if there is no distortion, else as exactly as
    the camera's focal length.

    Returns:
        (N, 2) px, and whether a pixel has a ray in front of the camera; the other rows mean nothing.
    Raises:
        ValueError: the camera is not perspective.
    """
    if camera.model_info.is_fisheye:
        raise ValueError(f"expected a perspective camera, got {camera.model}")
    rays, valid = camera.unproject(points2D)
    valid = valid & np.isfinite(points2D).all(1) & (rays[:, 2] > 0)
    depths = np.where(valid, rays[:, 2], 1.0)
    return camera.mean_focal_length * rays[:, :2] / depths[:, None], valid


def with_focal_length(camera: Camera, focal_px: float) -> Camera:
    """The camera with this mean focal length and the same aspect."""
    params = camera.params.copy()
    params[list(camera.model_info.focal_indices)] *= focal_px / camera.mean_focal_length
    return dataclasses.replace(camera, params=params)
