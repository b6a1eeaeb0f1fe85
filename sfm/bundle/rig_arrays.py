"""Images that move together, as flat columns."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Int32

from sfm.core.arrays import Value, readonly
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigArrays(Value):
    """Images that were taken at one moment by sensors mounted together, and how these are mounted.

    Attributes:
        image_frames: (I,) the row of the moment of each image.
        image_sensors: (I,) the row of the sensor that took it, −1 for the rig's reference.
        rigs_from_world: batch (F,), the pose of the rig at each moment.
        sensors_from_rig: batch (Q,).
        free_sensors: (Q,) which sensors may move on their rig.

    Raises:
        ValueError: shapes disagree or a row does not exist.
    """

    image_frames: Int32[np.ndarray, " I"]
    image_sensors: Int32[np.ndarray, " I"]
    rigs_from_world: Rigid3
    sensors_from_rig: Rigid3
    free_sensors: Bool[np.ndarray, " Q"]

    def __post_init__(self) -> None:
        images, sensors = len(self.image_frames), len(self.free_sensors)
        object.__setattr__(self, "image_frames", readonly(self.image_frames, (images,), np.int32))
        object.__setattr__(self, "image_sensors", readonly(self.image_sensors, (images,), np.int32))
        object.__setattr__(self, "free_sensors", readonly(self.free_sensors, (sensors,), np.bool_))
        if self.sensors_from_rig.shape != (sensors,) or len(self.rigs_from_world.shape) != 1:
            raise ValueError(f"{self.sensors_from_rig.shape} poses for {sensors} sensors")
        check_in_range("image_frames", self.image_frames, self.rigs_from_world.shape[0])
        check_in_range("image_sensors", self.image_sensors + 1, sensors + 1)

    @property
    def cams_from_world(self) -> Rigid3:
        """Poses (I,) of the images."""
        mounted = self.sensors_from_rig
        turns = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], mounted.rotation.wxyz])
        mounts = Rigid3(Rotation3(turns), np.concatenate([np.zeros((1, 3)), mounted.translation]))
        return mounts[self.image_sensors + 1] @ self.rigs_from_world[self.image_frames]


def check_in_range(name: str, rows: np.ndarray, count: int) -> None:
    """That rows exist.

    Raises:
        ValueError: one does not.
    """
    if len(rows) and not (rows.min() >= 0 and rows.max() < count):
        raise ValueError(f"{name} must lie in 0..{count - 1}, got {rows.min()}..{rows.max()}")
