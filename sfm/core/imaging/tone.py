"""How grey values are distributed, and curves that distribute them otherwise."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import UInt8

_BLACK = 8
"""Grey values up to this are black: a background, or the border of a scan, that says nothing about the exposure."""


@dataclasses.dataclass(frozen=True, slots=True)
class Tone:
    """How grey values in [0, 1] are distributed.

    Attributes:
        low, high: all but a thousandth of the pixels lie above, and all but a thousandth below.
        median: of the pixels that are not black; 0 if all are.
    """

    low: float
    median: float
    high: float

    @property
    def range(self) -> float:
        """From dark to light."""
        return self.high - self.low


def tone(grey: UInt8[np.ndarray, "H W"]) -> Tone:
    """Measured on the histogram, exactly."""
    counts = np.bincount(grey.ravel(), minlength=256)
    low, high = (_value_at(counts, share) for share in (0.001, 0.999))
    counts[: _BLACK + 1] = 0
    return Tone(low, _value_at(counts, 0.5) if counts.any() else 0.0, high)


def _value_at(counts: np.ndarray, share: float) -> float:
    return float(np.searchsorted(np.cumsum(counts), share * counts.sum())) / 255


def with_gamma(grey: UInt8[np.ndarray, "H W"], gamma: float) -> UInt8[np.ndarray, "H W"]:
    """v ↦ v^gamma for v in [0, 1]: below 1 it lifts the dark.

    Raises:
        ValueError: `gamma` is not positive.
    """
    if gamma <= 0:
        raise ValueError(f"gamma must be above 0, got {gamma}")
    curve = np.rint(255 * (np.arange(256) / 255) ** gamma).astype(np.uint8)
    return curve[grey]


def stretched(grey: UInt8[np.ndarray, "H W"], low: float, high: float) -> UInt8[np.ndarray, "H W"]:
    """The line that takes `low` to 0 and `high` to 1, clipped.

    Raises:
        ValueError: `high` is not above `low`.
    """
    if high <= low:
        raise ValueError(f"high must be above low, got {low} and {high}")
    curve = np.clip(np.rint(255 * (np.arange(256) / 255 - low) / (high - low)), 0, 255).astype(np.uint8)
    return curve[grey]


def equalized_locally(
    grey: UInt8[np.ndarray, "H W"], clip_limit: float = 2.0, tiles: int = 8
) -> UInt8[np.ndarray, "H W"]:
    """CLAHE: each of `tiles` × `tiles` parts gets as many pixels of every grey value, contrast grown at most so much.

    Args:
        clip_limit: largest steepness of the curve, 1 that of the identity.
    Reference:
        Zuiderveld, Contrast limited adaptive histogram equalization, Graphics Gems IV, 1994.
    """
    return cv2.createCLAHE(clipLimit=clip_limit, tileGridSize=(tiles, tiles)).apply(grey)
