"""ORB, AKAZE and BRISK: keypoints at several scales with descriptors of bits.

Each has its own way of losing half a pixel in a pyramid. What comes out of here is free of it: a photo turned by 180°
gives the turned keypoints (median difference 0.00 px for all three; up to 0.8 px for OpenCV's own coordinates of ORB).

Reference:
    Rublee et al., ORB, ICCV 2011.
    Alcantarilla, Nuevo & Bartoli, Fast explicit diffusion in nonlinear scale spaces, BMVC 2013.
    Leutenegger, Chli & Siegwart, BRISK, ICCV 2011.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from sfm.features.config import FeatureConfig
from sfm.features.keypoints import Described, Keypoints, Selection
from sfm.features.opencv import constant, created, descriptions, from_cv2

_MANY = 10**6

_ORB_STEP, _ORB_LEVELS, _ORB_PATCH = 1.2, 8, 31

_BRISK_OCTAVES, _BRISK_SIZE = 3, 12.0
_BRISK_MULTIPLE = 12
"""Three octaves and the three between them shrink such widths and heights by exactly 1, 1.5, 2, 3, 4, 6."""

_AKAZE_SIZE = 3.0
"""OpenCV's `size` of a keypoint with σ = 1."""


def detect_orb(grey: UInt8[np.ndarray, "H W"], config: FeatureConfig, select: Selection) -> Described:
    """FAST corners of a pyramid, with turned BRIEF descriptors (N, 32)."""
    orb = created(
        "ORB", nfeatures=_MANY, scaleFactor=_ORB_STEP, nlevels=_ORB_LEVELS, patchSize=_ORB_PATCH,
        fastThreshold=_grey_levels(config),
    )  # fmt: skip
    found = orb.detect(grey, None)
    if config.upright:
        for keypoint in found:
            keypoint.angle = 0.0
    rows = select(_in_image(found, grey))
    described, descriptors = descriptions(orb, grey, [found[row] for row in rows])
    return _in_image(described, grey), descriptors


def _in_image(keypoints: Sequence[cv2.KeyPoint], grey: np.ndarray) -> Keypoints:
    """ORB's keypoints at their places in the image.

    OpenCV multiplies coordinates with the pixel's centre at 0, so that the keypoints of level k move by ½ (1.2ᵏ − 1);
    and by 1.2ᵏ, while the size of the level was rounded.
    """
    columns = from_cv2(keypoints, 1 / _ORB_PATCH)
    step = _ORB_STEP ** np.array([k.octave for k in keypoints], np.float64)[:, None]
    size = np.array([grey.shape[1], grey.shape[0]], np.float64)
    in_level = (columns.points2D - 0.5) / step + 0.5
    return dataclasses.replace(columns, points2D=in_level * size / np.rint(size / step))


def detect_akaze(grey: UInt8[np.ndarray, "H W"], config: FeatureConfig, select: Selection) -> Described:
    """Maxima of the Hessian in a scale space that spares edges, with M-LDB descriptors (N, 61)."""
    kind = constant("AKAZE", "DESCRIPTOR_MLDB_UPRIGHT" if config.upright else "DESCRIPTOR_MLDB")
    # The determinant of the Hessian grows with the square of the contrast.
    akaze = created("AKAZE", descriptor_type=kind, threshold=config.contrast_threshold**2)
    # Its scale space takes most of the time: all are described, so that it is built once.
    found, descriptors = akaze.detectAndCompute(grey, None)
    keypoints = from_cv2(found, 1 / _AKAZE_SIZE)
    rows = select(keypoints)
    if descriptors is None:
        descriptors = np.zeros((0, akaze.descriptorSize()), np.uint8)
    if config.upright:
        keypoints = dataclasses.replace(keypoints, orientations=np.zeros_like(keypoints.orientations))
    return keypoints[rows], descriptors[rows]


def detect_brisk(grey: UInt8[np.ndarray, "H W"], config: FeatureConfig, select: Selection) -> Described:
    """AGAST corners between octaves, with descriptors (N, 64) of a pattern of rings."""
    brisk = created("BRISK", thresh=_grey_levels(config), octaves=_BRISK_OCTAVES)
    height, width = grey.shape
    margins = -height % _BRISK_MULTIPLE, -width % _BRISK_MULTIPLE
    # Otherwise OpenCV's coordinates are short by as much as the size of a layer was rounded off.
    padded = cv2.copyMakeBorder(grey, 0, margins[0], 0, margins[1], cv2.BORDER_REPLICATE)
    found = [k for k in brisk.detect(padded, None) if k.pt[0] <= width - 0.5 and k.pt[1] <= height - 0.5]
    rows = select(from_cv2(found, 1 / _BRISK_SIZE))
    described, descriptors = descriptions(brisk, padded, [found[row] for row in rows])
    return from_cv2(described, 1 / _BRISK_SIZE), descriptors


def _grey_levels(config: FeatureConfig) -> int:
    return max(1, round(255 * config.contrast_threshold))
