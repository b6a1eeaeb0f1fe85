"""The settings of feature extraction."""

from __future__ import annotations

import dataclasses
from typing import Literal, TypeAlias

from sfm.core.errors import ConfigError

SMALLEST_SIDE_PX = 16
"""Below this there is no second octave, and hardly a keypoint."""

FeatureKind: TypeAlias = Literal[
    "sift", "orb", "akaze", "brisk", "harris", "shi_tomasi", "fast", "aliked", "disk", "klt"
]
NETWORKS: tuple[FeatureKind, ...] = ("aliked", "disk")
"""Those that need an ONNX file."""
CornerDescriptor: TypeAlias = Literal["brief", "freak"]
Spreading: TypeAlias = Literal["strongest", "even"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """How keypoints are found."""

    kind: FeatureKind = "sift"
    """Who finds and describes them: `sift`; `orb`, `akaze`, `brisk` with binary descriptors of their own; the corners
    of `harris`, `shi_tomasi`, `fast` at one scale with those of `corner_descriptor`; the networks `aliked`, `disk`
    from the file `model`; `klt` follows corners from frame to frame of a video (see `TrackingConfig`). Against 2,349
    verified matches of SIFT with a near photo of a house front and 609 with one from the side, of 8,000 features, ORB
    brings 1,993 and 200, AKAZE 1,819 and 338, BRISK 1,425 and 266, corners with BRIEF some 2,300 and 480; ORB in a
    sixth of the time, AKAZE in a quarter, corners in a third."""

    max_image_size: int = 3200
    """Longest side in px to which larger images are reduced before detection; 0 keeps the full size. The time grows
    with the square."""

    max_features: int = 12000
    """The strongest are kept. Of house fronts with more than 8,000 (Herz-Jesus-P8), 12,000 lower the median position
    error from 3.7 to 3.5 mm; matching takes twice the time, as it grows with the square."""

    spreading: Spreading = "strongest"
    """Which are kept of more than `max_features`: the strongest, or the strongest of each part of the image (even).
    Even spreading brings 16 % more verified matches to the median pair of Herz-Jesus-P8, but poses that are not better
    (AUC at 1° 89.8 instead of 91.7 with 12,000; 81.0 and 80.4 with 3,000; fountain-P11 77.2 and 76.5 with 3,000)."""

    contrast_threshold: float = 0.02
    """Smallest contrast of a keypoint, for grey values in [0, 1]. Half of OpenCV's default, and equal to COLMAP's:
    0.04 finds half as many keypoints on house fronts. Detectors that measure something else take what corresponds."""

    min_features: int = 500
    """An image in which fewer are found is searched again with half the contrast, up to three times; 0 never does. No
    photo has lost verified matches by it (`scripts/bench_prepare.py`), and flat ones gain most of what they lack."""

    edge_threshold: float = 10.0
    """Largest ratio of principal curvatures; above it a keypoint slides along an edge. Lowe's value."""

    octave_layers: int = 3
    """Scales in an octave. Lowe's value."""

    first_octave: Literal["auto", "doubled", "full"] = "auto"
    """The image that the search begins with: itself (full), at twice its size (doubled), or doubled if its longest
    side has up to 2,000 px (auto). Most features of small photos are found by the doubling. Large ones do not need it:
    the eight of Herz-Jesus-P8 give relative poses of AUC 92.0 at 1° at their 3,072 px and 88.6 when reduced to 1,600
    and doubled again, in the same time."""

    upright: bool = False
    """All orientations are zero: for cameras that were never turned about their axis. Rotations beyond some 15° are
    lost, and what differs only by its direction is told apart. Not for `brisk`, which OpenCV turns in any case."""

    affine_tilts: int = 0
    """Views of a plane tilted by √2, 2, √8, … that are simulated and searched as well, so many. Of house fronts at
    768 px, seen from far apart (Herz-Jesus-P8, 0 and 5), none, one, two and three tilts bring 54, 146, 227 and 275
    verified matches, in 0.3, 1.1, 1.9 and 3.2 s an image."""

    corner_descriptor: CornerDescriptor = "brief"
    """What describes corners: BRIEF, which does not turn with the image, or FREAK, which does."""

    model: str = ""
    """ONNX file of the network, for `aliked` and `disk`."""

    def __post_init__(self) -> None:
        if self.max_image_size < 0 or 0 < self.max_image_size < SMALLEST_SIDE_PX:
            raise ConfigError(f"max_image_size must be 0 or at least {SMALLEST_SIDE_PX} px, got {self.max_image_size}")
        if self.max_features < 1:
            raise ConfigError(f"max_features must be at least 1, got {self.max_features}")
        if self.contrast_threshold <= 0:
            raise ConfigError(f"contrast_threshold must be above 0, got {self.contrast_threshold}")
        if self.min_features < 0:
            raise ConfigError(f"min_features must not be negative, got {self.min_features}")
        if not 0 <= self.affine_tilts <= 5:
            raise ConfigError(f"affine_tilts must be in [0, 5], got {self.affine_tilts}")
        if self.upright and self.kind == "brisk":
            raise ConfigError("brisk knows no upright features", remedy="choose orb or akaze for binary ones")
