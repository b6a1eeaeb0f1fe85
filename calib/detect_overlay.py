"""A photo with what was detected drawn into it, to look at."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from calib.boards import Board
from calib.detect import Detection
from sfm.core.errors import Rejected
from sfm.core.imaging.resample import resize

_LEAST_SIZE_PX = 1200
_FRACTION_BITS = 4
_RED, _GREEN = (230, 30, 30), (20, 160, 60)
_SIGMAS = 100
"""Ellipses of uncertainty are drawn as large as this many deviations: 0.02 px becomes 2 px."""


def overlay(
    image: UInt8[np.ndarray, "H W"] | UInt8[np.ndarray, "H W 3"], board: Board, seen: Detection | Rejected
) -> UInt8[np.ndarray, "h w 3"]:
    """RGB: corners joined in the order of their ids, from blue to yellow, with ellipses of 100 σ; rejected ones red.

    Small photos are enlarged. Where no board was found, the reason stands in the picture.
    """
    scale = max(1, round(_LEAST_SIZE_PX / max(image.shape[:2])))
    canvas = resize(image, image.shape[1] * scale, image.shape[0] * scale)
    canvas = cv2.cvtColor(canvas, cv2.COLOR_GRAY2RGB) if canvas.ndim == 2 else canvas.copy()
    if not isinstance(seen, Detection):
        _write(canvas, f"{seen.reason}: {seen.detail}", _RED)
        return canvas
    colours = _colours(len(board.points3D))
    width, number_of = board.grid[0], {int(i): k for k, i in enumerate(seen.corner_ids)}
    for number, k in number_of.items():
        before = number_of.get(number - 1) if board.kind == "aprilgrid" or number % width else None
        if before is not None and not (board.kind == "aprilgrid" and number % 4 == 0):
            _line(canvas, seen.points2D[before] * scale, seen.points2D[k] * scale, colours[number])
    for number, k in number_of.items():
        _ellipse(canvas, seen.points2D[k] * scale, seen.covariances[k] * (scale * _SIGMAS) ** 2, colours[number])
    for point in seen.rejected2D * scale:
        for arm in ((5, 5), (5, -5)):
            _line(canvas, point - arm, point + arm, _RED)
    _write(canvas, f"{len(seen.points2D)} of {len(board.points3D)} corners, {len(seen.rejected)} rejected", _GREEN)
    return canvas


def _colours(count: int) -> list[tuple[int, int, int]]:
    ramp = cv2.applyColorMap(np.linspace(30, 240, max(count, 1)).astype(np.uint8)[:, None], cv2.COLORMAP_PLASMA)
    return [(int(r), int(g), int(b)) for b, g, r in ramp[:, 0]]


def _fixed(point: np.ndarray) -> tuple[int, int]:
    """OpenCV draws in coordinates whose origin is the centre of the first pixel, in sixteenths."""
    x, y = np.round((point - 0.5) * 2**_FRACTION_BITS).astype(int)
    return int(x), int(y)


def _line(canvas: np.ndarray, start: np.ndarray, end: np.ndarray, colour: tuple[int, int, int]) -> None:
    cv2.line(canvas, _fixed(start), _fixed(end), colour, 1, cv2.LINE_AA, _FRACTION_BITS)


def _ellipse(canvas: np.ndarray, centre: np.ndarray, covariance: np.ndarray, colour: tuple[int, int, int]) -> None:
    """One that is at least as large as a pixel, with a dot at its centre."""
    variances, axes = np.linalg.eigh(covariance)
    semi_axes = np.clip(np.sqrt(np.maximum(variances, 0.0)), 1.0, 60.0) * 2**_FRACTION_BITS
    angle = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    size = (int(semi_axes[0]), int(semi_axes[1]))
    cv2.ellipse(canvas, _fixed(centre), size, angle, 0, 360, colour, 1, cv2.LINE_AA, _FRACTION_BITS)


def _write(canvas: np.ndarray, text: str, colour: tuple[int, int, int]) -> None:
    """On white: letters drawn again, thicker, have other widths and would not lie under the thin ones."""
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.6
    (width, height), below = cv2.getTextSize(text, font, size, 1)
    x, y = 10, canvas.shape[0] - 12
    cv2.rectangle(canvas, (x - 4, y - height - 6), (x + width + 4, y + below + 2), (255, 255, 255), cv2.FILLED)
    cv2.putText(canvas, text, (x, y), font, size, colour, 1, cv2.LINE_AA)
