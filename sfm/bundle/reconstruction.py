"""From a reconstruction to a problem, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Literal, TypeAlias

import numpy as np

from sfm.bundle.adjustment import squared_errors
from sfm.bundle.problem import BundleProblem
from sfm.core.arrays import BoolArray
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.cameras.camera import Camera
from sfm.core.cameras.models import CameraModel
from sfm.core.scene import Reconstruction

Intrinsics: TypeAlias = Literal["focal", "principal_point", "extra"]


def free_params_of(model: CameraModel, refine: Collection[Intrinsics]) -> BoolArray:
    """(12,) which parameters of a model are of the kinds named; `extra` is the distortion."""
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
    reconstruction: Reconstruction, refine: Collection[Intrinsics] = ("focal", "extra")
) -> BundleProblem:
    """All of a reconstruction, every pose and point free; narrow it with `dataclasses.replace`.

    Cameras are in the order of their ids, images and points in that of the reconstruction.
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
    )


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
    return dataclasses.replace(
        reconstruction,
        cameras=cameras,
        cams_from_world=problem.cams_from_world,
        points3D=problem.points3D,
        errors=np.where(count > 0, total / np.maximum(count, 1), -1.0),
    )
