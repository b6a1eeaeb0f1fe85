"""Image in, keypoints with descriptors out."""

from sfm.features.config import FeatureConfig
from sfm.features.extraction import extract_features, working_memory_bytes

__all__ = ["FeatureConfig", "extract_features", "working_memory_bytes"]
