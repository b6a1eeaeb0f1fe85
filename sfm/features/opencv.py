"""The border to OpenCV's detectors: its versions, and its keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from sfm.core.errors import MissingDependencyError
from sfm.features.keypoints import Keypoints


def created(name: str, *arguments: Any, **options: Any) -> Any:
    """A detector or extractor: OpenCV 5 has moved some into `xfeatures2d`.

    Raises:
        MissingDependencyError: this build of OpenCV has none of this name.
    """
    for place in (cv2, getattr(cv2, "xfeatures2d", None)):
        maker = getattr(place, f"{name}_create", None)
        if maker is not None:
            return maker(*arguments, **options)
    raise MissingDependencyError(f"OpenCV has no {name}", remedy="pip install opencv-contrib-python-headless")


def constant(of: str, name: str) -> int:
    """A constant of one of these classes, wherever it is; its value may differ from version to version."""
    places = (cv2, getattr(cv2, "xfeatures2d", None))
    return next(getattr(place, f"{of}_{name}") for place in places if hasattr(place, f"{of}_{name}"))


def from_cv2(keypoints: Sequence[cv2.KeyPoint], scale_of_size: float = 0.5) -> Keypoints:
    """OpenCV's keypoints, whose coordinates are 0 at the centre of the first pixel.

    Args:
        scale_of_size: σ of a keypoint whose `size` is 1; SIFT's `size` is the diameter 2σ.
    """
    columns = np.array([(*k.pt, k.size, k.angle, k.response) for k in keypoints], np.float64).reshape(-1, 5)
    return Keypoints(
        columns[:, :2] + 0.5,
        (columns[:, 2] * scale_of_size).astype(np.float32),
        np.deg2rad(columns[:, 3]).astype(np.float32),
        columns[:, 4].astype(np.float32),
    )


def descriptions(
    extractor: Any, grey: UInt8[np.ndarray, "H W"], keypoints: Sequence[cv2.KeyPoint]
) -> tuple[list[cv2.KeyPoint], UInt8[np.ndarray, "N B"]]:
    """The keypoints that could be described, as extractors drop those near the border; and their descriptors."""
    width = extractor.descriptorSize()
    if not keypoints:
        return [], np.zeros((0, width), np.uint8)
    described, descriptors = extractor.compute(grey, keypoints)
    if descriptors is None or not len(described):
        return [], np.zeros((0, width), np.uint8)
    return list(described), descriptors
