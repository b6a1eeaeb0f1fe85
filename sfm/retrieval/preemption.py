"""A cheap look at all pairs that decides which are matched in full.

Of every image the few hundred features of largest scale are taken: they are seen from near and far alike, and an
image of the same place shares many of them, one of another place hardly any. Matching them costs a thousandth of a full
match. It finds less than votes of visual words (see `voting`), but does with any descriptors: bits of binary ones
become numbers 0 and 1, whose squared distance is the number of bits that differ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Int32, UInt8

from sfm.core.execution import ordered_map
from sfm.core.scene import DescriptorKind, Features
from sfm.retrieval import _kernels
from sfm.retrieval.config import RetrievalConfig
from sfm.retrieval.pairs import Pair
from sfm.retrieval.scores import PairScores

_IMAGES_AT_ONCE = 32
"""Images whose probes meet those of one in one product: 11 MB of distances."""


def probes_of(features: Features, config: RetrievalConfig = RetrievalConfig()) -> UInt8[np.ndarray, "P D"]:
    """Descriptors of the features of largest scale; those of binary detectors with a number for each bit."""
    descriptors = largest(features, config.probes).descriptors
    return np.unpackbits(descriptors, axis=1) if features.kind == DescriptorKind.BINARY else descriptors


def largest(features: Features, count: int) -> Features:
    """The `count` features of largest scale, in their order; among equals from all over the image."""
    # Features come in reading order: to take the first of equals would be to take the top of the image.
    anywhere = np.random.default_rng(0).permutation(len(features))
    rows = np.sort(np.lexsort((anywhere, -features.scales))[:count])
    return Features(
        *(features.points2D[rows], features.scales[rows], features.orientations[rows], features.descriptors[rows]),
        kind=features.kind,
    )


def probe_scores(
    probes: Sequence[UInt8[np.ndarray, "_ D"]],
    config: RetrievalConfig = RetrievalConfig(),
    *,
    pairs: Sequence[Pair] | None = None,
    threads: int = 1,
    on_image: Callable[[int], None] = lambda image: None,
) -> PairScores:
    """Matches of probes of every two images, or of some pairs i < j.

    Args:
        on_image: is told the number of each image when it has been compared.
    """
    images = len(probes)
    others: list[list[int]] = [[] for _ in range(images)]
    if pairs is None:
        others = [list(range(i + 1, images)) for i in range(images)]
    else:
        for i, j in sorted(set(pairs)):
            others[i].append(j)

    def of_image(i: int) -> tuple[int, np.ndarray]:
        return i, _matches(probes, i, others[i], config)

    def collected() -> Iterator[np.ndarray]:
        for i, counts in ordered_map(of_image, range(images), threads=threads):
            on_image(i)
            yield np.stack([np.full(len(counts), i, np.int32), np.array(others[i], np.int32), counts], axis=1)

    rows = np.concatenate([np.zeros((0, 3), np.int32), *collected()])
    return PairScores(images, rows[:, :2], rows[:, 2], config.min_score)


def _matches(
    probes: Sequence[np.ndarray], image: int, others: Sequence[int], config: RetrievalConfig
) -> Int32[np.ndarray, " J"]:
    rows = probes[image].astype(np.float32)
    counts = np.zeros(len(others), np.int32)
    for start in range(0, len(others), _IMAGES_AT_ONCE):
        some = [probes[k].astype(np.float32) for k in others[start : start + _IMAGES_AT_ONCE]]
        offsets = np.cumsum([0] + [len(other) for other in some])
        columns = np.concatenate(some)
        squared1, squared2 = (np.einsum("ij,ij->i", side, side) for side in (rows, columns))
        part = counts[start : start + _IMAGES_AT_ONCE]
        _kernels.count_matches(rows @ columns.T, squared1, squared2, offsets, config.probe_ratio**2, part)
    return counts
