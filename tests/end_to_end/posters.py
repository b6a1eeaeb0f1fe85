"""Photos of posters in space, by warps alone: exact, fast, and solid where the posters hang at several depths."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

_HALF = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
"""Our pixels, corner (0, 0), from OpenCV's, whose first pixel has its centre at (0, 0)."""


@dataclasses.dataclass(frozen=True)
class Poster:
    """A picture that hangs in the world: the place of its corner, and what one of its pixels is long, along x and y."""

    picture: np.ndarray
    corner: np.ndarray
    along_x: np.ndarray
    along_y: np.ndarray


def facing(picture: np.ndarray, center: tuple[float, float, float], width: float, turn: float = 0.0) -> Poster:
    """A poster of that width in world units, turned about its vertical axis, upright, facing along −z."""
    height_px, width_px = picture.shape[:2]
    step = width / width_px
    along_x, along_y = step * np.array([np.cos(turn), 0, np.sin(turn)]), step * np.array([0.0, 1, 0])
    return Poster(picture, np.array(center) - along_x * width_px / 2 - along_y * height_px / 2, along_x, along_y)


def photo_of(
    posters: Sequence[Poster], camera: Camera, cam_from_world: Rigid3, *, noise: float = 2.0, seed: int = 0
) -> np.ndarray:
    """RGB; later posters hide earlier ones. Around them is grey, and on all of it the noise of a sensor."""
    size = (camera.width, camera.height)
    canvas = np.full((camera.height, camera.width, 3), 110.0)
    for poster in posters:
        columns = np.column_stack([poster.along_x, poster.along_y, poster.corner])
        in_camera = cam_from_world.rotation.matrix @ columns
        in_camera[:, 2] += cam_from_world.translation
        matrix = np.linalg.inv(_HALF) @ camera.calibration_matrix @ in_camera @ _HALF
        picture = poster.picture.astype(np.float32)
        warped = cv2.warpPerspective(picture, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        inside = cv2.warpPerspective(np.ones(picture.shape[:2], np.float32), matrix, size, flags=cv2.INTER_LINEAR)
        canvas += inside[..., None] * (warped - canvas)
    canvas += noise * np.random.default_rng(seed).normal(size=canvas.shape)
    return np.clip(np.rint(canvas), 0, 255).astype(np.uint8)


def seen_from(center: tuple[float, float, float], omega: tuple[float, float, float] = (0, 0, 0)) -> Rigid3:
    """`cam_from_world` of a camera at `center` that looks along +z, then turned by the rotation vector."""
    turn = Rotation3.exp(np.array(omega, float))
    return Rigid3(turn, -(turn @ np.array(center, float)))
