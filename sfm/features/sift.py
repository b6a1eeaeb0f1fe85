"""SIFT keypoints with root-normalised descriptors.

A SIFT histogram d becomes  √(d / Σd): Euclidean distances of the result are Hellinger distances of the histograms,
and its length is 1. It is stored as uint8 after a multiplication by 512, the unit that COLMAP uses.

Reference:
    Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004.
    Arandjelović & Zisserman, Three things everyone should know to improve object retrieval, CVPR 2012.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from sfm.features.config import FeatureConfig
from sfm.features.keypoints import Described, Selection
from sfm.features.opencv import from_cv2

_DESCRIPTOR_SCALE = 512.0


def detect_sift(grey: UInt8[np.ndarray, "H W"], config: FeatureConfig, select: Selection) -> Described:
    """Keypoints that `select` keeps of all that are found, in px of `grey`, and their descriptors (N, 128)."""
    detector = _detector(config)
    found = detector.detect(grey, None)
    if config.upright:
        found = _upright(found)
    keypoints = from_cv2(found)
    rows = select(keypoints)
    if not len(rows):
        return keypoints[rows], np.zeros((0, 128), np.uint8)
    _, histograms = detector.compute(grey, [found[row] for row in rows])
    return keypoints[rows], root_normalized(histograms)


def sift_memory_bytes(width: float, height: float, config: FeatureConfig) -> int:
    """Memory that `detect_sift` takes while it works.

    SIFT doubles the image and holds `octave_layers` + 3 blurred copies and `octave_layers` + 2 differences in float32;
    all octaves together take 4/3 of the first.
    """
    return int(4 * width * height * 4 * (2 * config.octave_layers + 5) * 4 / 3)


def _upright(found: Sequence[cv2.KeyPoint]) -> list[cv2.KeyPoint]:
    """Each place and scale once, without an orientation."""
    once = {(k.pt, k.size): k for k in found}
    for keypoint in once.values():
        keypoint.angle = 0.0
    return list(once.values())


def _detector(config: FeatureConfig) -> cv2.SIFT:
    # The plain doubling of the first octave moves all keypoints by a quarter of a pixel; the precise one does not.
    return cv2.SIFT.create(
        nfeatures=0,
        nOctaveLayers=config.octave_layers,
        contrastThreshold=config.contrast_threshold,
        edgeThreshold=config.edge_threshold,
        sigma=1.6,
        enable_precise_upscale=True,
    )


def root_normalized(histograms: Float32[np.ndarray, "N D"]) -> UInt8[np.ndarray, "N D"]:
    """√(d / Σd) × 512, rounded and clipped to uint8; the rows have length 512 but for rounding."""
    total = np.maximum(histograms.sum(axis=1, keepdims=True, dtype=np.float64), 1e-12)
    return np.clip(np.rint(_DESCRIPTOR_SCALE * np.sqrt(histograms / total)), 0, 255).astype(np.uint8)
