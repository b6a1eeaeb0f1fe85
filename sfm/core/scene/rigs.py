"""Sensors that are mounted together, calibrated or not, and moments at which they took images."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from sfm.core.arrays import Value
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Rig(Value):
    """Cameras with fixed relative poses; the rig's frame is that of its reference camera.

    `sensors_from_rig` holds the other cameras; a pose is None while it is not known.
    """

    rig_id: int
    ref_camera_id: int
    sensors_from_rig: Mapping[int, Rigid3 | None] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.ref_camera_id in self.sensors_from_rig:
            raise ValueError(f"camera {self.ref_camera_id} is the rig's reference and has no pose in it")
        object.__setattr__(self, "sensors_from_rig", MappingProxyType(dict(self.sensors_from_rig)))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Frame(Value):
    """One moment of a rig: `image_ids` by camera id, and the rig's pose."""

    frame_id: int
    rig_id: int
    rig_from_world: Rigid3
    image_ids: Mapping[int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "image_ids", MappingProxyType(dict(self.image_ids)))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CameraRig(Value):
    """Calibrated cameras that are mounted together; the rig's frame is that of its reference camera.

    Attributes:
        names: of the cameras, all different.
        cams_from_rig: batch (N,), in `unit`; that of the reference is the identity.
        reference: its name.

    Raises:
        ValueError: numbers of cameras differ, names repeat, or the reference is no camera or stands elsewhere.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cams_from_rig: Rigid3
    reference: str
    unit: str = "m"

    def __post_init__(self) -> None:
        counts = (len(self.names), len(self.cameras), *self.cams_from_rig.shape)
        if len(counts) != 3 or len(set(counts)) != 1:
            raise ValueError(f"names, cameras and poses are {counts}")
        if len(set(self.names)) < len(self.names):
            raise ValueError(f"two cameras have one name: {', '.join(self.names)}")
        if self.reference not in self.names:
            raise ValueError(f"the reference {self.reference!r} is none of {', '.join(self.names)}")
        if np.any(self.cams_from_rig[self.names.index(self.reference)].matrix != np.eye(3, 4)):
            raise ValueError(f"the reference {self.reference!r} must have the identity as its pose")

    def __len__(self) -> int:
        """Number of cameras."""
        return len(self.names)

    def cam2_from_cam1(self, name2: str, name1: str) -> Rigid3:
        """The motion from the frame of one camera to that of another, in `unit`.

        Raises:
            ValueError: there is no such camera.
        """
        return self._pose(name2) @ self._pose(name1).inverse()

    def _pose(self, name: str) -> Rigid3:
        if name not in self.names:
            raise ValueError(f"there is no camera {name!r} among {', '.join(self.names)}")
        return self.cams_from_rig[self.names.index(name)]
