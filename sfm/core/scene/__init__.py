"""The products that stages hand on."""

from sfm.core.scene.features import DescriptorKind, Features, Matches
from sfm.core.scene.pairs import PairKind, TwoViewGeometry, ViewGraph
from sfm.core.scene.reconstruction import Reconstruction, Tracks
from sfm.core.scene.rigs import CameraRig, Frame, Rig

__all__ = [
    "CameraRig",
    "DescriptorKind",
    "Features",
    "Frame",
    "Matches",
    "PairKind",
    "Reconstruction",
    "Rig",
    "Tracks",
    "TwoViewGeometry",
    "ViewGraph",
]
