"""Images of another size or shape.

This module and the border to OpenCV's calibration are the only places that know that OpenCV puts the centre of the
first pixel at (0, 0), and we at (½, ½).
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32


def resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The image at another size, its corners kept in place: pixel coordinates scale by the ratio of the sizes.

    Shrinking averages the area of each new pixel, so that nothing aliases; enlarging is bilinear.

    Raises:
        ValueError: the size is not positive.
    """
    if width < 1 or height < 1:
        raise ValueError(f"expected a positive image size, got {width} x {height}")
    if image.shape[:2] == (height, width):
        return image
    shrinks = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def remap(
    image: np.ndarray,
    map_x: Float32[np.ndarray, "H W"],
    map_y: Float32[np.ndarray, "H W"],
    *,
    nearest: bool = False,
    fill: float = 0.0,
) -> np.ndarray:
    """The image seen through a grid of source coordinates, e.g. that of `cameras.undistortion`.

    Args:
        map_x, map_y: px in `image`, for each pixel of the result; the centre of the first pixel is (½, ½).
        nearest: takes the pixel in which the coordinates lie, for masks and labels; otherwise bilinear.
        fill: value where the coordinates are outside the image or NaN.
    """
    height, width = image.shape[:2]
    inside = (map_x >= 0) & (map_x <= width) & (map_y >= 0) & (map_y <= height)
    x, y = np.where(inside, map_x - np.float32(0.5), 0), np.where(inside, map_y - np.float32(0.5), 0)
    interpolation = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    # The outer half of a border pixel has no neighbour to blend with: it repeats.
    result = cv2.remap(image, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
    result[~inside] = fill
    return result
