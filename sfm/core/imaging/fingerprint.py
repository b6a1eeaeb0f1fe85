"""Fingerprints by which copies of a picture are known although they were scaled or compressed.

A fingerprint is the signs of the 255 lowest frequencies but the mean of the cosine transform of the image at 64 × 64.
Copies that were compressed (JPEG, quality 60) or scaled (to 40 %) differ in up to 3 of the 255 signs, copies that were
brightened until they clip in up to 20. Different photos differ in 22 and more on eight sets of real photos, frames
of a video from a car included, but for three pairs that a turntable took from almost one place.

Reference:
    Zauner, Implementation and benchmarking of perceptual image hash functions, 2010.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

NEAR = 12
"""Signs in which two fingerprints of one picture may differ."""
_SIDE, _KEPT = 64, 16


def fingerprint(grey: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, " 255"]:
    """The signs for an image of any size and shape."""
    # Not `resize`, which does not average where one side shrinks and the other grows.
    small = cv2.resize(grey, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    return cv2.dct(small)[:_KEPT, :_KEPT].ravel()[1:] > 0


def near_pairs(fingerprints: Bool[np.ndarray, "I 255"], limit: int = NEAR) -> list[tuple[int, int]]:
    """Rows i < j that differ in at most `limit` signs, sorted."""
    signs = np.where(fingerprints, 1.0, -1.0).astype(np.float32)
    found = []
    for i in range(len(signs) - 1):
        differing = (signs.shape[1] - signs[i + 1 :] @ signs[i]) / 2
        found += [(i, i + 1 + int(j)) for j in np.flatnonzero(differing <= limit)]
    return found
