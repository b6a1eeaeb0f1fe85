"""The settings of feature extraction."""

from __future__ import annotations

import dataclasses
from typing import Literal

from sfm.core.errors import ConfigError

SMALLEST_SIDE_PX = 16
"""Below this there is no second octave, and hardly a keypoint."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """How keypoints are found."""

    max_image_size: int = 3200
    """Longest side in px to which larger images are reduced before detection; 0 keeps the full size. The time grows
    with the square."""

    max_features: int = 12000
    """The strongest are kept. Of house fronts with more than 8,000 (Herz-Jesus-P8), 12,000 lower the median position
    error from 3.7 to 3.5 mm; matching takes twice the time, as it grows with the square."""

    contrast_threshold: float = 0.02
    """Smallest contrast of a keypoint, for grey values in [0, 1]. Half of OpenCV's default, and equal to COLMAP's:
    0.04 finds half as many keypoints on house fronts."""

    enough_features: int = 500
    """Of an image with fewer places, the contrast threshold is halved until there are as many, or it would fall below
    `lowest_contrast`."""

    lowest_contrast: float = 0.004
    """Smallest contrast threshold for images with few features: one grey level in 256."""

    edge_threshold: float = 10.0
    """Largest ratio of principal curvatures; above it a keypoint slides along an edge. Lowe's value."""

    octave_layers: int = 3
    """Scales in an octave. Lowe's value."""

    first_octave: Literal["auto", "doubled", "full"] = "auto"
    """The image that the first octave is: the image itself (full), at twice its size (doubled), or enlarged to
    3,200 px but no more than twice (auto). Most features of small photos are found by the enlargement. Large ones do
    not need it: the eight of Herz-Jesus-P8 give relative poses of AUC 92.0 at 1° at their 3,072 px and 88.6 when
    reduced to 1,600 and doubled again, in the same time."""

    def __post_init__(self) -> None:
        if self.max_image_size < 0 or 0 < self.max_image_size < SMALLEST_SIDE_PX:
            raise ConfigError(f"max_image_size must be 0 or at least {SMALLEST_SIDE_PX} px, got {self.max_image_size}")
        if self.max_features < 1:
            raise ConfigError(f"max_features must be at least 1, got {self.max_features}")
