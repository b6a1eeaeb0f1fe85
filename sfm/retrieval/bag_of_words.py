"""Images as bags of visual words, weighed by TF-IDF.

Word w that occurs c times in an image weighs  √c · log(I / I_w),  I_w of all I images having it: a rare word says
much, and the hundredth brick of a wall little more than the first. Two images are as similar as the cosine of their
weights is large.
The products of all images with all are taken over the words, each with the list of its images: an inverted file.

Reference:
    Sivic & Zisserman, Video Google, ICCV 2003.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int32
from scipy import sparse

_IMAGES_AT_ONCE = 256


def weighed_bags(words: Sequence[Int32[np.ndarray, " _"]], count: int) -> sparse.csr_array:
    """A row of unit length for each image, zero for one whose words are on every image; `count` words there are."""
    owners = np.repeat(np.arange(len(words)), [len(some) for some in words])
    every = np.concatenate([np.zeros(0, np.int32), *words])
    bags = sparse.csr_array((np.ones(len(every)), (owners, every)), shape=(len(words), count))
    bags.sum_duplicates()
    having = np.bincount(bags.indices, minlength=count)
    bags.data = np.sqrt(bags.data) * np.log(len(words) / having[bags.indices])
    length = np.sqrt(np.asarray((bags * bags).sum(axis=1))).ravel()
    return sparse.csr_array(sparse.diags_array(1 / np.where(length > 0, length, 1)) @ bags)


def bag_partners(bags: sparse.csr_array, count: int) -> list[tuple[int, int]]:
    """Each image with the `count` most similar others, pairs i < j, sorted."""
    images = len(bags.indptr) - 1
    by_word = sparse.csr_array(bags.T)
    found: set[tuple[int, int]] = set()
    for start in range(0, images, _IMAGES_AT_ONCE):
        similar = (bags[start : start + _IMAGES_AT_ONCE] @ by_word).toarray()
        found.update(best_partners(similar, start, count))
    return sorted(found)


def best_partners(similar: Float64[np.ndarray, "B I"], first: int, count: int) -> list[tuple[int, int]]:
    """The pairs of images `first …` with the `count` others that are most similar, and similar at all."""
    own = np.arange(len(similar))
    similar = similar.copy()
    similar[own, first + own] = 0
    best = np.argsort(-similar, axis=1, kind="stable")[:, :count]
    return [
        (min(first + k, other), max(first + k, other))
        for k, row in enumerate(best.tolist())
        for other in row
        if similar[k, other] > 0
    ]
