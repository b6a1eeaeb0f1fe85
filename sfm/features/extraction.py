"""From an image to its features, whichever detector finds them.

A large image is reduced first. With pixel centres at one half, a point of the reduced image and its place in the
full image differ by a pure factor,  x_full = x_reduced · W / w,  with W / w the exact quotient of the two widths.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import UInt8

from sfm.core.arrays import BoolArray, ImageU8
from sfm.core.errors import ConfigError, Rejected
from sfm.core.scene import DescriptorKind, Features
from sfm.features.affine import detect_in_views
from sfm.features.binary import detect_akaze, detect_brisk, detect_orb
from sfm.features.config import NETWORKS, SMALLEST_SIDE_PX, FeatureConfig
from sfm.features.corners import detect_corners
from sfm.features.keypoints import Described, Selection, as_features
from sfm.features.learned import detect_learned
from sfm.features.selection import Selector
from sfm.features.sift import detect_sift, sift_memory_bytes

_LOWERED_AT_MOST = 3
"""Times that the contrast is halved for an image with few features; below an eighth there is only noise."""

_ALL = 1_000_000
_BYTES_A_PIXEL = {"akaze": 160, "aliked": 1500, "disk": 1500}
"""AKAZE keeps some forty images of float32, networks some hundred channels."""

Preparation: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""What is done to the reduced grey image before features are sought."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Extraction:
    """Features, and how they came about.

    Attributes:
        found, masked: keypoints before the choice of the best, and those of them that the mask has taken away.
        contrast_threshold: that of the last search.
    """

    features: Features
    found: int
    masked: int
    contrast_threshold: float


def extract_features(
    image: ImageU8, config: FeatureConfig = FeatureConfig(), mask: BoolArray | None = None
) -> Features | Rejected:
    """The best keypoints of an image, in px of the full image.

    The order is that of (y, x, scale, orientation). One place can hold several keypoints that differ in scale or
    orientation.

    Args:
        image: grey, or RGB.
        mask: (H, W) of the full image; keypoints are kept where it is True.
    Returns:
        Features, or `Rejected`: `image_too_small`, `no_features` or `all_masked`.
    Raises:
        ValueError: the mask is of another size.
        ConfigError: the file of the network cannot be used.
    """
    result = extract(image, config, mask)
    return result.features if isinstance(result, Extraction) else result


def extract(
    image: ImageU8,
    config: FeatureConfig = FeatureConfig(),
    mask: BoolArray | None = None,
    *,
    prepare: Preparation | None = None,
) -> Extraction | Rejected:
    """As `extract_features`, with an account of it.

    Args:
        prepare: is given the reduced grey image, and returns the one in which features are sought.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if mask is not None and mask.shape != grey.shape:
        raise ValueError(f"the mask must have the shape of the image, {grey.shape}, got {mask.shape}")
    reduced = reduced_image(grey, config.max_image_size)
    size = f"{grey.shape[1]}×{grey.shape[0]} px"
    if min(reduced.shape) < SMALLEST_SIDE_PX:
        return Rejected("image_too_small", size)
    full_from_reduced = grey.shape[1] / reduced.shape[1], grey.shape[0] / reduced.shape[0]
    select = Selector(config, (reduced.shape[1], reduced.shape[0]), mask, full_from_reduced)
    wanted, last = prepare(reduced) if prepare else reduced, config
    keypoints, descriptors = detect(wanted, config, select)
    enough = min(config.min_features, config.max_features)
    for lowered in _lowered(config):
        if len(keypoints) >= enough or select.found == select.masked > 0:
            break
        last = lowered
        keypoints, descriptors = detect(wanted, lowered, select)
    if len(keypoints) == 0 and select.masked:
        return Rejected("all_masked", f"all of {select.masked} keypoints")
    if len(keypoints) == 0:
        return Rejected("no_features", f"{size}, contrast {last.contrast_threshold}")
    features = as_features(keypoints, descriptors, descriptor_kind(config), full_from_reduced)
    return Extraction(features, select.found, select.masked, last.contrast_threshold)


def detect(grey: UInt8[np.ndarray, "H W"], config: FeatureConfig, select: Selection) -> Described:
    """What the detector of `config.kind` finds and `select` keeps, in px of `grey`; in simulated views as well."""
    if not config.affine_tilts:
        return _detect(grey, config, select)
    distance = _hamming if descriptor_kind(config) == DescriptorKind.BINARY else _euclidean

    uncut = dataclasses.replace(config, max_features=_ALL)  # the best are chosen from all views together

    def detect_plainly(view: np.ndarray, select_there: Selection) -> Described:
        return _detect(view, uncut, select_there)

    keypoints, descriptors = detect_in_views(grey, config.affine_tilts, detect_plainly, select, distance)
    if config.upright:
        keypoints = dataclasses.replace(keypoints, orientations=np.zeros_like(keypoints.orientations))
    return keypoints, descriptors


def _detect(grey: np.ndarray, config: FeatureConfig, select: Selection) -> Described:
    match config.kind:
        case "sift":
            return detect_sift(grey, config, select)
        case "orb":
            return detect_orb(grey, config, select)
        case "akaze":
            return detect_akaze(grey, config, select)
        case "brisk":
            return detect_brisk(grey, config, select)
        case "harris" | "shi_tomasi" | "fast":
            return detect_corners(grey, config, select)
        case "aliked" | "disk":
            return detect_learned(grey, config, select)
        case "klt":
            raise ConfigError("klt follows corners through a video and finds none in a single image")


def descriptor_kind(config: FeatureConfig) -> DescriptorKind:
    """The kind of descriptors that `extract_features` makes."""
    match config.kind:
        case "sift":
            return DescriptorKind.SIFT
        case "aliked" | "disk":
            return DescriptorKind.LEARNED
        case "klt":
            return DescriptorKind.FOLLOWED
    return DescriptorKind.BINARY


def working_memory_bytes(width: int, height: int, config: FeatureConfig) -> int:
    """Memory that `extract_features` takes for one image while it works; but for SIFT, a cautious estimate."""
    factor = min(1.0, config.max_image_size / max(width, height)) if config.max_image_size else 1.0
    if config.kind == "sift":
        # A simulated view is narrower than the image, and may be doubled where the image is not.
        views = dataclasses.replace(config, first_octave="doubled") if config.affine_tilts else config
        return sift_memory_bytes(width * factor, height * factor, views)
    return int(_BYTES_A_PIXEL.get(config.kind, 40) * width * height * factor**2)


def _lowered(config: FeatureConfig) -> Iterator[FeatureConfig]:
    """With less and less contrast; networks know no contrast."""
    if config.kind in NETWORKS:
        return
    for k in range(1, _LOWERED_AT_MOST + 1):
        yield dataclasses.replace(config, contrast_threshold=config.contrast_threshold / 2**k)


def reduced_image(grey: UInt8[np.ndarray, "H W"], max_size: int) -> UInt8[np.ndarray, "h w"]:
    """At most `max_size` on the longest side, each pixel the mean of those it covers."""
    height, width = grey.shape
    longest = max(height, width)
    if max_size == 0 or longest <= max_size:
        return grey
    size = max(1, round(width * max_size / longest)), max(1, round(height * max_size / longest))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _euclidean(rows1: np.ndarray, rows2: np.ndarray) -> np.ndarray:
    return np.linalg.norm(rows1.astype(np.float32) - rows2.astype(np.float32), axis=1)


def _hamming(rows1: np.ndarray, rows2: np.ndarray) -> np.ndarray:
    return np.bitwise_count(rows1 ^ rows2).sum(axis=1, dtype=np.int64)
