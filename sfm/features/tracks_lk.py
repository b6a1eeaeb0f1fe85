"""Corners followed from frame to frame of a video, by pyramidal Lucas–Kanade.

Between two frames a patch hardly changes: its shift d is where  Σ (I₂(x + d) − I₁(x))²  over a window is smallest,
found by Gauss–Newton steps from coarse to fine. Each corner is followed there and back again; one that does not come
home was hidden, or slid along an edge. Where corners get lost new ones are sought in the parts of the frame that have
become empty.

A corner has a number for as long as it is followed. That is its descriptor: features of any two frames are the same
corner where the numbers are equal. So the places where a video comes back to are not found.

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
from jaxtyping import Float32, UInt8

from sfm.core.arrays import BoolArray
from sfm.core.errors import ConfigError
from sfm.core.scene import DescriptorKind, Features

_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 0.01)
_QUALITY = 0.01
"""Least strength of a corner, as a part of that of the strongest."""
_SIGMA = 1.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackingConfig:
    """How corners are followed."""

    max_corners: int = 1000
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
        if self.max_corners < 1 or self.levels < 1:
            raise ConfigError("max_corners and levels must be at least 1")
        if self.window_px < 5 or self.window_px % 2 == 0:
            raise ConfigError(f"window_px must be odd and at least 5, got {self.window_px}")
        if self.min_distance_px <= 0 or self.max_return_px <= 0:
            raise ConfigError("min_distance_px and max_return_px must be above 0")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A grey image (H, W), and a mask (H, W) that is True where corners may be."""

    grey: UInt8[np.ndarray, "H W"]
    mask: BoolArray | None = None


def track_features(frames: Iterable[Frame | None], config: TrackingConfig = TrackingConfig()) -> Iterator[Features]:
    """The corners of each frame as it comes, those that were there before first, in px of the frame.

    Where a frame is missing, the next one is compared with the last one before it. A frame of another size begins
    a new clip.

    Raises:
        ValueError: a mask is of another size than its frame.
    """
    before: np.ndarray | None = None
    points, numbers, next_number = np.zeros((0, 2), np.float32), np.zeros(0, np.uint32), 0
    for frame in frames:
        if frame is None:
            yield _features(points[:0], numbers[:0])
            continue
        grey, mask = frame.grey, frame.mask
        if mask is not None and mask.shape != grey.shape:
            raise ValueError(f"the mask must have the shape of the image, {grey.shape}, got {mask.shape}")
        if before is None or before.shape != grey.shape:
            points, numbers = points[:0], numbers[:0]
        elif len(points):
            rows, points = _followed(before, grey, points, mask, config)
            numbers = numbers[rows]
        new = _new_corners(grey, points, mask, config)
        points = np.concatenate([points, new])
        numbers = np.concatenate([numbers, np.arange(next_number, next_number + len(new), dtype=np.uint32)])
        next_number += len(new)
        yield _features(points, numbers)
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
    missing = config.max_corners - len(points)
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


def _features(points: np.ndarray, numbers: np.ndarray) -> Features:
    return Features(
        points.astype(np.float64) + 0.5,
        np.full(len(points), _SIGMA, np.float32),
        np.zeros(len(points), np.float32),
        numbers.astype("<u4").view(np.uint8).reshape(-1, 4),
        DescriptorKind.FOLLOWED,
    )
