"""Small undistorted pictures of the photos, for frusta that show what each camera saw."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import UInt8

from sfm.core.arrays import ImageU8
from sfm.core.cameras import Camera
from sfm.core.cameras.undistortion import undistorted_camera, undistortion_grid
from sfm.core.imaging.resample import remap, resize

Picture = UInt8[np.ndarray, "h w *channels"]


def thumbnail(image: ImageU8, camera: Camera, *, max_size: int = 512) -> tuple[Picture, Camera]:
    """The image undistorted and no longer than `max_size` px, and the PINHOLE camera that took it.

    The image is made small first: the grid is then small too, and nothing aliases.

    Args:
        image: of any size with the camera's shape; the camera may have been calibrated at another.
    """
    small = scaled_camera(camera, min(1.0, max_size / max(camera.width, camera.height)))
    target = undistorted_camera(small)
    picture = resize(image, small.width, small.height)
    return remap(picture, *undistortion_grid(small, target)), target


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """The camera of the image resized by `scale`, to whole pixels; its corners stay corners."""
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    params = np.array(camera.params)
    info = camera.model_info
    in_x, in_y = width / camera.width, height / camera.height
    for index in (*info.focal_indices, *info.principal_point_indices):
        name = info.param_names[index]
        params[index] *= {"fx": in_x, "cx": in_x, "fy": in_y, "cy": in_y, "f": (in_x + in_y) / 2}[name]
    if info.param_names[:2] == ("w", "h"):
        params = np.array([width, height], dtype=np.float64)
    return dataclasses.replace(camera, width=width, height=height, params=params)
