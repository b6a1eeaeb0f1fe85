"""Features of an image and of simulated views of it, as if its plane were seen from aside.

A plane that is seen at an angle θ from its normal is shorter by t = 1 / cos θ in one direction. The views are those of
tilts t = √2ᵏ, each in directions φ that are b / t apart (b = 72°) over half a turn: the image is turned by φ, blurred
along x by what a t times coarser sampling cannot hold, and squeezed by t.  x_view = A x,  x = A⁻¹ x_view, in the
convention that has pixel centres at one half throughout.

What a view finds and an earlier one has found already, at the same place with nearly the same descriptor, is left
out: two neighbours of one match would fail the ratio test.

Reference:
    Morel & Yu, ASIFT, a new framework for fully affine invariant image comparison, SIAM J. Imaging Sciences 2009.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from sfm.features.keypoints import Described, Keypoints, Selection, joined

_DIRECTION_STEP_DEG = 72.0
_BLUR = 0.8
"""σ before a reduction, in units of √(t² − 1): Morel and Yu's value."""
_SAME_PLACE_PX = 2.0
_SAME_DESCRIPTOR = 0.5
"""Of the median distance between descriptors of different places; nearer ones are the same feature again."""

Detect: TypeAlias = Callable[[np.ndarray, Selection], Described]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class SimulatedView:
    """A view, `view_from_image` (2, 3) in px with pixel centres at one half, and where the view shows the image."""

    image: UInt8[np.ndarray, "h w"]
    view_from_image: Float64[np.ndarray, "2 3"]
    visible: Bool[np.ndarray, "h w"]


def simulated_views(grey: UInt8[np.ndarray, "H W"], tilts: int) -> Iterator[SimulatedView]:
    """All views of the first `tilts` tilts; the image itself is not among them."""
    for k in range(1, tilts + 1):
        tilt = 2 ** (k / 2)
        for direction in np.deg2rad(np.arange(0, 180, _DIRECTION_STEP_DEG / tilt)):
            yield _view(grey, tilt, float(direction))


def _view(grey: np.ndarray, tilt: float, direction: float) -> SimulatedView:
    height, width = grey.shape
    c, s = np.cos(direction), np.sin(direction)
    turn = np.array([[c, -s], [s, c]])
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64) @ turn.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.ceil(high - low).astype(int)
    turned = _warped(grey, np.column_stack([turn, -low]), size, cv2.INTER_LINEAR)
    blurred = cv2.GaussianBlur(turned, (0, 0), _BLUR * np.sqrt(tilt**2 - 1), sigmaY=0.01)
    squeeze = np.diag([1 / tilt, 1.0])
    squeezed = np.array([np.ceil(size[0] / tilt), size[1]]).astype(int)
    view = _warped(blurred, np.column_stack([squeeze, np.zeros(2)]), squeezed, cv2.INTER_LINEAR)
    view_from_image = squeeze @ np.column_stack([turn, -low])
    shown = _warped(np.full_like(grey, 255), view_from_image, squeezed, cv2.INTER_NEAREST)
    return SimulatedView(view, view_from_image, shown > 0)


def _warped(image: np.ndarray, A: np.ndarray, size: np.ndarray, interpolation: int) -> np.ndarray:
    """`A` takes pixels with their centres at one half; OpenCV wants them at 0."""
    at_zero = np.column_stack([A[:, :2], A[:, 2] + A[:, :2] @ [0.5, 0.5] - 0.5])
    return cv2.warpAffine(image, at_zero, (int(size[0]), int(size[1])), flags=interpolation)


def detect_in_views(
    grey: UInt8[np.ndarray, "H W"], tilts: int, detect: Detect, select: Selection, distance: Callable[..., np.ndarray]
) -> Described:
    """What `detect` finds in the image and in all its views, in px of the image.

    Args:
        select: is asked once, for the features of all views together.
        distance: between the rows of two tables of descriptors.
    """
    keypoints, descriptors = detect(grey, _all_of)
    parts, tables = [keypoints], [descriptors]
    for view in simulated_views(grey, tilts):
        found, table = detect(view.image, _well_within(view.visible))
        parts.append(_in_image(found, view.view_from_image))
        tables.append(table)
    merged, table = joined(parts), np.concatenate(tables)
    new = _without_repeats(merged, table, np.repeat(np.arange(len(parts)), [len(p) for p in parts]), distance)
    merged, table = merged[new], table[new]
    rows = select(merged)
    return merged[rows], table[rows]


def _all_of(keypoints: Keypoints) -> np.ndarray:
    return np.arange(len(keypoints))


def _well_within(visible: np.ndarray) -> Selection:
    """Keypoints whose surroundings are part of the image: the border of the view's content is no edge of the scene."""
    far = cv2.distanceTransform(np.pad(visible, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]

    def select(keypoints: Keypoints) -> np.ndarray:
        x, y = np.floor(keypoints.points2D).astype(int).T
        x, y = np.clip(x, 0, far.shape[1] - 1), np.clip(y, 0, far.shape[0] - 1)
        return np.flatnonzero(far[y, x] > 6 * keypoints.scales)

    return select


def _in_image(keypoints: Keypoints, view_from_image: np.ndarray) -> Keypoints:
    back = np.linalg.inv(view_from_image[:, :2])
    directions = np.stack([np.cos(keypoints.orientations), np.sin(keypoints.orientations)], axis=1) @ back.T
    return Keypoints(
        (keypoints.points2D - view_from_image[:, 2]) @ back.T,
        (keypoints.scales * np.sqrt(abs(np.linalg.det(back)))).astype(np.float32),
        (np.arctan2(directions[:, 1], directions[:, 0]) % (2 * np.pi)).astype(np.float32),
        keypoints.responses,
    )


def _without_repeats(
    keypoints: Keypoints, descriptors: np.ndarray, views: np.ndarray, distance: Callable[..., np.ndarray]
) -> np.ndarray:
    """Rows that say something new: at their place, no earlier view has a descriptor like theirs."""
    from scipy.spatial import KDTree

    count = len(keypoints)
    if count < 2:
        return np.arange(count)
    pairs = KDTree(keypoints.points2D).query_pairs(_SAME_PLACE_PX, output_type="ndarray")
    pairs = pairs[views[pairs[:, 0]] != views[pairs[:, 1]]]
    unlike = np.median(distance(descriptors[: count // 2], descriptors[count - count // 2 :]))
    alike = distance(descriptors[pairs[:, 0]], descriptors[pairs[:, 1]]) < _SAME_DESCRIPTOR * unlike
    repeats = np.maximum(pairs[alike, 0], pairs[alike, 1])  # rows are in the order of the views
    return np.setdiff1d(np.arange(count), repeats)
