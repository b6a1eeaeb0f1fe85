"""The figures of a calibration's report, each as SVG; what they show is computed in `uncertainty` and `diagnose`."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np

from calib import report_svg as svg
from calib.diagnose import board_tilts
from calib.refine import Calibration
from calib.refine_board import BoardShape
from calib.refine_views import Observations
from calib.report_svg import Frame
from calib.uncertainty import CalibrationCovariance, uncertainty_map
from sfm.core.arrays import FloatArray
from sfm.core.cameras import Camera

_ACROSS = 24
"""Cells of an image's width."""
_MIN_IN_CELL = 3
"""Corners that a mean is taken of."""
_WORST_PART = 0.98
"""Quantile that the scale of colours ends at: single cells at the border would take it all."""


@runtime_checkable
class CameraResiduals(Protocol):
    """What figures of one camera show: a `Calibration`, or one camera of a rig."""

    @property
    def camera(self) -> Camera:
        """The camera."""
        ...

    @property
    def observations(self) -> Observations:
        """What it saw."""
        ...

    @property
    def residuals(self) -> FloatArray:
        """(n, 2) projected − observed, px."""
        ...


def image_frame(camera: Camera) -> Frame:
    """The image, px."""
    return Frame(0.0, float(camera.width), 0.0, float(camera.height))


def coverage_figure(found: CameraResiduals) -> str:
    """All corners in the image; bare places are where the calibration is a guess."""
    frame = image_frame(found.camera)
    points2D = found.observations.points2D
    worst = np.hypot(*found.residuals.T)
    high = float(np.quantile(worst, _WORST_PART))
    parts = [
        svg.dot(frame, x, y, 1.6, svg.color_of(size, 0.0, high))
        for (x, y), size in zip(points2D[np.argsort(worst)], np.sort(worst), strict=True)
    ]
    return svg.figure(
        frame, f"Coverage: {len(points2D)} corners of {len(found.observations)} views, by their residual",
        [*parts, *svg.ticks(frame)], across="px",
        legend=svg.color_legend(frame, 0.0, high, "px", most=float(worst.max())),
    )  # fmt: skip


def residual_field_figure(found: CameraResiduals) -> str:
    """The mean residual in cells of the image, drawn longer; a right lens model leaves arrows of any direction."""
    frame = image_frame(found.camera)
    across = max(6, min(_ACROSS, round(math.sqrt(len(found.residuals) / 12))))
    means, centers = cell_means(found.observations.points2D, found.residuals, found.camera, across)
    if not len(means):
        return svg.figure(frame, "Residual field: too few corners in any cell", [])
    lengths = np.hypot(*means.T)
    gain = 0.8 * found.camera.width / across / max(float(np.quantile(lengths, _WORST_PART)), 1e-12)
    gain = min(gain, _gain_within(frame, centers, means))
    parts = [svg.arrow(frame, c, m * gain, svg.ACCENT) for c, m in zip(centers, means, strict=True)]
    return svg.figure(
        frame, f"Residual field: means over cells, {gain:.0f} times as long (longest {lengths.max():.3f} px)",
        [*parts, *svg.ticks(frame)], across="px",
    )  # fmt: skip


def _gain_within(frame: Frame, starts: FloatArray, shifts: FloatArray) -> float:
    """The most by which shifts may be multiplied and end in the frame."""
    room = np.where(shifts > 0, [frame.x1, frame.y1] - starts, starts - [frame.x0, frame.y0])
    return float(np.min(room / np.maximum(np.abs(shifts), 1e-12)))


