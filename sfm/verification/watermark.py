"""Matches between the watermarks or time stamps of two images: near the border, and moved by one translation."""

from __future__ import annotations

import numpy as np

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


def _in_border(points2D: Points2D, camera: Camera, border: float) -> Mask:
    width = border * np.hypot(camera.width, camera.height)
    size = np.array([camera.width, camera.height])
    return ((points2D < width) | (points2D > size - width)).any(1)
