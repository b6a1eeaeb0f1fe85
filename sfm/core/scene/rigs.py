"""Sensors that are mounted together, and moments at which they took images."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

from sfm.core.arrays import Value
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