def cell_means(points2D: FloatArray, values: FloatArray, camera: Camera, across: int) -> tuple[FloatArray, FloatArray]:
    """(m, 2) means of values (n, 2) over square cells with enough corners, and the cells' centres (m, 2) in px."""
    size = camera.width / across
    down = max(1, math.ceil(camera.height / size))
    column = np.clip((points2D[:, 0] / size).astype(int), 0, across - 1)
    row = np.clip((points2D[:, 1] / size).astype(int), 0, down - 1)
    cell = row * across + column
    counts = np.bincount(cell, minlength=across * down)
    sums = np.stack([np.bincount(cell, value, across * down) for value in values.T], 1)
    full = np.flatnonzero(counts >= _MIN_IN_CELL)
    centers = np.stack([full % across + 0.5, full // across + 0.5], 1) * size
    return sums[full] / counts[full, None], centers


def residual_scatter_figure(found: Calibration) -> str:
    """All residuals as points; rings at one, two and three standard deviations."""
    sigma, residuals = found.sigma_px, found.residuals
    reach = float(max(4 * sigma, np.quantile(np.abs(residuals), 0.995) * 1.1, 1e-6))
    frame = Frame(-reach, reach, -reach, reach)
    inside = residuals[np.all(np.abs(residuals) < reach, axis=1)]
    beyond = len(residuals) - len(inside)
    parts = [svg.dot(frame, x, y, 1.3, svg.ACCENT, opacity=0.5) for x, y in inside]
    parts += [svg.ring(frame, 0.0, 0.0, k * sigma, svg.WARNING) for k in (1, 2, 3)]
    title = f"Residuals; rings at 1, 2, 3 σ, σ = {sigma:.4f} px" + (f"; {beyond} lie beyond" if beyond else "")
    return svg.figure(frame, title, [*parts, *svg.ticks(frame)], across="px")


def uncertainty_figure(
    found: Calibration, covariances: CalibrationCovariance, distance: float = math.inf, words: str = "far away"
) -> str:
    """Standard deviation of a pixel, in its worst direction, over the image."""
    frame = image_frame(found.camera)
    deviations, _ = uncertainty_map(found, covariances, distance, across=_ACROSS)
    known = deviations[np.isfinite(deviations)]
    if not len(known):
        return svg.figure(frame, f"Uncertainty {words}: no pixel has a ray", [])
    low, high = 0.0, float(np.quantile(known, _WORST_PART))
    middle = deviations[deviations.shape[0] // 2, deviations.shape[1] // 2]
    return svg.figure(
        frame, f"Uncertainty (1 σ) {words}: {middle:.3f} px in the middle, {known.max():.3f} px at most",
        [*svg.cells(frame, deviations, low, high, "px"), *svg.ticks(frame)], across="px",
        legend=svg.color_legend(frame, low, high, "px", most=float(known.max())),
    )  # fmt: skip


def board_figure(shape: BoardShape) -> str:
    """Where the points of the board lie beside the design: their height by colour, arrows for the rest."""
    points, moved = shape.given, shape.displacements * 1e3
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    margin = 0.08 * float(np.max(high - low))
    frame = Frame(low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin)
    if shape.kind == "flat":
        parts = [svg.dot(frame, x, y, 3.0, svg.ACCENT) for x, y, _ in points]
        return svg.figure(frame, "Board: taken to be flat and exactly as designed", parts)
    bottom, top = float(moved[:, 2].min()), float(moved[:, 2].max())
    sideways = np.hypot(*moved[:, :2].T)
    gain = 0.6 * margin / max(float(sideways.max()), 1e-9)
    parts = []
    for point, shift in zip(points, moved, strict=True):
        parts.append(
            svg.dot(frame, point[0], point[1], 5.0, svg.color_of(shift[2], bottom, top), title=f"z {shift[2]:+.3f} mm")
        )
        if sideways.max() > 0:
            parts.append(svg.arrow(frame, point[:2], shift[:2] * gain, svg.INK))
    title = f"Board ({shape.kind}): bent by {top - bottom:.3f} mm"
    if sideways.max() > 0:
        title += f", sideways at most {sideways.max():.3f} mm"
    return svg.figure(frame, title, parts, legend=svg.color_legend(frame, bottom, top, "z, mm"))


def views_figure(found: Calibration) -> str:
    """RMS error of each view, in the order of the photos."""
    rms = found.view_rms_px
    top = float(rms.max()) * 1.12 + 1e-12
    frame = Frame(0.0, float(len(rms)), 0.0, top, up=True, ratio=0.42)
    median = float(np.median(rms))
    parts = []
    for v, (name, error) in enumerate(zip(found.observations.names, rms, strict=True)):
        color = svg.WARNING if error > 2 * median else svg.ACCENT
        left, width = frame.x(v + 0.1), 0.8 * frame.scale
        parts.append(
            f'<rect x="{left:.1f}" y="{frame.y(error):.1f}" width="{width:.1f}" '
            f'height="{frame.y(0.0) - frame.y(error):.1f}" fill="{color}"><title>{svg.escape(name)}: {error:.3f} px'
            "</title></rect>"
        )
    parts.append(svg.line(frame, (0.0, median), (float(len(rms)), median), svg.INK))
    return svg.figure(
        frame, f"RMS error of each view, px; median {median:.3f}, worst {rms.max():.3f}",
        [*parts, *svg.ticks(frame, x=False)], across="views",
    )  # fmt: skip


def tilts_figure(found: Calibration) -> str:
    """How boards were tilted: the further out the steeper, in the direction in which they lean."""
    angles, directions = board_tilts(found)
    tilts = np.degrees(angles)
    reach = max(60.0, float(tilts.max()) + 5.0)
    frame = Frame(-reach, reach, -reach, reach)
    parts = [svg.ring(frame, 0.0, 0.0, float(radius)) for radius in range(15, int(reach), 15)]
    parts += [
        svg.dot(frame, tilt * math.cos(angle), tilt * math.sin(angle), 4.0, svg.ACCENT, title=f"{name}: {tilt:.0f}°")
        for name, tilt, angle in zip(found.observations.names, tilts, directions, strict=True)
    ]
    title = f"Tilts of the board, degrees from facing the camera: median {np.median(tilts):.0f}°"
    return svg.figure(frame, title, [*parts, *svg.ticks(frame)], across="rings every 15°; wanted: 15° to 45° all round")
