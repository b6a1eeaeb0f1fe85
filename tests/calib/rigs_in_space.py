"""Photos of boards before several cameras at once, as geometry: corners with noise, no pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.refine_views import BoardView
from calib.rig_views import RigCamera
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.calib.boards_in_space import FISHEYE, LENS

RIGHT = Camera("OPENCV", 1280, 960, np.array([1061.0, 1055.0, 633.0, 489.0, -0.19, 0.07, -0.0003, 0.0005]))
AHEAD = Rigid3.identity()
BESIDE = Rigid3.exp(np.array([0.02, -0.05, 0.01, -0.12, 0.001, 0.004]))
ABOVE = Rigid3.exp(np.array([-0.3, 0.1, 0.02, 0.05, -0.08, 0.02]))
LENS_OF = {"OPENCV": "opencv4", "OPENCV_FISHEYE": "fisheye"}
PAIR = ((LENS, RIGHT), (AHEAD, BESIDE))
THREE = ((LENS, RIGHT, FISHEYE), (AHEAD, BESIDE, ABOVE))


def poses_before_rig(count: int, rng: np.random.Generator) -> list[Rigid3]:
    """rig_from_board of boards of about 0.25 m, tilted by up to 35° about any axis."""
    poses = []
    for _ in range(count):
        place = np.append(rng.uniform(-0.2, 0.2, 2), 1.0) * rng.uniform(0.4, 0.8)
        tilt = Rotation3.exp(np.append(rng.uniform(-0.6, 0.6, 2), 0.0))
        poses.append(Rigid3(tilt @ Rotation3.exp(np.array([0.0, 0.0, rng.uniform(-1, 1)])), place))
    return poses


def photographed(
    cameras: Sequence[Camera], mounts: Sequence[Rigid3], board: np.ndarray, poses: Sequence[Rigid3],
    rng: np.random.Generator, noise_px: float = 0.1, least: int = 12,
) -> list[RigCamera]:  # fmt: skip
    """What cameras called cam0 … see of a board of any shape; views with fewer corners are not there."""
    seen = []
    for c, (camera, mount) in enumerate(zip(cameras, mounts, strict=True)):
        views, frames = [], []
        for f, pose in enumerate(poses):
            pixels, valid = camera.project(mount @ pose @ board)
            ids = np.flatnonzero(valid & np.all((pixels > 0) & (pixels < [camera.width, camera.height]), axis=1))
            if len(ids) >= least:
                noisy = pixels[ids] + noise_px * rng.normal(size=(len(ids), 2))
                views.append(BoardView(f"cam{c}-{f:02d}", camera.width, camera.height, ids, noisy))
                frames.append(f"{f:02d}")
        seen.append(RigCamera(f"cam{c}", tuple(views), tuple(frames), LENS_OF[camera.model]))
    return seen
