"""Corners followed from frame to frame of a video, by pyramidal Lucas–Kanade.

Between two frames a patch hardly changes: its shift d is where  Σ (I₂(x + d) − I₁(x))²  over a window is smallest,
found by Gauss–Newton steps from coarse to fine. Each corner is followed there and back again; one that does not come
home was hidden, or slid along an edge. Where corners get lost new ones are sought in the parts of the frame that have
become empty.

What comes out has the form of any features and matches: row k of a frame is a corner, and the matches of two frames
in succession are the corners that both have. Descriptors are empty: there is nothing to match with other frames.

Reference:
    Lucas & Kanade, An iterative image registration technique, IJCAI 1981.
    Bouguet, Pyramidal implementation of the Lucas Kanade feature tracker, Intel 2000.
    Kalal, Mikolajczyk & Matas, Forward-backward error, ICPR 2010.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from jaxtyping import Float32

from sfm.core.arrays import BoolArray
from sfm.core.errors import ConfigError
from sfm.core.scene import DescriptorKind, Features, Matches

_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 0.01)
_QUALITY = 0.01
"""Least strength of a corner, as a part of that of the strongest."""
_SIGMA = 1.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackingConfig:
    """How corners are followed."""

    max_features: int = 1000
    """Corners a frame; lost ones are replaced."""

    min_distance_px: float = 12.0
    """Least distance of new corners from all others."""

    window_px: int = 21
    """Side of the patch; odd."""

    levels: int = 4
    """Of the pyramid; four follow shifts of up to some 80 px."""

    max_return_px: float = 0.5
    """Largest distance between a corner and where it comes to when it is followed forth and back."""

    def __post_init__(self) -> None:
        if self.max_features < 1 or self.levels < 1:
            raise ConfigError("max_features and levels must be at least 1")
        if self.window_px < 5 or self.window_px % 2 == 0:
            raise ConfigError(f"window_px must be odd and at least 5, got {self.window_px}")
        if self.min_distance_px <= 0 or self.max_return_px <= 0:
            raise ConfigError("min_distance_px and max_return_px must be above 0")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """The corners of a frame, and which of them are corners of the frame before (none in the first frame)."""

    features: Features
    matches_with_previous: Matches


def track_features(
    frames: Iterable[np.ndarray], config: TrackingConfig = TrackingConfig(), mask: BoolArray | None = None
) -> Iterator[TrackedFrame]:
    """Features of each frame as it comes, with its matches; the columns of the matches are (previous, this frame).

    Args:
        frames: grey (H, W) or RGB (H, W, 3), uint8, of one size.
        mask: (H, W), the same for all frames; corners are kept where it is True.
    Raises:
        ValueError: a frame or the mask is of another size.
    """
    before: np.ndarray | None = None
    points = np.zeros((0, 2), np.float32)
    for frame in frames:
        grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
        for other, what in ((before, "frame"), (mask, "mask")):
            if other is not None and other.shape != grey.shape:
                raise ValueError(f"a {what} has shape {other.shape}, another frame {grey.shape}")
        rows, found = np.zeros(0, np.int32), points
        if before is not None and len(points):
            rows, found = _followed(before, grey, points, mask, config)
        points = np.concatenate([found, _new_corners(grey, found, mask, config)])
        kept = np.arange(len(found), dtype=np.int32) if len(rows) else np.zeros(0, np.int32)
        yield TrackedFrame(_features(points), Matches(np.stack([rows, kept], axis=1)))
        before = grey


def _followed(
    before: np.ndarray, now: np.ndarray, points: np.ndarray, mask: np.ndarray | None, config: TrackingConfig
) -> tuple[np.ndarray, Float32[np.ndarray, "M 2"]]:
    """The rows of the corners that were followed there and back, ascending, and where they are now."""

    def follow(first: np.ndarray, second: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        window = (config.window_px, config.window_px)
        start = places[:, None].copy()
        moved, status, _ = cv2.calcOpticalFlowPyrLK(
            first, second, places[:, None], start, winSize=window, maxLevel=config.levels - 1, criteria=_CRITERIA
        )
        return moved.reshape(-1, 2), status.reshape(-1) > 0

    forth, there = follow(before, now, points)
    back, home = follow(now, before, forth)
    good = there & home & (np.linalg.norm(back - points, axis=1) <= config.max_return_px)
    good &= (forth >= 0).all(axis=1) & (forth <= [now.shape[1] - 1, now.shape[0] - 1]).all(axis=1)
    good[good] = _allowed(mask, forth[good])
    rows = np.flatnonzero(good).astype(np.int32)
    return rows, forth[rows]


def _new_corners(
    grey: np.ndarray, points: np.ndarray, mask: np.ndarray | None, config: TrackingConfig
) -> Float32[np.ndarray, "N 2"]:
    """Corners far from `points`, at most as many as are missing; in OpenCV's coordinates."""
    missing = config.max_features - len(points)
    if missing <= 0:
        return np.zeros((0, 2), np.float32)
    free = np.full(grey.shape, 255, np.uint8) if mask is None else mask.astype(np.uint8) * 255
    for x, y in np.rint(points).astype(int).tolist():
        cv2.circle(free, (x, y), round(config.min_distance_px), 0, cv2.FILLED)
    found = cv2.goodFeaturesToTrack(grey, missing, _QUALITY, config.min_distance_px, mask=free, blockSize=5)
    if found is None:
        return np.zeros((0, 2), np.float32)
    corners = cv2.cornerSubPix(grey, found.reshape(-1, 1, 2), (3, 3), (-1, -1), _CRITERIA).reshape(-1, 2)
    corners = np.clip(corners, 0, np.array([grey.shape[1] - 1, grey.shape[0] - 1], np.float32))
    return corners[_allowed(mask, corners)]


def _allowed(mask: np.ndarray | None, points: np.ndarray) -> np.ndarray:
    """Whether the pixel of each point, in OpenCV's coordinates, is True in the mask."""
    if mask is None:
        return np.ones(len(points), np.bool_)
    return mask[tuple(np.rint(points[:, ::-1]).astype(int).T)]


def _features(points: np.ndarray) -> Features:
    """In the order in which they are followed: the matches count on it."""
    count = len(points)
    return Features(
        points.astype(np.float64) + 0.5,
        np.full(count, _SIGMA, np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, 0), np.uint8),
        DescriptorKind.BINARY,
    )
