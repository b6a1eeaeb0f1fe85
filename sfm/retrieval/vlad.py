"""Images as single vectors: descriptors aggregated by what they differ from the centres of their cells (VLAD).

With x the descriptors of an image and c(x) the nearest of K centres,

    v_k = Σ { x − c_k : c(x) = c_k },    each v_k scaled to unit length, all of them end to end, and so again.

Unit parts keep a repeated pattern, which falls into one cell, from drowning all else.

References:
    Jégou, Douze, Schmid & Pérez, Aggregating local descriptors into a compact image representation, CVPR 2010.
    Arandjelović & Zisserman, All about VLAD, CVPR 2013 (normalisation of the parts).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt8

from sfm.retrieval.bag_of_words import best_partners
from sfm.retrieval.vocabulary import nearest

_IMAGES_AT_ONCE = 256


def vlad(descriptors: UInt8[np.ndarray, "N D"], centers: Float32[np.ndarray, "K D"]) -> Float32[np.ndarray, " V"]:
    """The vector of an image, K · D numbers of unit length together; zeros for an image without descriptors."""
    rows = descriptors.astype(np.float32)
    labels = nearest(rows, centers)
    parts = np.zeros(centers.shape, np.float64)
    np.add.at(parts, labels, rows - centers[labels])
    return unit(unit(parts).ravel()[None])[0].astype(np.float32)


def vector_partners(vectors: Float32[np.ndarray, "I V"], count: int) -> list[tuple[int, int]]:
    """Each image with the `count` others whose vectors have the largest products with its own; pairs i < j, sorted."""
    found: set[tuple[int, int]] = set()
    for start in range(0, len(vectors), _IMAGES_AT_ONCE):
        similar = (vectors[start : start + _IMAGES_AT_ONCE] @ vectors.T).astype(np.float64)
        found.update(best_partners(similar, start, count))
    return sorted(found)


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows at unit length; zeros stay zeros."""
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(length > 0, length, 1)
