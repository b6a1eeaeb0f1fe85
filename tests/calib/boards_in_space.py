"""Photos of a board as geometry: corners of boards held before a camera, with noise, no pixels."""

from __future__ import annotations

import dataclasses

import numpy as np

from calib.refine_views import BoardView
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

LENS = Camera("OPENCV", 1280, 960, np.array([1050.0, 1043.0, 651.0, 468.0, -0.21, 0.09, 0.0006, -0.0004]))
PINHOLE = Camera("PINHOLE", 1280, 960, np.array([1050.0, 1043.0, 651.0, 468.0]))
FISHEYE = Camera("OPENCV_FISHEYE", 1280, 960, np.array([420.0, 418.0, 634.0, 485.0, 0.03, -0.008, 0.004, -0.001]))


def flat_board(across: int = 9, down: int = 6, square: float = 0.03) -> np.ndarray:
    """Corners row by row, in metres, centred."""
    x, y = np.meshgrid(np.arange(across) - (across - 1) / 2, np.arange(down) - (down - 1) / 2)
    return np.stack([x.ravel() * square, y.ravel() * square, np.zeros(x.size)], 1)


def poses_before(
    camera: Camera, count: int, rng: np.random.Generator, tilt: float = 0.6, reach: float = 0.35
) -> list[Rigid3]:
    """Boards of about 0.25 m whose middles are spread over the image, tilted by up to `tilt` about any axis."""
    poses = []
    for _ in range(count):
        middle = np.array([camera.width, camera.height]) * rng.uniform(0.5 - reach, 0.5 + reach, 2)
        ray = camera.unproject(middle[None])[0][0]
        turn = Rotation3.exp(np.append(rng.uniform(-tilt, tilt, 2), 0.0)) @ Rotation3.exp(rng.uniform(-1, 1) * _Z)
        facing = _facing(ray)
        distance = (
            rng.uniform(0.3, 0.6) * camera.mean_focal_length / 1000 * (2.0 if camera.model_info.is_fisheye else 1)
        )
        poses.append(Rigid3(facing @ turn, distance * ray))
    return poses


_Z = np.array([0.0, 0.0, 1.0])


def _facing(ray: np.ndarray) -> Rotation3:
    """The shortest turn of the axis onto a ray."""
    axis = np.cross(_Z, ray)
    sine = np.linalg.norm(axis)
    return Rotation3.exp(axis / max(sine, 1e-12) * np.arctan2(sine, ray[2]))


def seen(
    camera: Camera, board: np.ndarray, poses: list[Rigid3], rng: np.random.Generator, noise_px: float = 0.1
) -> list[BoardView]:
    """Views of a board of any shape: the corners that lie in the image, with noise."""
    views = []
    for k, pose in enumerate(poses):
        pixels, valid = camera.project(pose @ board)
        inside = valid & np.all((pixels > 0) & (pixels < [camera.width, camera.height]), axis=1)
        ids = np.flatnonzero(inside)
        noisy = pixels[ids] + noise_px * rng.normal(size=(len(ids), 2))
        views.append(BoardView(f"view{k:02d}", camera.width, camera.height, ids, noisy))
    return views


def with_corners(view: BoardView, points2D: np.ndarray) -> BoardView:
    """The same view with other pixels."""
    return dataclasses.replace(view, points2D=points2D)
