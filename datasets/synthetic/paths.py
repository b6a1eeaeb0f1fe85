"""Ways of holding a camera: poses, and cameras of any model for a field of view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.core.cameras import Camera, model_by_name
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

_DISTORTION = {
    "SIMPLE_RADIAL": (-0.08,),
    "RADIAL": (-0.12, 0.03),
    "OPENCV": (-0.12, 0.03, 0.001, -0.0007),
    "FULL_OPENCV": (-0.05, 0.02, 0.001, -0.0007, 0.002, 0.06, 0.01, 0.001),
    "OPENCV_FISHEYE": (0.02, -0.006, 0.002, -0.0004),
    "SIMPLE_RADIAL_FISHEYE": (0.02,),
    "RADIAL_FISHEYE": (0.02, -0.004),
    "THIN_PRISM_FISHEYE": (0.02, -0.004, 0.0006, -0.0004, 0.0005, 0.0, 0.0004, -0.0003),
    "EUCM": (0.6, 1.1),
    "FULL_OPENCV_THIN_PRISM": (
        *(-0.05, 0.02, 0.001, -0.0007, 0.002, 0.06, 0.01, 0.001),
        *(0.0006, -0.0003, -0.0004, 0.0002),
    ),
    "DOUBLE_SPHERE": (-0.2, 0.55),
}
"""Typical lenses: a few per cent of barrel distortion at the corner."""


def example_camera(model: str, width: int, height: int, *, fov_deg: float = 60.0) -> Camera:
    """A camera of the model with a typical lens.

    Args:
        fov_deg: horizontal field of view: exact without distortion for perspective models (f = w / 2 tan), and
            for fisheye models (f = w / fov).
    Raises:
        ValueError: the model is unknown.
    """
    info = model_by_name(model)
    half = np.deg2rad(fov_deg) / 2
    if model == "EQUIRECTANGULAR":
        return Camera(model, width, height, np.array([width, height], float), has_prior_focal_length=True)
    focal = width / 2 / (half if info.is_fisheye and model not in ("EUCM", "DOUBLE_SPHERE") else np.tan(half))
    # A principal point that is not quite the centre, as in real cameras.
    centre = (width / 2 + 0.004 * width, height / 2 - 0.003 * width)
    focals = [focal] * len(info.focal_indices)
    params = np.array([*focals, *centre, *_DISTORTION.get(model, ())])
    return Camera(model, width, height, params, has_prior_focal_length=True)


def look_at(center: Sequence[float], target: Sequence[float], *, roll_deg: float = 0.0) -> Rigid3:
    """The pose `cam_from_world` at `center` with `target` in the middle and the world's z axis upward in the image.

    Raises:
        ValueError: the view is straight up or down: the image has no upward direction then.
    """
    centre = np.asarray(center, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - centre
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) <= 1e-9 * np.linalg.norm(forward):
        raise ValueError("the view is vertical, so that no direction is upward in the image")
    down = np.cross(forward, right)
    axes = np.stack([a / np.linalg.norm(a) for a in (right, down, forward)])
    turn = Rotation3.exp(np.array([0.0, 0.0, np.deg2rad(roll_deg)])) @ Rotation3.from_matrix(axes)
    return Rigid3(turn, -(turn @ centre))


def handheld(
    centers: np.ndarray, targets: np.ndarray, rng: np.random.Generator, *, sway: float, roll_deg: float = 2.0
) -> list[Rigid3]:
    """Poses at `centers` (I, 3) that look at `targets` (I, 3), both moved at random by about `sway` metres."""
    poses = []
    for center, target in zip(centers, targets, strict=True):
        move, aim = rng.normal(scale=sway, size=(2, 3))
        poses.append(look_at(center + move, target + aim, roll_deg=float(rng.normal(scale=roll_deg))))
    return poses


def arc(count: int, step_deg: float, radius: float, height: float, *, start_deg: float = 0.0) -> np.ndarray:
    """Places (I, 3) on a level circle around the origin, `step_deg` apart, at most one turn in all."""
    step = min(step_deg, 360.0 / count)
    turn = np.deg2rad(start_deg + step * np.arange(count))
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(count, height)], -1)
