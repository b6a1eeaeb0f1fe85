"""Images without pixels: descriptors of a walk past a row of things."""

from __future__ import annotations

import numpy as np

from sfm.core.scene import Features


def walk(images: int, seed: int = 0, step: int = 20, seen: int = 60, noise: int = 8) -> list[np.ndarray]:
    """Descriptors (seen, 128): image k sees things `step` k … `step` k + `seen`, with noise."""
    rng = np.random.default_rng(seed)
    things = rng.integers(0, 90, (step * images + seen, 128))
    return [
        np.clip(things[step * k : step * k + seen] + rng.integers(-noise, noise + 1, (seen, 128)), 0, 255).astype(
            np.uint8
        )
        for k in range(images)
    ]


def features_of(
    descriptors: np.ndarray, scales: np.ndarray | None = None, orientations: np.ndarray | None = None
) -> Features:
    n = len(descriptors)
    scales, orientations = (np.zeros(n) if given is None else given for given in (scales, orientations))
    return Features(np.zeros((n, 2)), scales.astype(np.float32), orientations.astype(np.float32), descriptors)
