"""The figures of a rig's report, each as SVG: how cameras and boards stood, who saw what, and how well lines meet."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal, TypeAlias

import numpy as np

from calib import report_svg as svg
from calib.report_figures import image_frame
from calib.report_svg import Frame
from calib.rig_epipolar import distances_of_partners
from calib.rig_result import RigCalibration
from sfm.core.arrays import FloatArray
from sfm.core.cameras import Camera

Side: TypeAlias = Literal["above", "the right"]
"""Where the eye is: above, with forward up the page; or at the right, with forward to the right and down down."""

COLORS = (svg.ACCENT, "#2a8a5b", "#8a3ffc", svg.WARNING, "#b28600", "#0a7c86", "#a2191f", "#57606a")
"""Of cameras, in turn."""
_PLANES: dict[Side, tuple[int, int]] = {"above": (0, 2), "the right": (2, 1)}
"""Axes of the rig that run across and along the page."""
_WIDEST = math.radians(75.0)
"""Half of the largest field of view that is drawn as one."""
_MARGIN = 0.12
_WORST_PART = 0.98


def rig_figure(found: RigCalibration, side: Side, unit: str = "m") -> str:
    """Cameras with their fields of view, and the lines between them; axes in the board's unit."""
    centers = found.cams_from_rig.center
    spread = float(np.linalg.norm(np.ptp(centers, axis=0)))
    reach = 0.45 * spread or 0.3 * _board_size(found)
    wedges = [_wedge(found, c, side, reach) for c in range(len(found.names))]
    frame = _around(np.concatenate(wedges), side)
    flat = centers[:, list(_PLANES[side])]
    parts = [svg.line(frame, flat[0], other, svg.PALE, 1.5) for other in flat[1:]]
    if unit == "m":
        parts += [_length(frame, flat[0], flat[c], centers[0] - centers[c]) for c in range(1, len(flat))]
    for c, name in enumerate(found.names):
        parts += [*_outline(frame, wedges[c], COLORS[c % len(COLORS)]), _label(frame, flat[c], name, c)]
    return svg.figure(
        frame, f"The rig from {side}", [*parts, *svg.ticks(frame)], across=f"{_axes(side)}, {unit}"
    )  # fmt: skip


def boards_figure(found: RigCalibration, side: Side, unit: str = "m") -> str:
    """Boards as they stood before the rig; those that several cameras saw are drawn darker."""
    low, high = found.shape.given[:, :2].min(0), found.shape.given[:, :2].max(0)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    board = np.concatenate([corners, np.zeros((4, 1))], axis=1)
    outlines = [(pose @ board)[:, list(_PLANES[side])] for pose in _each(found)]
    wedges = [_wedge(found, c, side, 0.4 * _board_size(found)) for c in range(len(found.names))]
    frame = _around(np.concatenate([*outlines, *wedges]), side)
    views = found.observations.views_per_frame
    parts = []
    for f in np.argsort(views, kind="stable"):
        color = svg.INK if views[f] > 1 else svg.PALE
        parts += _outline(frame, outlines[f], color)
    for c, name in enumerate(found.names):
        parts += [*_outline(frame, wedges[c], COLORS[c % len(COLORS)]), _label(frame, wedges[c][0], name, c)]
    shared = int(np.count_nonzero(views > 1))
    title = f"Boards from {side}: {shared} of {len(views)} were seen by two cameras or more"
    return svg.figure(frame, title, [*parts, *svg.ticks(frame)], across=f"{_axes(side)}, {unit}")


def frames_figure(found: RigCalibration) -> str:
    """Who saw which frame, coloured by the RMS error of that view."""
    many, frames = len(found.names), len(found.observations.frames)
    errors = np.full((many, frames), np.nan)
    for c, seen in enumerate(found.observations.frame_of):
        errors[c, seen] = found.one_camera(c).view_rms_px
    high = float(np.nanmax(errors))
    frame = Frame(0.0, float(frames), 0.0, float(many), ratio=0.055 * many)
    names = [
        svg.text(40.0, frame.y(c + 0.5) + 4, name if len(name) < 7 else f"{name[:5]}…", anchor="end")
        for c, name in enumerate(found.names)
    ]
    shared = int(np.count_nonzero(found.observations.views_per_frame > 1))
    return svg.figure(
        frame, f"RMS error of each view; {shared} of {frames} frames were seen by two cameras or more",
        [*svg.cells(frame, errors, 0.0, high, "px"), *names], across="frames, in the order of their names",
        legend=svg.color_legend(frame, 0.0, high, "px"),
    )  # fmt: skip


