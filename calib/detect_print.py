"""Whether a photo shows around a corner what is printed there.

A crossing of two edges is soon found: the border of a hand over a square is one. The cells of markers around it are
not. Which point of the board is at which pixel is told by a plane before a lens, moved onto the corner.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from calib.boards import Board
from calib.boards_artwork import artwork, older_charuco
from calib.detect_plane import fit_plane
from sfm.core.arrays import Points2D

_REACH = 0.55
"""Half the side of the part of the board that is compared, by a square or tag: the next corners are outside."""
_SAMPLES = 21
"""In a row of it."""
_TEXELS = 40
"""A square or tag; a cell of its marker has four and more."""
_LARGEST_DRAWING = 6000
_LEAST_SEEN = 0.3
"""Share of the samples that must be in the image and on the board to tell anything."""


def resemblances(
    grey: UInt8[np.ndarray, "H W"], board: Board, ids: Int64[np.ndarray, " N"], points2D: Points2D
) -> Float64[np.ndarray, " N"]:
    """Correlation of a photo and the artwork around each corner of a board with markers.

    A ChArUco board may have either layout, and any board be printed white on black: most corners tell.

    Args:
        ids, points2D: all corners, at least four and not on a line; px.
    Returns:
        In [−1, 1]; NaN where too little is in the image.
    """
    plane = fit_plane(board.points3D[ids, :2], points2D, (grey.shape[1], grey.shape[0]))
    u, v = np.meshgrid(*2 * [np.linspace(-_REACH, _REACH, _SAMPLES) * board.pitch_m])
    places = board.points3D[ids, None, :2] + np.stack([u, v], axis=2).reshape(1, -1, 2)
    pixels = plane.image(places.reshape(-1, 2)).reshape(places.shape)
    pixels += (points2D - plane.image(board.points3D[ids, :2]))[:, None]
    seen = np.all((pixels > 0) & (pixels < [grey.shape[1], grey.shape[0]]), axis=2)
    column, row = np.moveaxis(np.where(seen[..., None], pixels, 0).astype(int), 2, 0)
    brightness = grey[row, column].astype(np.float64)
    best = np.full(len(ids), np.nan)
    for older in (False, True) if board.kind == "charuco" else (False,):
        found = _correlations(brightness, *_printed(board, places, seen, older))
        if not np.isfinite(found).any():
            continue
        found = found if np.nanmedian(found) >= 0 else -found
        if np.isnan(best).all() or np.nanmedian(found) > np.nanmedian(best):
            best = found
    return best


def _correlations(
    brightness: Float64[np.ndarray, "N S"], printed: Float64[np.ndarray, "N S"], weights: Float64[np.ndarray, "N S"]
) -> Float64[np.ndarray, " N"]:
    count = np.where(weights.mean(axis=1) > _LEAST_SEEN, weights.sum(axis=1), np.nan)
    b, p = (values - ((weights * values).sum(axis=1) / count)[:, None] for values in (brightness, printed))
    spread = np.sqrt((weights * b * b).sum(axis=1) * (weights * p * p).sum(axis=1))
    return (weights * b * p).sum(axis=1) / np.maximum(spread, 1e-9)


def _printed(board: Board, places: np.ndarray, seen: np.ndarray, older: bool) -> tuple[np.ndarray, np.ndarray]:
    """1 for white and 0 for black at places on the board, and 1 where these are on the drawing and seen."""
    drawing, origin, texels_per_m = _drawing(board, older)
    down = -1 if board.kind == "aprilgrid" else 1
    column, row = np.moveaxis(((origin + places * [1, down]) * texels_per_m).astype(int), 2, 0)
    height, width = drawing.shape
    inside = seen & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    colours = drawing[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return colours.astype(np.float64), inside.astype(np.float64)


@functools.lru_cache(maxsize=4)
def _drawing(board: Board, older: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """The artwork in texels, where its first corner is in metres, and texels per metre."""
    drawn = older_charuco(board) if older else artwork(board)
    texels_per_m = min(_TEXELS / board.pitch_m, _LARGEST_DRAWING / max(drawn.width_m, drawn.height_m))
    image = np.ones([round(side * texels_per_m) for side in (drawn.height_m, drawn.width_m)], np.uint8)
    for rectangles, colour in ((drawn.black, 0), (drawn.white, 1)):
        for x, y, w, h in rectangles * texels_per_m:
            image[round(y) : round(y + h), round(x) : round(x + w)] = colour
    return image, drawn.corners[0], texels_per_m
