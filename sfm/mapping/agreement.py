"""Whether matches agree with the poses of a model."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import Mask, Points2D
from sfm.core.cameras import Camera
from sfm.core.geometry.epipolar import essential_from_pose
from sfm.core.geometry.rigid import Rigid3


def matches_on_epipolar_lines(
    cam2_from_cam1: Rigid3,
    camera1: Camera,
    camera2: Camera,
    points2D_1: Points2D,
    points2D_2: Points2D,
    max_error_px: float,
) -> Mask:
    """Which matches (M,) are within `max_error_px` of each other's epipolar lines, to first order (Sampson).

    Any camera model: a pixel is taken to span the same angle everywhere in the image.
    """
    rays1, rays2 = camera1.unproject(points2D_1)[0], camera2.unproject(points2D_2)[0]
    pixel1, pixel2 = 1 / camera1.mean_focal_length, 1 / camera2.mean_focal_length
    essential = essential_from_pose(cam2_from_cam1)
    line_in_2, line_in_1 = rays1 @ essential.T, rays2 @ essential
    gradient = np.hypot(
        pixel2 * np.linalg.norm(line_in_2[:, :2], axis=1), pixel1 * np.linalg.norm(line_in_1[:, :2], axis=1)
    )
    return np.abs(np.einsum("ni,ni->n", rays2, line_in_2)) <= max_error_px * gradient
