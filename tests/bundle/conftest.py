"""Problems with known answers, made with the `Camera` that users see."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleProblem
from sfm.core.cameras import Camera
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.geometry.rigid import Rigid3

PARAMS = {
    "PINHOLE": [800.0, 820.0, 500.0, 380.0],
    "SIMPLE_RADIAL": [800.0, 500.0, 380.0, -0.05],
    "OPENCV": [800.0, 820.0, 500.0, 380.0, -0.05, 0.02, 0.001, -0.002],
    "OPENCV_FISHEYE": [500.0, 510.0, 500.0, 380.0, 0.02, -0.005, 0.001, -0.0002],
    "FULL_OPENCV": [800.0, 820.0, 500.0, 380.0, -0.05, 0.02, 0.001, -0.002, 0.003, 0.01, 0.002, 0.001],
    "EUCM": [600.0, 610.0, 500.0, 380.0, 0.6, 1.1],
}


def looking_inwards(images: int, rng: np.random.Generator, radius: float = 6.0) -> Rigid3:
    """Cameras on a ring with bumps, their axes near the origin."""
    poses = []
    for k in range(images):
        angle = 2.2 * k / max(images - 1, 1)
        center = radius * np.array([np.sin(angle), 0.3 * rng.normal(), -np.cos(angle)]) * rng.uniform(0.8, 1.2)
        z = -center / np.linalg.norm(center)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        poses.append(Rigid3.exp(0.02 * rng.normal(size=6)) @ Rigid3.from_matrix(np.c_[R, -R @ center]))
    return Rigid3.stack(poses)


def build(
    rng: np.random.Generator, *, images: int = 6, points: int = 60, model: str = "PINHOLE", cameras: int = 1,
    noise_px: float = 0.0, seen: float = 0.8, free_params: tuple[int, ...] = (),
) -> BundleProblem:  # fmt: skip
    """A problem at its true parameters; everything free but the intrinsics that are not in `free_params`."""
    camera = Camera(model, 1000, 760, np.array(PARAMS[model]))
    poses, points3D = looking_inwards(images, rng), rng.uniform(-1.5, 1.5, (points, 3))
    rows = np.argwhere(rng.random((points, images)) < seen)
    rng.shuffle(rows)
    in_camera = poses[rows[:, 1]] @ points3D[rows[:, 0]]
    points2D, valid = camera.project(in_camera)
    params, free = np.zeros((cameras, MAX_PARAMS)), np.zeros((cameras, MAX_PARAMS), bool)
    params[:, : len(camera.params)] = camera.params
    free[:, list(free_params)] = True
    return BundleProblem(
        model_ids=np.full(cameras, camera.model_info.model_id, np.int32),
        camera_params=params,
        image_cameras=(np.arange(images) % cameras).astype(np.int32),
        cams_from_world=poses,
        points3D=points3D,
        obs_images=rows[valid, 1].astype(np.int32),
        obs_points=rows[valid, 0].astype(np.int32),
        obs_points2D=points2D[valid] + noise_px * rng.normal(size=(int(valid.sum()), 2)),
        free_params=free,
        free_poses=np.ones(images, bool),
        free_points=np.ones(points, bool),
    )


def perturb(problem: BundleProblem, rng: np.random.Generator, size: float = 0.02) -> BundleProblem:
    """Moves what is free of a problem."""
    tangent = size * rng.normal(size=(len(problem.free_poses), 6)) * problem.free_poses[:, None]
    points = problem.points3D + size * rng.normal(size=problem.points3D.shape) * problem.free_points[:, None]
    relative = 1 + size * rng.normal(size=problem.camera_params.shape) * problem.free_params
    return dataclasses.replace(
        problem,
        cams_from_world=Rigid3.exp(tangent) @ problem.cams_from_world,
        points3D=points,
        camera_params=problem.camera_params * relative,
    )


@pytest.fixture
def make_problem():
    return build


@pytest.fixture
def perturbed():
    return perturb
