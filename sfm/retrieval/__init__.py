"""Which pairs of images deserve to be compared."""

from sfm.retrieval.config import RetrievalConfig
from sfm.retrieval.pairs import Pair, exhaustive_pairs
from sfm.retrieval.preemption import probe_scores, probes_of
from sfm.retrieval.scores import PairScores, missing_links, promising_pairs
from sfm.retrieval.voting import similar_images

__all__ = [
    "Pair",
    "PairScores",
    "RetrievalConfig",
    "exhaustive_pairs",
    "missing_links",
    "probe_scores",
    "probes_of",
    "promising_pairs",
    "similar_images",
]
