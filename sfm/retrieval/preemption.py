"""A cheap look at all pairs that decides which are matched in full.

Of every image the few hundred features of largest scale are taken: they are seen from near and far alike, and an
image of the same place shares many of them, one of another place hardly any. Matching them costs a thousandth of a full
match. Pairs with enough such matches are *promising*, and so are the best few partners of each image, and its
neighbours in the order of the names, which for most photographers is the order of the walk.

What the look misses may still be needed. Where the verified pairs leave the images in parts that hang together by
one pair or by none, the most similar of the pairs left out between these parts are the *missing links* to be tried.

Reference:
    Wu, Towards linear-time incremental structure from motion, 3DV 2013, § 3.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float32, Int32

from sfm.core.errors import ConfigError
from sfm.core.execution import ordered_map
from sfm.core.graphs import two_edge_connected_labels
from sfm.core.scene import Features
from sfm.retrieval import _kernels

_IMAGES_AT_ONCE = 32
"""Images whose probes meet those of one in one product: 11 MB of distances."""

Pair = tuple[int, int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RetrievalConfig:
    """Which pairs are matched in full."""

    exhaustive_up_to: int = 60
    """Images up to which all pairs are: a few minutes at most."""
    probes: int = 300
    """Features of largest scale of each image that the first look compares."""
    probe_ratio: float = 0.85
    """Largest ratio of the distances to the nearest and the second nearest for a match between probes."""
    min_score: int = 6
    """Matches of probes that make a pair promising. Nine in ten pairs of different places have no more by chance; of
    2,203 pairs with 30 verified matches in 14 sets, this and `partners` keep 97 %."""
    partners: int = 12
    """Partners of each image with most matches of probes that are promising in any case, if they have at least two."""
    neighbors: int = 2
    """Images before and after in the order of the names that are promising in any case."""
    retries: int = 4
    """Missing links tried in one round, for each image."""

    def __post_init__(self) -> None:
        if self.probes < 2:
            raise ConfigError(f"probes must be at least 2, got {self.probes}")
        if not 0 < self.probe_ratio <= 1:
            raise ConfigError(f"probe_ratio must be in (0, 1], got {self.probe_ratio}")
        for name in ("exhaustive_up_to", "min_score", "partners", "neighbors", "retries"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must not be negative, got {getattr(self, name)}")


def probes_of(features: Features, config: RetrievalConfig = RetrievalConfig()) -> Float32[np.ndarray, "P D"]:
    """Descriptors of the features of largest scale."""
    order = np.argsort(-features.scales, kind="stable")[: config.probes]
    return features.descriptors[np.sort(order)].astype(np.float32)


def pair_scores(
    probes: Sequence[Float32[np.ndarray, "_ D"]], config: RetrievalConfig = RetrievalConfig(), *, threads: int = 1
) -> Int32[np.ndarray, "I I"]:
    """Matches of probes of every two images, a symmetric matrix with zeros on the diagonal.

    Args:
        probes: descriptors with whole numbers of 0 to 255, image by image.
    """
    squared = [np.einsum("ij,ij->i", rows, rows) for rows in probes]

    def of_image(i: int) -> Int32[np.ndarray, " J"]:
        counts = np.zeros(len(probes), np.int32)
        for start in range(i + 1, len(probes), _IMAGES_AT_ONCE):
            block = slice(start, start + _IMAGES_AT_ONCE)
            offsets = np.concatenate([[0], np.cumsum([len(rows) for rows in probes[block]])])
            dots = probes[i] @ np.concatenate(probes[block]).T
            _kernels.count_matches(
                dots, squared[i], np.concatenate(squared[block]), offsets, config.probe_ratio**2, counts[block]
            )
        return counts

    scores = np.array(list(ordered_map(of_image, range(len(probes)), threads=threads)), np.int32)
    scores = scores.reshape(len(probes), len(probes))
    return scores + scores.T


def promising_pairs(scores: Int32[np.ndarray, "I I"], config: RetrievalConfig = RetrievalConfig()) -> list[Pair]:
    """Pairs i < j of rows of `scores` that are to be matched in full, sorted; images are in the order of names."""
    return _pairs(_promising(scores, config))


def missing_links(
    scores: Int32[np.ndarray, "I I"],
    tried: Iterable[Pair],
    linked: Iterable[Pair],
    config: RetrievalConfig = RetrievalConfig(),
) -> list[Pair]:
    """The most similar pairs that were not tried yet, between parts that at most one of the pairs `linked` joins.

    At most `retries` for each image; none where the images hang together well, or nothing is left.
    """
    images = len(scores)
    part = two_edge_connected_labels(images, np.array(sorted(linked), np.int64).reshape(-1, 2))
    open_ = np.triu(part[:, None] != part, 1) & (scores > 0)
    for i, j in tried:
        open_[min(i, j), max(i, j)] = False
    rows, columns = np.nonzero(open_)
    order = np.lexsort((columns, rows, -scores[rows, columns]))[: config.retries * images]
    return sorted(zip(rows[order].tolist(), columns[order].tolist(), strict=True))


def _promising(scores: np.ndarray, config: RetrievalConfig) -> Bool[np.ndarray, "I I"]:
    images = len(scores)
    rank = np.argsort(np.argsort(-scores, axis=1, kind="stable"), axis=1, kind="stable")
    best = (rank < config.partners) & (scores >= 2)
    number = np.arange(images)
    adjacent = np.abs(number[:, None] - number) <= config.neighbors
    return (scores >= config.min_score) | best | best.T | adjacent


def _pairs(mask: np.ndarray) -> list[Pair]:
    return [(int(i), int(j)) for i, j in np.argwhere(np.triu(mask, 1))]
