"""SIFT keypoints with root-normalised descriptors.

A large image is reduced first. With pixel centres at one half, a point of the reduced image and its place in the
full image differ by a pure factor,  x_full = x_reduced · W / w,  with W / w the exact quotient of the two widths.

A SIFT histogram d becomes  √(d / Σd): Euclidean distances of the result are Hellinger distances of the histograms,
and its length is 1. It is stored as uint8 after a multiplication by 512, the unit that COLMAP uses.

Reference:
    Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004.
    Arandjelović & Zisserman, Three things everyone should know to improve object retrieval, CVPR 2012.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from sfm.core.arrays import ImageU8
from sfm.core.errors import ConfigError, Rejected
from sfm.core.scene import Features

_SMALLEST_SIDE_PX = 16
"""Below this there is no second octave, and hardly a keypoint."""
_DESCRIPTOR_SCALE = 512.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """How keypoints are found."""

    max_image_size: int = 1600
    """Longest side in px to which larger images are reduced before detection; 0 keeps the full size. On the
    fountain-P11 photos 1600 px and 3072 px gave the same AUC of relative poses (94.9 at 1°), at 0.44 s against 1.52 s
    an image."""

    max_features: int = 12000
    """The strongest are kept. Of house fronts with more than 8,000 (Herz-Jesus-P8), 12,000 lower the median position
    error from 3.7 to 3.5 mm; matching takes twice the time, as it grows with the square."""

    contrast_threshold: float = 0.02
    """Smallest contrast of a keypoint, for grey values in [0, 1]. Half of OpenCV's default, and equal to COLMAP's:
    0.04 finds half as many keypoints on house fronts."""

    edge_threshold: float = 10.0
    """Largest ratio of principal curvatures; above it a keypoint slides along an edge. Lowe's value."""

    octave_layers: int = 3
    """Scales in an octave. Lowe's value."""

    def __post_init__(self) -> None:
        if self.max_image_size < 0 or 0 < self.max_image_size < _SMALLEST_SIDE_PX:
            raise ConfigError(f"max_image_size must be 0 or at least {_SMALLEST_SIDE_PX} px, got {self.max_image_size}")
        if self.max_features < 1:
            raise ConfigError(f"max_features must be at least 1, got {self.max_features}")


def extract_features(image: ImageU8, config: FeatureConfig = FeatureConfig()) -> Features | Rejected:
    """The strongest SIFT keypoints of an image, in px of the full image.

    The order is that of (y, x, scale, orientation), and coordinates are rounded to float32: what a COLMAP database
    gives back is what was in memory. One place can hold several keypoints that differ in scale or orientation.

    Args:
        image: grey, or RGB.
    Returns:
        Features, or `Rejected`: `image_too_small` or `no_features`.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    reduced = _reduce(grey, config.max_image_size)
    if min(reduced.shape) < _SMALLEST_SIDE_PX:
        return Rejected("image_too_small", f"{grey.shape[1]}×{grey.shape[0]} px")
    keypoints, histograms = _detector(config).detectAndCompute(reduced, None)
    if histograms is None or len(keypoints) == 0:
        return Rejected("no_features", f"{grey.shape[1]}×{grey.shape[0]} px, contrast {config.contrast_threshold}")
    return _features(keypoints, histograms, _full_from_reduced(grey, reduced), config.max_features)


def working_memory_bytes(width: int, height: int, config: FeatureConfig) -> int:
    """Memory that `extract_features` takes for one image while it works.

    SIFT doubles the image and holds `octave_layers` + 3 blurred copies and `octave_layers` + 2 differences in float32;
    all octaves together take 4/3 of the first.
    """
    factor = min(1.0, config.max_image_size / max(width, height)) if config.max_image_size else 1.0
    doubled = 4 * width * height * factor**2
    return int(doubled * 4 * (2 * config.octave_layers + 5) * 4 / 3)


def _detector(config: FeatureConfig) -> cv2.SIFT:
    # The plain doubling of the first octave moves all keypoints by a quarter of a pixel; the precise one does not.
    return cv2.SIFT.create(
        nfeatures=config.max_features,
        nOctaveLayers=config.octave_layers,
        contrastThreshold=config.contrast_threshold,
        edgeThreshold=config.edge_threshold,
        sigma=1.6,
        enable_precise_upscale=True,
    )


def _reduce(grey: UInt8[np.ndarray, "H W"], max_size: int) -> UInt8[np.ndarray, "h w"]:
    """At most `max_size` on the longest side, each pixel the mean of those it covers."""
    height, width = grey.shape
    longest = max(height, width)
    if max_size == 0 or longest <= max_size:
        return grey
    size = max(1, round(width * max_size / longest)), max(1, round(height * max_size / longest))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _full_from_reduced(full: np.ndarray, reduced: np.ndarray) -> tuple[float, float]:
    return full.shape[1] / reduced.shape[1], full.shape[0] / reduced.shape[0]


def _features(
    keypoints: Sequence[cv2.KeyPoint],
    histograms: Float32[np.ndarray, "N D"],
    full_from_reduced: tuple[float, float],
    limit: int,
) -> Features:
    """Columns in px of the full image, sorted, the strongest `limit` of them."""
    columns = np.array([(*k.pt, k.size, k.angle, k.response) for k in keypoints])
    points2D = ((columns[:, :2] + 0.5) * full_from_reduced).astype(np.float32)
    scales = (columns[:, 2] / 2 * np.mean(full_from_reduced)).astype(np.float32)  # size is the diameter 2σ
    orientations = np.deg2rad(columns[:, 3]).astype(np.float32)
    order = np.lexsort((orientations, scales, points2D[:, 0], points2D[:, 1]))
    strongest = order[np.argsort(-columns[order, 4], kind="stable")[:limit]]
    kept = order[np.isin(order, strongest)]
    return Features(
        points2D[kept].astype(np.float64), scales[kept], orientations[kept], root_normalized(histograms[kept])
    )


def root_normalized(histograms: Float32[np.ndarray, "N D"]) -> UInt8[np.ndarray, "N D"]:
    """√(d / Σd) × 512, rounded and clipped to uint8; the rows have length 512 but for rounding."""
    total = np.maximum(histograms.sum(axis=1, keepdims=True, dtype=np.float64), 1e-12)
    return np.clip(np.rint(_DESCRIPTOR_SCALE * np.sqrt(histograms / total)), 0, 255).astype(np.uint8)
