"""Corners of one scale: Harris, Shi–Tomasi and FAST, placed to a fraction of a pixel, with BRIEF or FREAK.

Two gradients g gᵀ, summed over a window, have the eigenvalues λ₁ ≥ λ₂: a corner is where both are large. Shi and
Tomasi take λ₂, Harris and Stephens λ₁λ₂ − k (λ₁ + λ₂)²; its root is in the same unit, contrast squared. FAST looks for
an arc of brighter or of darker pixels, and is ranked by λ₂ here: its own measure has 255 values.

Reference:
    Harris & Stephens, A combined corner and edge detector, Alvey 1988.
    Shi & Tomasi, Good features to track, CVPR 1994.
    Rosten & Drummond, Machine learning for high-speed corner detection, ECCV 2006.
    Calonder et al., BRIEF, ECCV 2010.  Alahi, Ortiz & Vandergheynst, FREAK, CVPR 2012.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Integer, UInt8

from sfm.features.config import FeatureConfig
from sfm.features.keypoints import Described, Keypoints, Selection
from sfm.features.opencv import created, descriptions, from_cv2

_WINDOW = 5
_HARRIS_K = 0.04
_RESPONSE_OF_CONTRAST = 0.25
"""λ₂ of a corner of contrast c is at least a quarter of c² for angles between some 40° and 140°."""
_SIGMA = 1.5
"""Scale that stands for the windows of these detectors, px."""
_SIZE = 7.0
"""FREAK chooses its pattern by this diameter, which is that of FAST's circle, px."""
_REFINEMENT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 0.005)


def detect_corners(grey: UInt8[np.ndarray, "H W"], config: FeatureConfig, select: Selection) -> Described:
    """Corners of `config.kind` with descriptors (N, 32) or (N, 64)."""
    strength = _strength(grey, harris=config.kind == "harris")
    rows, columns = np.nonzero(_fast(grey, config) if config.kind == "fast" else _maxima(strength, config))
    by_strength = np.argsort(-strength[rows, columns], kind="stable")
    rows, columns = rows[by_strength], columns[by_strength]
    points, once = _refined(grey, np.stack([columns, rows], axis=1).astype(np.float32))
    found = [
        cv2.KeyPoint(float(x), float(y), _SIZE, 0.0, float(response))
        for (x, y), response in zip(points[once], strength[rows[once], columns[once]], strict=True)
    ]
    # All are described, so that those that cannot be, near the border, take no place from others.
    described, descriptors = descriptions(_extractor(config), grey, found)
    keypoints = _with_scale(described)
    kept = select(keypoints)
    return keypoints[kept], descriptors[kept]


def _strength(grey: np.ndarray, *, harris: bool) -> Float32[np.ndarray, "H W"]:
    if harris:
        return np.sqrt(np.maximum(cv2.cornerHarris(grey, _WINDOW, 3, _HARRIS_K), 0))
    return cv2.cornerMinEigenVal(grey, _WINDOW, ksize=3)


def _maxima(strength: np.ndarray, config: FeatureConfig) -> np.ndarray:
    least = _RESPONSE_OF_CONTRAST * config.contrast_threshold**2
    return (strength >= cv2.dilate(strength, np.ones((3, 3), np.uint8))) & (strength > least)


def _fast(grey: np.ndarray, config: FeatureConfig) -> np.ndarray:
    fast = created("FastFeatureDetector", threshold=max(1, round(255 * config.contrast_threshold)))
    corners = np.zeros(grey.shape, np.bool_)
    for keypoint in fast.detect(grey, None):
        corners[round(keypoint.pt[1]), round(keypoint.pt[0])] = True
    return corners


def _refined(
    grey: UInt8[np.ndarray, "H W"], points: Float32[np.ndarray, "N 2"]
) -> tuple[Float32[np.ndarray, "N 2"], Integer[np.ndarray, " M"]]:
    """Corners where all gradients around point from; and, of those that run into one, the row of the first."""
    if not len(points):
        return points, np.zeros(0, np.int64)
    half = _WINDOW // 2 + 1
    moved = cv2.cornerSubPix(grey, points[:, None].copy(), (half, half), (-1, -1), _REFINEMENT)[:, 0]
    size = np.array([grey.shape[1] - 1, grey.shape[0] - 1], np.float32)
    moved = np.clip(moved, 0, size)
    _, first = np.unique(np.rint(moved * 2), axis=0, return_index=True)
    return moved, np.sort(first)


def _with_scale(found: list[cv2.KeyPoint]) -> Keypoints:
    keypoints = from_cv2(found)
    return dataclasses.replace(keypoints, scales=np.full(len(found), _SIGMA, np.float32))


def _extractor(config: FeatureConfig) -> Any:
    if config.corner_descriptor == "freak":
        return created("FREAK", orientationNormalized=not config.upright)
    return created("BriefDescriptorExtractor", bytes=32)
