"""What is estimated of a rig, and of what is seen of it, as the joint problem wants it."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Int64

from calib.refine_board import BoardShape
from sfm.core.arrays import FloatArray, Value
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigEstimate(Value):
    """What is estimated: cameras, `cams_from_rig` and `rigs_from_board` as rotations and translations, the board."""

    cameras: tuple[Camera, ...]
    mount_rotations: FloatArray
    mount_translations: FloatArray
    frame_rotations: FloatArray
    frame_translations: FloatArray
    shape: BoardShape

    @property
    def cams_from_rig(self) -> Rigid3:
        """Batch (N,)."""
        return Rigid3(Rotation3.from_matrix(self.mount_rotations), self.mount_translations)

    @property
    def rigs_from_board(self) -> Rigid3:
        """Batch (F,)."""
        return Rigid3(Rotation3.from_matrix(self.frame_rotations), self.frame_translations)

    def of_frames(self, frames: Int64[np.ndarray, " _"]) -> RigEstimate:
        """With the poses of these frames only."""
        return dataclasses.replace(
            self, frame_rotations=self.frame_rotations[frames], frame_translations=self.frame_translations[frames]
        )
