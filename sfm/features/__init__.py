"""Image in, keypoints with descriptors out."""

from sfm.features.config import NETWORKS, FeatureConfig
from sfm.features.extraction import Extraction, descriptor_kind, extract, extract_features, working_memory_bytes

__all__ = [
    "NETWORKS",
    "Extraction",
    "FeatureConfig",
    "descriptor_kind",
    "extract",
    "extract_features",
    "working_memory_bytes",
]