def epipolar_figure(found: RigCalibration, camera1: int, camera2: int) -> str:
    """The image of one camera: how far corners lie from the epipolar lines of what another one saw."""
    pixels, apart = distances_of_partners(found, camera1, camera2)
    frame = image_frame(found.cameras[camera2])
    one, two = found.names[camera1], found.names[camera2]
    if not len(pixels):
        return svg.figure(frame, f"{one} and {two} saw no corner together", [])
    far = np.abs(apart)
    order, high = np.argsort(far, kind="stable"), float(np.quantile(far, _WORST_PART))
    parts = [svg.dot(frame, pixels[n, 0], pixels[n, 1], 1.8, svg.color_of(float(far[n]), 0.0, high)) for n in order]
    title = f"{two}: {len(far)} corners off the lines of {one} by {math.sqrt(float(np.mean(apart**2))):.3f} px (rms)"
    return svg.figure(
        frame, title, [*parts, *svg.ticks(frame)], across="px", legend=svg.color_legend(frame, 0.0, high, "px")
    )  # fmt: skip


def _each(found: RigCalibration) -> Iterator:
    poses = found.rigs_from_board
    return (poses[f] for f in range(len(poses)))


def _board_size(found: RigCalibration) -> float:
    return float(np.linalg.norm(np.ptp(found.shape.given, axis=0)))


def _wedge(found: RigCalibration, camera: int, side: Side, reach: float) -> FloatArray:
    """(3, 2) in the plane of the page: the camera's centre, and the ends of its field of view."""
    pose = found.cams_from_rig[camera].inverse()
    angle = _half_angle(found.cameras[camera], side)
    ahead, aside = math.cos(angle), math.sin(angle)
    across = np.array([1.0, 0.0, 0.0]) if side == "above" else np.array([0.0, 1.0, 0.0])
    ends = [np.array([0.0, 0.0, ahead]) + sign * aside * across for sign in (-1.0, 1.0)]
    points = np.stack([np.zeros(3), *(reach * end for end in ends)])
    return (pose @ points)[:, list(_PLANES[side])]


def _half_angle(camera: Camera, side: Side) -> float:
    """Of the field of view in this plane, as far as it can be drawn; the mean of both halves."""
    cx, cy = camera.principal_point
    far = [[0.0, cy], [camera.width, cy]] if side == "above" else [[cx, 0.0], [cx, camera.height]]
    rays, valid = camera.unproject(np.array(far, np.float64))
    angles = np.where(valid, np.arccos(np.clip(rays[:, 2], -1.0, 1.0)), _WIDEST)
    return min(float(angles.mean()), _WIDEST)


def _around(points: FloatArray, side: Side) -> Frame:
    """A frame with a margin, neither flat nor much higher than wide."""
    low, high = points.min(0), points.max(0)
    width, height = high - low
    width = max(width, 0.8 * height)
    height = max(height, 0.4 * width)
    (x, y), margin = (low + high) / 2, _MARGIN * max(width, height)
    half = np.array([width / 2, height / 2]) + margin
    return Frame(x - half[0], x + half[0], y - half[1], y + half[1], up=side == "above")


def _outline(frame: Frame, points: FloatArray, color: str) -> list[str]:
    return [svg.line(frame, points[k - 1], points[k], color, 1.3) for k in range(len(points))]


def _label(frame: Frame, at: FloatArray, name: str, camera: int) -> str:
    return svg.text(frame.x(at[0]) + 6, frame.y(at[1]) + 14, name, color=COLORS[camera % len(COLORS)])


def _length(frame: Frame, start: FloatArray, end: FloatArray, apart: FloatArray) -> str:
    x, y = (start + end) / 2
    words = f"{1e3 * float(np.linalg.norm(apart)):.2f} mm"
    return svg.text(frame.x(x), frame.y(y) - 5, words, anchor="middle", color="#57606a")


def _axes(side: Side) -> str:
    return "x to the right, z (forward) up" if side == "above" else "z (forward) to the right, y down"
