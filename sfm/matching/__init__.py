"""Features of two images in, putative matches out."""

from sfm.matching.cells import SearchableFeatures
from sfm.matching.nearest import MatchingConfig, match_features
from sfm.matching.pairs import exhaustive_pairs

__all__ = ["MatchingConfig", "SearchableFeatures", "exhaustive_pairs", "match_features"]
