"""Image in, keypoints with descriptors out."""

from sfm.features.sift import FeatureConfig, extract_features

__all__ = ["FeatureConfig", "extract_features"]
