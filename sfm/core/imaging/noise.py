"""How noisy an image is, and filters against it.

The second difference in x of that in y,  N = [1 −2 1]ᵀ [1 −2 1],  is blind to constant, linear and, along one axis,
any intensity; white noise of deviation σ leaves 6 σ. Texture leaves something too, so the quietest blocks are asked.

Reference:
    Immerkær, Fast noise variance estimation, Computer Vision and Image Understanding 1996.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

_GAIN = 6.0
_SIGMA_OF_MEAN = np.sqrt(np.pi / 2)
"""Standard deviation of normal noise by the mean of its absolute value."""
_BLOCK = 16
_QUIET = 25
"""Percentile of the blocks that is taken for free of texture."""
_UNLIKE, _EXTREME = 48, 8
_LARGEST_GREY = 0.97
"""Blocks at the ends of the range are clipped, so that they say nothing."""


def noise_sigma(grey: UInt8[np.ndarray, "H W"]) -> float:
    """Standard deviation of the noise, for grey values in [0, 1]; 0 where all is clipped or smaller than a block."""
    height, width = (side // _BLOCK * _BLOCK for side in grey.shape)
    if not height or not width:
        return 0.0
    values = grey[:height, :width].astype(np.float32) / 255
    second = np.array([1.0, -2.0, 1.0], np.float32)
    residual = np.abs(cv2.sepFilter2D(values, cv2.CV_32F, second, second))
    blocks, means = (_block_means(image, height, width) for image in (residual, values))
    told = blocks[(means > 1 - _LARGEST_GREY) & (means < _LARGEST_GREY)]
    return float(np.percentile(told, _QUIET) * _SIGMA_OF_MEAN / _GAIN) if told.size else 0.0


def _block_means(image: np.ndarray, height: int, width: int) -> np.ndarray:
    return image.reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK).mean(axis=(1, 3))


def without_noise(grey: UInt8[np.ndarray, "H W"], sigma: float) -> UInt8[np.ndarray, "H W"]:
    """Bilateral filter: each pixel the mean of its neighbours that differ by little more than the noise.

    Args:
        sigma: of the noise, for grey values in [0, 1].
    Reference:
        Tomasi & Manduchi, Bilateral filtering for gray and color images, ICCV 1998.
    """
    return cv2.bilateralFilter(grey, d=5, sigmaColor=255 * 2.5 * sigma, sigmaSpace=1.5)


def without_specks(grey: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Median of 3×3 pixels: takes away single wrong ones."""
    return cv2.medianBlur(grey, 3)


def specks_share(grey: UInt8[np.ndarray, "H W"]) -> float:
    """Share of the pixels that are nearly black or white and unlike all that is around: dust, dead pixels, hits."""
    unlike = cv2.absdiff(grey, without_specks(grey)) > _UNLIKE
    return float(np.count_nonzero(unlike & ((grey < _EXTREME) | (grey > 255 - _EXTREME))) / grey.size)
