"""Pictures of nothing in particular, with detail at several scales, for tests that need photos but no scene."""

from __future__ import annotations

import cv2
import numpy as np


def texture(seed: int, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """RGB; pictures of different seeds have nothing in common."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.normal(size=(shape[0] // s, shape[1] // s, 3)), shape[::-1], interpolation=cv2.INTER_CUBIC) * s
        for s in (2, 4, 8)
    ]
    return np.clip(np.rint(128 + 8 * sum(layers)), 0, 255).astype(np.uint8)
