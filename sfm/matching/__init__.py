"""Features of two images in, putative matches out."""

from sfm.matching.cells import SearchableFeatures
from sfm.matching.guided import match_guided
from sfm.matching.lightglue import LightGlue
from sfm.matching.look_alikes import distinct_features
from sfm.matching.nearest import MatchingConfig, match_features

__all__ = [
    "LightGlue",
    "MatchingConfig",
    "SearchableFeatures",
    "distinct_features",
    "match_features",
    "match_guided",
]
