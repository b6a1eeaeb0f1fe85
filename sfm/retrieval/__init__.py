"""Which pairs of images deserve to be compared."""

from sfm.retrieval.pairs import exhaustive_pairs
from sfm.retrieval.preemption import RetrievalConfig, missing_links, pair_scores, probes_of, promising_pairs

__all__ = [
    "RetrievalConfig",
    "exhaustive_pairs",
    "missing_links",
    "pair_scores",
    "probes_of",
    "promising_pairs",
]
