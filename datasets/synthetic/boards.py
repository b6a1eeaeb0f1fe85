"""Photos of boards whose corners are known: rays through a finely divided pixel grid, blur, noise, 8 bits."""

from __future__ import annotations

import cv2
import numpy as np

from calib.boards import Board
from calib.boards_artwork import artwork
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

PARTS = 3
"""Rays a pixel and axis. An edge along a row of pixels is off by up to a sixth of a pixel where texels are smaller than
that: with five rays it would be a tenth, but take three times as long."""
WHITE, BLACK = 0.82, 0.10
SURROUND = 0.4

PINHOLE = Camera("PINHOLE", 480, 360, np.array([420.0, 420, 240, 180]))
DISTORTED = Camera("OPENCV", 480, 360, np.array([420.0, 420, 240, 180, -0.28, 0.09, 0.001, -0.001]))
FISHEYE = Camera("OPENCV_FISHEYE", 480, 360, np.array([200.0, 200, 240, 180, 0.02, -0.01, 0.002, 0.0]))


def texture(board: Board, texels_per_m: float) -> np.ndarray:
    """The artwork in [0, 1], its edges on the borders of texels if the lengths are multiples of them."""
    drawn = artwork(board)
    height, width = (round(side * texels_per_m) for side in (drawn.height_m, drawn.width_m))
    image = np.full((height, width), WHITE, np.float32)
    for rectangles, colour in ((drawn.black, BLACK), (drawn.white, WHITE)):
        for x, y, w, h in rectangles * texels_per_m:
            image[round(y) : round(y + h), round(x) : round(x + w)] = colour
    for x, y, r in drawn.circles * texels_per_m:
        left, top, size = int(x - r) - 1, int(y - r) - 1, int(2 * r) + 4
        rows, columns = np.mgrid[top : top + size, left : left + size] + 0.5
        share = np.clip(r - np.hypot(columns - x, rows - y) + 0.5, 0, 1)
        image[top : top + size, left : left + size] += (share * (BLACK - WHITE)).astype(np.float32)
    return image


def pose(
    board: Board, distance_m: float, tilt_deg: float, axis_deg: float = 0.0, roll_deg: float = 0.0, shift=(0.0, 0.0)
) -> Rigid3:
    """cam_from_board: the middle of the board `distance_m` ahead, tilted about an axis in its plane, then rolled."""
    axis = np.radians(axis_deg)
    tilt = Rotation3.exp(np.radians(tilt_deg) * np.array([np.cos(axis), np.sin(axis), 0]))
    roll = Rotation3.exp(np.radians(roll_deg) * np.array([0, 0, 1.0]))
    # An AprilGrid has y up and z out of the paper.
    face = Rotation3.exp(np.array([np.pi, 0, 0])) if board.kind == "aprilgrid" else Rotation3.identity()
    rotation = roll @ tilt @ face
    middle = board.points3D.mean(axis=0)
    return Rigid3(rotation, np.array([*shift, distance_m]) - rotation @ middle)


def render(
    board: Board,
    camera: Camera,
    cam_from_board: Rigid3,
    *,
    blur_px: float = 0.7,
    noise: float = 0.01,
    seed: int = 0,
    texels_per_m: float = 4000.0,
) -> tuple[np.ndarray, np.ndarray]:
    """The photo as uint8, and the pixels of all corners (NaN where there is none)."""
    drawn, paint = artwork(board), texture(board, texels_per_m)
    y, x = (np.mgrid[: camera.height * PARTS, : camera.width * PARTS] + 0.5) / PARTS
    rays, seen = camera.unproject(np.column_stack([x.ravel(), y.ravel()]))
    board_from_cam = cam_from_board.inverse()
    centre, directions = board_from_cam.translation, board_from_cam.rotation @ rays
    depth = -centre[2] / directions[:, 2]
    hits = centre[:2] + depth[:, None] * directions[:, :2]
    sign = np.array([1, -1]) if board.kind == "aprilgrid" else np.array([1, 1])
    place = (hits * sign + drawn.corners[0]) * texels_per_m - 0.5
    place[~(seen & (depth > 0))] = -1e6
    columns, rows = np.moveaxis(place.astype(np.float32).reshape(*x.shape, 2), 2, 0)
    fine = cv2.remap(paint, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=SURROUND)
    fine = cv2.GaussianBlur(fine, (0, 0), blur_px * PARTS) if blur_px else fine
    image = fine.reshape(camera.height, PARTS, camera.width, PARTS).mean(axis=(1, 3))
    image = image + np.random.default_rng(seed).normal(0, noise, image.shape)
    points2D, valid = camera.project(cam_from_board @ board.points3D)
    return np.clip(np.rint(255 * image), 0, 255).astype(np.uint8), np.where(valid[:, None], points2D, np.nan)
