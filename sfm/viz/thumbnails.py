"""Small undistorted pictures of the photos, for frusta that show what each camera saw."""

from __future__ import annotations

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
    scale = min(1.0, max_size / max(camera.width, camera.height))
    small = camera.scaled(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    target = undistorted_camera(small)
    picture = resize(image, small.width, small.height)
    return remap(picture, *undistortion_grid(small, target)), target
