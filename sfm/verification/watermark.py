"""Matches between things that were put over the images, not between what the images show.

Time stamps, frames and logos at the border: near the border, and moved by one translation. Logos further inside: at
the very same place in both images and in a small part of them, while the keypoints around have no partners.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from sfm.core.arrays import Mask, Points2D
from sfm.core.cameras import Camera


def watermark_of(
    points2D_1: Points2D,
    points2D_2: Points2D,
    camera1: Camera,
    camera2: Camera,
    *,
    border: float,
    min_ratio: float,
    max_error_px: float,
) -> Mask | None:
    """The inliers in the border of both images that share one translation, if at least `min_ratio` of all lie in the
    border, and of these as many share it; or None.

    Args:
        border: width of the border as a fraction of the image diagonal.
    """
    outer = _in_border(points2D_1, camera1, border) & _in_border(points2D_2, camera2, border)
    if not len(outer) or outer.mean() < min_ratio:
        return None
    offsets = points2D_2 - points2D_1
    # The translation of a majority is found by the median, coordinate by coordinate.
    agreeing = np.linalg.norm(offsets - np.median(offsets[outer], axis=0), axis=1) <= max_error_px
    return outer & agreeing if (outer & agreeing).sum() >= min_ratio * len(outer) else None


_STILL_PX = 1.0
_STILL_SHARE = 0.9
_MAX_OVERLAY_AREA = 0.3
"""Of the image, for the box around the matches."""


def overlay_of(
    inliers1: Points2D,
    inliers2: Points2D,
    keypoints1: Float64[np.ndarray, "N1 2"],
    keypoints2: Float64[np.ndarray, "N2 2"],
    camera1: Camera,
    camera2: Camera,
) -> Mask | None:
    """The inliers that keep their place, if nearly all do, lie in a small box, and are outnumbered by keypoints outside
    of it; or None.

    Photos from a tripod match all over the image, and those that show little have few keypoints elsewhere.
    """
    if (camera1.width, camera1.height) != (camera2.width, camera2.height) or not len(inliers1):
        return None
    still = np.linalg.norm(inliers2 - inliers1, axis=1) <= _STILL_PX
    if still.mean() < _STILL_SHARE:
        return None
    low, high = np.quantile(inliers1[still], [0.02, 0.98], axis=0)
    if np.prod(high - low) > _MAX_OVERLAY_AREA * camera1.width * camera1.height:
        return None
    outside = [((points < low) | (points > high)).any(1).sum() for points in (keypoints1, keypoints2)]
    return still if min(outside) > len(inliers1) else None


def _in_border(points2D: Points2D, camera: Camera, border: float) -> Mask:
    width = border * np.hypot(camera.width, camera.height)
    size = np.array([camera.width, camera.height])
    return ((points2D < width) | (points2D > size - width)).any(1)
