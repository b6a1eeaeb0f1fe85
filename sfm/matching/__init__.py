"""Features of two images in, putative matches out."""

from sfm.matching.cells import SearchableFeatures
from sfm.matching.guided import match_guided
from sfm.matching.nearest import MatchingConfig, match_features

__all__ = ["MatchingConfig", "SearchableFeatures", "match_features", "match_guided"]
