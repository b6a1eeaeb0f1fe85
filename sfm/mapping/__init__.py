"""From a view graph to reconstructions."""

from sfm.mapping.incremental import MappingConfig, map_incrementally
from sfm.mapping.tracks import build_tracks

__all__ = ["MappingConfig", "build_tracks", "map_incrementally"]
