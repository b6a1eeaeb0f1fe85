"""From a camera with distortion to one without.

An image is undistorted by asking, for each pixel of the target, where its ray falls in the source. The target is a
PINHOLE camera with the focal lengths of the source times a zoom s. The ray at (x, y, 1) is seen at fx s x + cx, so

- no target pixel is blank if the target's border lies within the source's: s ≥ cx / |x| for all x along the left
  border of the source, likewise for the other three;
- every source pixel is kept if s ≤ the same ratios.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32

from sfm.core.arrays import BoolArray, Mask, Points2D, Rays
from sfm.core.cameras.camera import Camera

_ROWS_AT_ONCE = 64
"""Bounds the memory of a grid: rays and points of a whole photo would take twenty times its bytes."""


def undistorted_camera(
    camera: Camera, *, blank_pixels: float | None = None, max_field_of_view: float = math.radians(110)
) -> Camera:
    """A PINHOLE camera of the same image size for the undistorted image.

    Args:
        blank_pixels: None keeps the scale at the centre of the image. Otherwise from 0, where no target pixel is
            blank, to 1, where every source pixel is kept as far as `max_field_of_view` allows.
        max_field_of_view: bound, in radians, on twice the angle between the axis and the farther border, across the
            width and down the height; where it binds, the image is enlarged.
    Raises:
        ValueError: `blank_pixels` is outside [0, 1], or `max_field_of_view` outside (0, π).
    """
    if blank_pixels is not None and not 0.0 <= blank_pixels <= 1.0:
        raise ValueError(f"expected blank_pixels in [0, 1], got {blank_pixels}")
    if not 0.0 < max_field_of_view < math.pi:
        raise ValueError(f"expected max_field_of_view in (0, pi), got {max_field_of_view}")
    (fx, fy), (cx, cy) = camera.focal_lengths, camera.principal_point
    reach = math.tan(max_field_of_view / 2)
    least = max(max(cx, camera.width - cx) / (fx * reach), max(cy, camera.height - cy) / (fy * reach))
    zoom = max(1.0, least)
    if blank_pixels is not None:
        keeps_all, fills_all = (max(limit, least) for limit in _zoom_range(camera))
        zoom = keeps_all**blank_pixels * fills_all ** (1 - blank_pixels)
    params = np.array([fx * zoom, fy * zoom, cx, cy])
    return Camera("PINHOLE", camera.width, camera.height, params, camera.has_prior_focal_length)


def undistortion_grid(camera: Camera, target: Camera) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """Source pixel coordinates (x, y) in `camera` for each pixel of `target`, a camera at the same place.

    Coordinates have the convention of all points (centre of the first pixel at ½, ½) and may lie outside the source;
    they are NaN where the source has no pixel for the ray. `imaging.resample.remap` takes them as they are.
    """
    map_x = np.empty((target.height, target.width), np.float32)
    map_y = np.empty_like(map_x)
    columns = np.arange(target.width) + 0.5
    for top in range(0, target.height, _ROWS_AT_ONCE):
        rows = np.arange(top, min(top + _ROWS_AT_ONCE, target.height)) + 0.5
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        rays, _ = target.unproject(pixels)
        source, _ = camera.project(rays)
        map_x[top : top + len(rows)] = source[:, 0].reshape(len(rows), -1)
        map_y[top : top + len(rows)] = source[:, 1].reshape(len(rows), -1)
    return map_x, map_y


def pinhole_pixels(rays: Rays, valid: Mask, camera: Camera) -> Points2D:
    """Where rays would be seen without the distortion of a camera, px; NaN where they are not valid or point behind."""
    k = camera.calibration_matrix
    with np.errstate(invalid="ignore", divide="ignore"):
        pixels = rays[:, :2] / rays[:, 2:] * [k[0, 0], k[1, 1]] + k[:2, 2]
    pixels[~valid | ~(rays[:, 2] > 0)] = np.nan
    return pixels


def _zoom_range(camera: Camera) -> tuple[float, float]:
    """(s that keeps all of the source, s that leaves no blank), before any bound on the field of view."""
    (fx, fy), (cx, cy) = camera.focal_lengths, camera.principal_point
    width, height = camera.width, camera.height
    down, across = np.linspace(0, height, 129), np.linspace(0, width, 129)
    borders = [
        (0, fx, cx, np.stack([np.zeros_like(down), down], 1)),
        (0, fx, width - cx, np.stack([np.full_like(down, width), down], 1)),
        (1, fy, cy, np.stack([across, np.zeros_like(across)], 1)),
        (1, fy, height - cy, np.stack([across, np.full_like(across, height)], 1)),
    ]
    ratios = [length / (focal * _tangents(camera, border, axis)) for axis, focal, length, border in borders]
    return min(float(r.min()) for r in ratios), max(float(r.max()) for r in ratios)


def _tangents(camera: Camera, pixels: np.ndarray, axis: int) -> np.ndarray:
    """|x / z| (or |y / z|) of the pixels' rays; inf for those that are not in front or have none."""
    rays, valid = camera.unproject(pixels)
    front = valid & (rays[:, 2] > 0)
    tangents = np.full(len(pixels), np.inf)
    tangents[front] = np.maximum(np.abs(rays[front, axis]) / rays[front, 2], 1e-9)
    return tangents


def valid_rectangle(valid: BoolArray) -> tuple[int, int, int, int]:
    """(left, top, right, bottom), the last two beyond it, of a rectangle in which all pixels are valid.

    The side with the largest part of blank pixels gives way first, so that borders that bend alike lose alike.
    """
    top, left = 0, 0
    bottom, right = valid.shape
    while bottom > top and right > left:
        blank = ~valid[top:bottom, left:right]
        if not blank.any():
            break
        worst = int(np.argmax([blank[0].mean(), blank[-1].mean(), blank[:, 0].mean(), blank[:, -1].mean()]))
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)
    return left, top, right, bottom
