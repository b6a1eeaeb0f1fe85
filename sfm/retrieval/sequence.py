"""Pairs of the frames of a video: neighbours in time, and places that the camera comes back to."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.retrieval.config import RetrievalConfig
from sfm.retrieval.pairs import Pair, sequential_pairs
from sfm.retrieval.scores import PairScores, partner_ranks


def sequence_pairs(scores: PairScores, config: RetrievalConfig = RetrievalConfig()) -> list[Pair]:
    """Neighbours in time and loop closures, sorted."""
    return sorted({*sequential_pairs(scores.images, config.overlap), *loop_closures(scores, config)})


def loop_closures(scores: PairScores, config: RetrievalConfig = RetrievalConfig()) -> list[Pair]:
    """For each image the `loop_partners` with most votes, and enough of them, that are far away in the order.

    Far is more than three times the overlap. So a place that is seen without interruption is no loop for long.
    """
    apart = scores.pairs[:, 1] - scores.pairs[:, 0] > 3 * config.overlap
    kept = apart & (scores.scores >= scores.threshold)
    far = dataclasses.replace(scores, pairs=scores.pairs[kept], scores=scores.scores[kept])
    best = partner_ranks(far) < config.loop_partners
    return [(i, j) for i, j in np.asarray(far.pairs[best]).tolist()]
