"""Matches between things that were put over the images, not between what the images show.

Time stamps, frames and logos at the border: near the border, and moved by one translation. Logos further inside: at
the very same place in both images and in a small part of them, while the keypoints around have no partners.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from sfm.core.arrays import Mask, Points2D
from sfm.core.cameras import Camera


def is_watermark(
    points2D_1: Points2D,
    points2D_2: Points2D,
    camera1: Camera,
    camera2: Camera,
    *,
    border: float,
    min_ratio: float,
    max_error_px: float,
) -> bool:
    """Whether at least `min_ratio` of the inliers lie in the border of both images and share one translation.

    Args:
        border: width of the border as a fraction of the image diagonal.
    """
    outer = _in_border(points2D_1, camera1, border) & _in_border(points2D_2, camera2, border)
    if not len(outer) or outer.mean() < min_ratio:
        return False
    offsets = points2D_2[outer] - points2D_1[outer]
    # The translation of a majority is found by the median, coordinate by coordinate.
    agreeing = np.linalg.norm(offsets - np.median(offsets, axis=0), axis=1) <= max_error_px
    return bool(agreeing.sum() >= min_ratio * len(outer))


_STILL_PX = 1.0
_STILL_SHARE = 0.9
_MAX_OVERLAY_AREA = 0.3
"""Of the image, for the box around the matches."""


def is_overlay(
    inliers1: Points2D,
    inliers2: Points2D,
    keypoints1: Float64[np.ndarray, "N1 2"],
    keypoints2: Float64[np.ndarray, "N2 2"],
    camera1: Camera,
    camera2: Camera,
) -> bool:
    """Whether the inliers do not move at all, lie in a small box, and are outnumbered by keypoints outside of it.

    Photos from a tripod match all over the image, and those that show little have few keypoints elsewhere.
    """
    if (camera1.width, camera1.height) != (camera2.width, camera2.height) or not len(inliers1):
        return False
    still = np.linalg.norm(inliers2 - inliers1, axis=1) <= _STILL_PX
    if still.mean() < _STILL_SHARE:
        return False
    low, high = np.quantile(inliers1[still], [0.02, 0.98], axis=0)
    if np.prod(high - low) > _MAX_OVERLAY_AREA * camera1.width * camera1.height:
        return False
    outside = [((points < low) | (points > high)).any(1).sum() for points in (keypoints1, keypoints2)]
    return bool(min(outside) > len(inliers1))


def _in_border(points2D: Points2D, camera: Camera, border: float) -> Mask:
    width = border * np.hypot(camera.width, camera.height)
    size = np.array([camera.width, camera.height])
    return ((points2D < width) | (points2D > size - width)).any(1)
