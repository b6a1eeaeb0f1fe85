"""From an image to its features, whichever detector finds them.

A large image is reduced first. With pixel centres at one half, a point of the reduced image and its place in the
full image differ by a pure factor,  x_full = x_reduced · W / w,  with W / w the exact quotient of the two widths.
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from jaxtyping import UInt8

from sfm.core.arrays import ImageU8
from sfm.core.errors import Rejected
from sfm.core.scene import Features
from sfm.features.config import SMALLEST_SIDE_PX, FeatureConfig
from sfm.features.keypoints import as_features, strongest
from sfm.features.sift import detect_sift, sift_memory_bytes


def extract_features(image: ImageU8, config: FeatureConfig = FeatureConfig()) -> Features | Rejected:
    """The strongest keypoints of an image, in px of the full image.

    The order is that of (y, x, scale, orientation). One place can hold several keypoints that differ in scale or
    orientation.

    Args:
        image: grey, or RGB.
    Returns:
        Features, or `Rejected`: `image_too_small` or `no_features`.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    reduced = _reduced(grey, config.max_image_size)
    if min(reduced.shape) < SMALLEST_SIDE_PX:
        return Rejected("image_too_small", f"{grey.shape[1]}×{grey.shape[0]} px")
    keypoints, descriptors = detect_sift(reduced, config, partial(strongest, limit=config.max_features))
    if len(keypoints) == 0:
        return Rejected("no_features", f"{grey.shape[1]}×{grey.shape[0]} px, contrast {config.contrast_threshold}")
    return as_features(keypoints, descriptors, (grey.shape[1] / reduced.shape[1], grey.shape[0] / reduced.shape[0]))


def working_memory_bytes(width: int, height: int, config: FeatureConfig) -> int:
    """Memory that `extract_features` takes for one image while it works."""
    factor = min(1.0, config.max_image_size / max(width, height)) if config.max_image_size else 1.0
    return sift_memory_bytes(width * factor, height * factor, config)


def _reduced(grey: UInt8[np.ndarray, "H W"], max_size: int) -> UInt8[np.ndarray, "h w"]:
    """At most `max_size` on the longest side, each pixel the mean of those it covers."""
    height, width = grey.shape
    longest = max(height, width)
    if max_size == 0 or longest <= max_size:
        return grey
    size = max(1, round(width * max_size / longest)), max(1, round(height * max_size / longest))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
