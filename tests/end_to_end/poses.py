"""Errors of poses against the truth, aligned so that a wrong model cannot hide.

The rotation between the two frames is the average of those of the images, the scale and the shift are the best for
the centres under it. Umeyama's alignment would let errors of position turn the frame.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Reconstruction
from sfm.evaluation.alignment import average_rotation


@dataclasses.dataclass(frozen=True)
class PoseErrors:
    """The largest errors and their root mean squares: in degrees, and as shares of the diagonal of the path's box."""

    rotation_deg: float
    position: float
    rotation_rms_deg: float
    position_rms: float


def pose_errors(model: Reconstruction, truth: Reconstruction) -> PoseErrors:
    rows = [truth.image_names.index(name) for name in model.image_names]
    return errors_of(model.cams_from_world, truth.cams_from_world[np.array(rows)], truth.cams_from_world.center)


def errors_of(cams_from_a: Rigid3, cams_from_b: Rigid3, path_in_b: np.ndarray) -> PoseErrors:
    b_from_a = cams_from_b.rotation.inverse() @ cams_from_a.rotation
    turn = average_rotation(b_from_a)
    angles = np.rad2deg((b_from_a @ turn.inverse()).angle)
    here, there = turn @ cams_from_a.center, cams_from_b.center
    here, there = here - here.mean(0), there - there.mean(0)
    scale = (here * there).sum() / (here**2).sum()
    distances = np.linalg.norm(scale * here - there, axis=1)
    distances /= np.linalg.norm(np.ptp(path_in_b, axis=0))
    return PoseErrors(*(float(value) for value in (angles.max(), distances.max(), _rms(angles), _rms(distances))))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
