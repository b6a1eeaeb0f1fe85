"""A sparse model: cameras, poses, points and the tracks that tie them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64, Int32, Int64, UInt8

from sfm.core.arrays import Points2D, Value, readonly
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene.rigs import Frame, Rig


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Tracks(Value):
    """Observations in flat columns: track p is rows `offsets[p]:offsets[p + 1]`.

    Attributes:
        offsets: (P + 1,) starts at 0 and never falls.
        image_ids: (n,) the image of each observation.
        feature_ids: (n,) its row among the features of that image.
    """

    offsets: Int64[np.ndarray, " P1"]
    image_ids: Int32[np.ndarray, " n"]
    feature_ids: Int32[np.ndarray, " n"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "offsets", readonly(self.offsets, (None,), np.int64))
        n = int(self.offsets[-1]) if len(self.offsets) else -1
        if n < 0 or self.offsets[0] != 0 or np.any(np.diff(self.offsets) < 0):
            raise ValueError("offsets must start at 0 and never fall")
        object.__setattr__(self, "image_ids", readonly(self.image_ids, (n,), np.int32))
        object.__setattr__(self, "feature_ids", readonly(self.feature_ids, (n,), np.int32))

    @staticmethod
    def empty() -> Tracks:
        """No tracks."""
        return Tracks(np.zeros(1, np.int64), np.zeros(0, np.int32), np.zeros(0, np.int32))

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def lengths(self) -> Int64[np.ndarray, " P"]:
        """Number of observations of each track."""
        return np.diff(self.offsets)

    @property
    def track_ids(self) -> Int64[np.ndarray, " n"]:
        """The track (its row) of each observation."""
        return np.repeat(np.arange(len(self)), self.lengths)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Reconstruction(Value):
    """Registered images with their poses, and triangulated points; an image without a pose is absent.

    Image columns (I,) are sorted by `image_ids`. Keypoints of image row i are rows
    `keypoint_offsets[i]:keypoint_offsets[i + 1]` of `keypoints`; `Tracks.feature_ids` counts within them.

    Attributes:
        cameras: by camera id.
        image_ids, image_names, image_camera_ids: (I,)
        cams_from_world: batch (I,), in scene units.
        keypoints: (K, 2) px of all images, one after the other; may be only the observed ones.
        points3D: (P, 3) in the world; point_ids (P,) their names on disk; colors (P, 3) RGB.
        errors: (P,) mean reprojection error in px, −1 where unknown.
        tracks: one for each point, in the same order.
        rigs, frames: empty where every image is its own frame and every camera its own rig.
    """

    cameras: Mapping[int, Camera]
    image_ids: Int32[np.ndarray, " I"]
    image_names: tuple[str, ...]
    image_camera_ids: Int32[np.ndarray, " I"]
    cams_from_world: Rigid3
    keypoint_offsets: Int64[np.ndarray, " I1"]
    keypoints: Float64[np.ndarray, "K 2"]
    points3D: Float64[np.ndarray, "P 3"]
    point_ids: Int64[np.ndarray, " P"]
    colors: UInt8[np.ndarray, "P 3"]
    errors: Float64[np.ndarray, " P"]
    tracks: Tracks
    rigs: tuple[Rig, ...] = ()
    frames: tuple[Frame, ...] = ()

    def __post_init__(self) -> None:
        images, points = len(self.image_names), len(self.tracks)
        set_ = object.__setattr__
        set_(self, "cameras", MappingProxyType(dict(sorted(self.cameras.items()))))
        set_(self, "image_ids", readonly(self.image_ids, (images,), np.int32))
        set_(self, "image_camera_ids", readonly(self.image_camera_ids, (images,), np.int32))
        set_(self, "keypoint_offsets", readonly(self.keypoint_offsets, (images + 1,), np.int64))
        set_(self, "keypoints", readonly(self.keypoints, (int(self.keypoint_offsets[-1]), 2)))
        set_(self, "points3D", readonly(self.points3D, (points, 3)))
        set_(self, "point_ids", readonly(self.point_ids, (points,), np.int64))
        set_(self, "colors", readonly(self.colors, (points, 3), np.uint8))
        set_(self, "errors", readonly(self.errors, (points,)))
        if self.cams_from_world.shape != (images,):
            raise ValueError(f"{self.cams_from_world.shape} poses for {images} images")
        if np.any(np.diff(self.image_ids) <= 0):
            raise ValueError("image ids must be sorted and unique")
        if self.keypoint_offsets[0] != 0 or np.any(np.diff(self.keypoint_offsets) < 0):
            raise ValueError("keypoint offsets must start at 0 and never fall")
        if not np.isin(self.tracks.image_ids, self.image_ids).all():
            raise ValueError("tracks name images that are absent")
        missing = set(self.image_camera_ids.tolist()) - set(self.cameras)
        if missing:
            raise ValueError(f"images name cameras that are absent: {sorted(missing)}")

    @property
    def image_rows(self) -> Int64[np.ndarray, " n"]:
        """The image row of each observation of `tracks`."""
        return np.searchsorted(self.image_ids, self.tracks.image_ids)

    @property
    def observations(self) -> Points2D:
        """The observed keypoints (n, 2), in the order of `tracks`."""
        return self.keypoints[self.keypoint_offsets[self.image_rows] + self.tracks.feature_ids]
