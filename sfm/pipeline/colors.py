"""Colours of the points, taken from the photos."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from sfm.core.arrays import ImageU8
from sfm.core.scene import Reconstruction


def colorize(reconstruction: Reconstruction, read_image: Callable[[str], ImageU8]) -> Reconstruction:
    """The reconstruction with each point in the mean colour of the pixels that observe it.

    Args:
        read_image: the RGB image of a name, at the size of its camera.
    """
    tracks = reconstruction.tracks
    rows, track_ids, points2D = reconstruction.image_rows, tracks.track_ids, reconstruction.observations
    sums = np.zeros((len(tracks), 3), np.int64)
    for row, name in enumerate(reconstruction.image_names):
        seen = np.flatnonzero(rows == row)
        if len(seen):
            np.add.at(sums, track_ids[seen], _sampled(read_image(name), points2D[seen]))
    counts = np.maximum(tracks.lengths, 1)[:, None]
    return dataclasses.replace(reconstruction, colors=((sums + counts // 2) // counts).astype(np.uint8))


def _sampled(image: ImageU8, points2D: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    x = np.clip(np.floor(points2D[:, 0]).astype(int), 0, width - 1)
    y = np.clip(np.floor(points2D[:, 1]).astype(int), 0, height - 1)
    return image[y, x].astype(np.int64)
