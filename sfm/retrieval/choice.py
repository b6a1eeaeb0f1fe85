"""Which way of choosing pairs suits a set of images."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from sfm.retrieval.config import Method, RetrievalConfig
from sfm.retrieval.scores import PairScores

_MANY = 100
"""Images from which order and GPS save more than they may lose. Votes find the pairs of fewer at little cost."""
_STEADY = 0.95
"""Share of the numbers in the names that go on by the same step."""
_FRAMES_AHEAD, _SEEN_AHEAD = 5, 3
"""In a video most of a view is still there five frames later: three times the votes that make a pair promising."""
_LOCATED = 0.9
_SPREAD_M = 20.0
"""Distance to the last of the nearest partners that errors of GPS, some 5 m, do not turn over."""


def choose_method(
    scores: PairScores,
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    positions_m: Float64[np.ndarray, "N 3"],
    config: RetrievalConfig = RetrievalConfig(),
) -> tuple[Method, str]:
    """The method for many images whose votes are known, and the reason in words.

    Args:
        scores: votes of the images, in the order of their names.
        names, sizes: of the files; width and height in px.
        positions_m: NaN where not known.
    """
    if len(names) <= _MANY:
        return "vocabulary", "of few images what they show finds all pairs"
    located = np.isfinite(positions_m).all(axis=1)
    if located.mean() >= _LOCATED and spread_m(positions_m[located], config.spatial_partners) >= _SPREAD_M:
        return "spatial", f"{located.sum()} of {len(names)} images have a position"
    if numbered_like_frames(names) and len(set(sizes)) == 1 and views_follow(scores):
        return "sequential", "numbered frames of one size, each view still there five frames later"
    return "vocabulary", "no order and no positions to go by"


def numbered_like_frames(names: Sequence[str]) -> bool:
    """Whether names differ in one number only, which goes on by the same step nearly everywhere."""
    found = [re.fullmatch(r"(.*?)([0-9]+)([^0-9]*(?:\.[a-zA-Z0-9]+)?)", name) for name in names]
    if len(names) < 2 or not all(found) or len({(match[1], match[3]) for match in found if match}) > 1:
        return False
    steps = np.diff([int(match[2]) for match in found if match])
    return bool(np.mean(steps == np.median(steps)) >= _STEADY)


def views_follow(scores: PairScores) -> bool:
    """Whether half of the images have much in common with the fifth after them."""
    ahead = scores.pairs[:, 1] - scores.pairs[:, 0] == _FRAMES_AHEAD
    seen = np.sum(scores.scores[ahead] >= _SEEN_AHEAD * scores.threshold)
    return bool(2 * seen >= scores.images - _FRAMES_AHEAD > 0)


def spread_m(positions_m: Float64[np.ndarray, "N 3"], partners: int) -> float:
    """The median distance to the last of the nearest partners."""
    if len(positions_m) < 2:
        return 0.0
    distances, _ = KDTree(positions_m).query(positions_m, min(partners + 1, len(positions_m)))
    return float(np.median(distances[:, -1]))
