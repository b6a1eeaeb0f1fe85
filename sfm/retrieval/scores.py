"""From how much pairs of images have in common to the pairs that are matched in full.

Pairs with many votes (or matches of probes) are *promising*, and so are the best few partners of each image, and its
neighbours in the order of the names, which for most photographers is the order of the walk.

What this misses may still be needed. Where the verified pairs leave the images in parts that hang together by
one pair or by none, the most similar of the pairs left out between these parts are the *missing links* to be tried.

Reference:
    Wu, Towards linear-time incremental structure from motion, 3DV 2013, § 3.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
from jaxtyping import Int32, Integer

from sfm.core.arrays import Value, readonly
from sfm.core.graphs import two_edge_connected_labels
from sfm.retrieval.config import RetrievalConfig
from sfm.retrieval.pairs import Pair, nearby_pairs


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PairScores(Value):
    """What pairs of images have in common; pairs that are not listed were not looked at or have nothing.

    Attributes:
        images: how many there are; pairs name them 0 … images − 1, in the order of the names.
        pairs: (P, 2), i < j, sorted, each once.
        scores: of the pairs, whole numbers ≥ 0.
        threshold: the score that makes a pair promising.
    """

    images: int
    pairs: Integer[np.ndarray, "P 2"]
    scores: Integer[np.ndarray, " P"]
    threshold: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "pairs", readonly(self.pairs, (None, 2), np.int32))
        object.__setattr__(self, "scores", readonly(self.scores, (len(self.pairs),), np.int32))

    def __len__(self) -> int:
        return len(self.pairs)


def summed_scores(images: int, pairs: np.ndarray, scores: np.ndarray, threshold: int) -> PairScores:
    """Scores of pairs in any order and direction; those of the same pair are added up."""
    low, high = np.sort(pairs.astype(np.int64), axis=1).T
    keys, where = np.unique(low * images + high, return_inverse=True)
    total = np.zeros(len(keys), np.int64)
    np.add.at(total, where, scores)
    both = np.stack([keys // max(images, 1), keys % max(images, 1)], axis=1)
    return PairScores(images, both.astype(np.int32), total.astype(np.int32), threshold)


def promising_pairs(scores: PairScores, config: RetrievalConfig = RetrievalConfig()) -> list[Pair]:
    """Pairs i < j that are to be matched in full, sorted."""
    good = scores.scores >= scores.threshold
    good |= (scores.scores >= 2) & (partner_ranks(scores) < config.partners)
    return sorted({*_pairs(scores.pairs[good]), *nearby_pairs(scores.images, config.neighbors)})


def missing_links(
    scores: PairScores,
    tried: Iterable[Pair],
    linked: Iterable[Pair],
    config: RetrievalConfig = RetrievalConfig(),
) -> list[Pair]:
    """The most similar pairs that were not tried yet, between parts that at most one of the pairs `linked` joins.

    At most `retries` for each image; none where the images hang together well, or nothing is left.
    """
    part = two_edge_connected_labels(scores.images, np.array(sorted(linked), np.int64).reshape(-1, 2))
    left, right = scores.pairs.T
    done = np.array([min(pair) * scores.images + max(pair) for pair in tried], np.int64)
    new = ~np.isin(left.astype(np.int64) * scores.images + right, done)
    (open_,) = np.nonzero((part[left] != part[right]) & (scores.scores > 0) & new)
    order = np.argsort(-scores.scores[open_], kind="stable")[: config.retries * scores.images]
    return sorted(_pairs(scores.pairs[open_[order]]))


def partner_ranks(scores: PairScores) -> Int32[np.ndarray, " P"]:
    """The better of the two ranks of each pair among those of its images, 0 the best; the lower partner wins a tie."""
    count = len(scores)
    image = np.concatenate([scores.pairs[:, 0], scores.pairs[:, 1]])
    partner = np.concatenate([scores.pairs[:, 1], scores.pairs[:, 0]])
    order = np.lexsort((partner, -np.tile(scores.scores, 2), image))
    first = np.searchsorted(image[order], image[order])
    rank = np.empty(2 * count, np.int32)
    rank[order] = np.arange(2 * count) - first
    return np.minimum(rank[:count], rank[count:])


def _pairs(rows: np.ndarray) -> list[Pair]:
    return [(i, j) for i, j in rows.tolist()]
