"""Image in, keypoints with descriptors out."""

from sfm.features.config import NETWORKS, FeatureConfig
from sfm.features.extraction import (
    Extraction,
    descriptor_kind,
    extract,
    extract_features,
    reduced_image,
    working_memory_bytes,
)
from sfm.features.tracks_lk import Frame, TrackingConfig, track_features

__all__ = [
    "NETWORKS",
    "Extraction",
    "FeatureConfig",
    "Frame",
    "TrackingConfig",
    "descriptor_kind",
    "extract",
    "extract_features",
    "reduced_image",
    "track_features",
    "working_memory_bytes",
]
