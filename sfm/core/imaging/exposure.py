"""How a photo is exposed: its mean, its range, and how much of it is lost in black or in white."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from sfm.core.arrays import ImageU8

_BLACK, _WHITE = 2, 253
"""A pixel of which all channels are this dark, or any channel this bright, holds no detail there."""
_DARK_TOP, _BRIGHT_BOTTOM = 0.3, 0.6
_MIN_RANGE = 0.15
_MAX_WHITE = 0.15


@dataclasses.dataclass(frozen=True, slots=True)
class Exposure:
    """Grey values in [0, 1].

    Attributes:
        low, high: the 5th and the 95th percentile.
        black, white: shares of the pixels that are clipped.
    """

    mean: float
    low: float
    high: float
    black: float
    white: float

    @property
    def verdict(self) -> str:
        """`dark`, `bright`, `clipped`, `flat` or `good`.

        Dark is a photo of which not even a twentieth reaches 0.3, bright one of which not even a twentieth falls below
        0.6: an object on black or on white is neither. Clipped: more than 15 % is white. Flat: nine tenths of the
        pixels lie within 0.15.
        """
        if self.high < _DARK_TOP:
            return "dark"
        if self.low > _BRIGHT_BOTTOM:
            return "bright"
        if self.white > _MAX_WHITE:
            return "clipped"
        return "flat" if self.high - self.low < _MIN_RANGE else "good"


def exposure_of(image: ImageU8) -> Exposure:
    """The exposure of a grey or an RGB image."""
    colours = image.reshape(*image.shape[:2], -1)
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    counts = np.bincount(grey.ravel(), minlength=256)
    below = np.cumsum(counts) / counts.sum()
    low, high = (int(np.searchsorted(below, share)) for share in (0.05, 0.95))
    return Exposure(
        mean=float(counts @ np.arange(256) / counts.sum() / 255),
        low=low / 255,
        high=high / 255,
        black=float((colours <= _BLACK).all(2).mean()),
        white=float((colours >= _WHITE).any(2).mean()),
    )
