"""From a reconstruction to a problem, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Literal, TypeAlias

import numpy as np

from sfm.bundle.adjustment import squared_errors
from sfm.bundle.problem import BundleProblem
from sfm.bundle.rig_arrays import RigArrays
from sfm.core.arrays import BoolArray
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.cameras.camera import Camera
from sfm.core.cameras.models import CameraModel
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Frame, Reconstruction, Rig

Intrinsics: TypeAlias = Literal["focal", "principal_point", "extra"]


def free_params_of(model: CameraModel, refine: Collection[Intrinsics]) -> BoolArray:
    """(K,) which parameters of a model are of the kinds named; `extra` is the distortion."""
    free = np.zeros(MAX_PARAMS, bool)
    for kind, indices in (
        ("focal", model.focal_indices),
        ("principal_point", model.principal_point_indices),
        ("extra", model.extra_indices),
    ):
        if kind in refine:
            free[list(indices)] = True
    return free


def problem_from_reconstruction(
    reconstruction: Reconstruction, refine: Collection[Intrinsics] = ("focal", "extra"), *, refine_sensors: bool = False
) -> BundleProblem:
    """All of a reconstruction, every pose and point free; narrow it with `dataclasses.replace`.

    Cameras are in the order of their ids, images and points in that of the reconstruction. Images that were taken at
    one moment by a rig move together.

    Args:
        refine_sensors: whether the poses of sensors on their rigs are free too.

    Raises:
        ValueError: the pose of a sensor on its rig is not known.
    """
    cameras = list(reconstruction.cameras.values())
    params = np.zeros((len(cameras), MAX_PARAMS))
    for row, camera in zip(params, cameras, strict=True):
        row[: len(camera.params)] = camera.params
    images, points = len(reconstruction.image_ids), len(reconstruction.points3D)
    return BundleProblem(
        model_ids=np.array([camera.model_info.model_id for camera in cameras], np.int32),
        camera_params=params,
        image_cameras=np.searchsorted(list(reconstruction.cameras), reconstruction.image_camera_ids).astype(np.int32),
        cams_from_world=reconstruction.cams_from_world,
        points3D=reconstruction.points3D,
        obs_images=reconstruction.image_rows.astype(np.int32),
        obs_points=reconstruction.tracks.track_ids.astype(np.int32),
        obs_points2D=reconstruction.observations,
        free_params=np.array([free_params_of(c.model_info, refine) for c in cameras]).reshape(-1, MAX_PARAMS),
        free_poses=np.ones(images, bool),
        free_points=np.ones(points, bool),
        rigs=_rigs_of(reconstruction, refine_sensors),
    )


def _rigs_of(reconstruction: Reconstruction, refine_sensors: bool) -> RigArrays | None:
    """Which images move together; None where each moves by itself."""
    sensors = sensors_of(reconstruction)
    if not sensors:
        return None
    rows = {image_id: row for row, image_id in enumerate(reconstruction.image_ids)}
    image_frames = np.full(len(rows), -1, np.int32)
    image_sensors, poses = np.full(len(rows), -1, np.int32), []
    numbers = {key: row for row, key in enumerate(sensors)}
    for frame in reconstruction.frames:
        mine = [(camera_id, rows[k]) for camera_id, k in frame.image_ids.items() if k in rows]
        for camera_id, row in mine:
            image_frames[row], image_sensors[row] = len(poses), numbers.get((frame.rig_id, camera_id), -1)
        poses += [frame.rig_from_world] if mine else []
    for row in np.flatnonzero(image_frames < 0):
        image_frames[row] = len(poses)
        poses.append(reconstruction.cams_from_world[row])
    return RigArrays(
        image_frames, image_sensors, Rigid3.stack(poses), Rigid3.stack(list(sensors.values())),
        np.full(len(sensors), refine_sensors),
    )  # fmt: skip


def sensors_of(reconstruction: Reconstruction) -> dict[tuple[int, int], Rigid3]:
    """The poses on their rigs of all sensors but the references, by rig and camera, in the order of `RigArrays`.

    Raises:
        ValueError: one of them is not known.
    """
    sensors = {}
    for rig in reconstruction.rigs:
        for camera_id, pose in rig.sensors_from_rig.items():
            if pose is None:
                raise ValueError(f"the pose of camera {camera_id} on rig {rig.rig_id} is not known")
            sensors[rig.rig_id, camera_id] = pose
    return sensors


def _updated_rigs(reconstruction: Reconstruction, rigs: RigArrays) -> tuple[tuple[Rig, ...], tuple[Frame, ...]]:
    """Rigs and frames of the reconstruction with the poses of `rigs`."""
    numbers = {key: row for row, key in enumerate(sensors_of(reconstruction))}
    frame_of = dict(zip(reconstruction.image_ids, rigs.image_frames, strict=True))
    new_rigs = tuple(
        dataclasses.replace(
            rig, sensors_from_rig={c: rigs.sensors_from_rig[numbers[rig.rig_id, c]] for c in rig.sensors_from_rig}
        )
        for rig in reconstruction.rigs
    )
    frames = []
    for frame in reconstruction.frames:
        rows = [frame_of[k] for k in frame.image_ids.values() if k in frame_of]
        frames.append(dataclasses.replace(frame, rig_from_world=rigs.rigs_from_world[rows[0]]) if rows else frame)
    return new_rigs, tuple(frames)


def update_reconstruction(reconstruction: Reconstruction, problem: BundleProblem) -> Reconstruction:
    """The reconstruction with the cameras, poses and points of a problem that was made of it, and new errors.

    A point's error is the mean over the observations that have a projection, −1 where there is none.
    """
    cameras: dict[int, Camera] = {
        camera_id: dataclasses.replace(camera, params=row[: len(camera.params)])
        for (camera_id, camera), row in zip(reconstruction.cameras.items(), problem.camera_params, strict=True)
    }
    errors = np.sqrt(squared_errors(problem))
    valid, points = np.isfinite(errors), len(problem.points3D)
    count = np.bincount(problem.obs_points[valid], minlength=points)
    total = np.bincount(problem.obs_points[valid], weights=errors[valid], minlength=points)
    rigs, frames = reconstruction.rigs, reconstruction.frames
    if problem.rigs is not None:
        rigs, frames = _updated_rigs(reconstruction, problem.rigs)
    return dataclasses.replace(
        reconstruction,
        rigs=rigs,
        frames=frames,
        cameras=cameras,
        cams_from_world=problem.cams_from_world,
        points3D=problem.points3D,
        errors=np.where(count > 0, total / np.maximum(count, 1), -1.0),
    )
