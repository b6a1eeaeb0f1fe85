"""A reconstruction in another frame."""

from __future__ import annotations

import dataclasses

from sfm.core.geometry.similarity import Sim3
from sfm.core.scene.reconstruction import Reconstruction
from sfm.core.scene.rigs import Frame, Rig


def transformed(reconstruction: Reconstruction, new_from_world: Sim3) -> Reconstruction:
    """Poses, points, rigs and frames in a world that a similarity gives; every point projects where it did."""
    return dataclasses.replace(
        reconstruction,
        cams_from_world=new_from_world.transform_pose(reconstruction.cams_from_world),
        points3D=new_from_world @ reconstruction.points3D,
        rigs=tuple(_scaled(rig, float(new_from_world.scale)) for rig in reconstruction.rigs),
        frames=tuple(_moved(frame, new_from_world) for frame in reconstruction.frames),
    )


def _scaled(rig: Rig, scale: float) -> Rig:
    sensors = {
        camera_id: None if pose is None else dataclasses.replace(pose, translation=scale * pose.translation)
        for camera_id, pose in rig.sensors_from_rig.items()
    }
    return dataclasses.replace(rig, sensors_from_rig=sensors)


def _moved(frame: Frame, new_from_world: Sim3) -> Frame:
    return dataclasses.replace(frame, rig_from_world=new_from_world.transform_pose(frame.rig_from_world))
