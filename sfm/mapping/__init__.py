"""From a view graph to reconstructions."""

from sfm.mapping.config import MappingConfig
from sfm.mapping.incremental import map_incrementally
from sfm.mapping.tracks import build_tracks

__all__ = ["MappingConfig", "build_tracks", "map_incrementally"]
