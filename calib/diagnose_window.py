"""Whether corners were shifted by the squares next to theirs, because they were refined in too large a window.

A refinement looks for the point that all edges in its window run towards. Edges of the next corners do not. On all
sides of a corner they pull against one another; at the rim of the board there is nothing on the other side. So where
the window reaches the next corners, those at the rim err by much more than those within; and where squares are larger
than the window they do not. No lens, no bend of the board and no blur does both.

    near, far     the third of all corners whose neighbours are nearest to them, in px, and that with the farthest
    rim, within   corners with fewer than four neighbours in their photo, and the others

What was left out of a calibration belongs to it: these are the outliers.

Reference:
    docs.opencv.org, camera calibration tutorial: a window of 11 px to either side, which reaches the next corners
    wherever squares are smaller than about 26 px.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from calib.diagnose import Finding
from calib.refine_views import Observations
from sfm.core.arrays import FloatArray, Value, Vector

SHARE_OF_SPACING = 0.35
"""Half-window over the smallest spacing of corners that does not reach the next ones, seen obliquely."""
_USUAL_WINDOW_PX = 11.0
"""To either side: OpenCV's tutorial and most scripts."""
_REACHED = 0.45
"""Of the spacing of corners, from where on a half-window begins to see the next ones."""
_RIM, _NEAR = 1.7, 1.4
"""Rms error at the rim over that within, and of near corners over far ones, that are told. With good corners of eleven
sets the first is 1.5 at most where near ones are worse at all; a window of 11 px where it is too large gives 2.1 to 5,
and 2.9 to 14."""
_VISIBLE_PX = 0.1
_FEWEST = 15
"""Corners of a kind that tell something."""
_NEXT = 1.2
"""Times the smallest distance on the board up to which corners are next to one another."""
_ABOVE = 1.5
"""Stated error over that of our corners of photos of the same camera, beyond which its corners were worse."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Crowding(Value):
    """Errors by how near the next corners are, rms in px; NaN where there are too few corners of a kind.

    Attributes:
        smallest_px: distance of two corners in the image.
        near_px, far_px: below which, and beyond which, the next corner is near or far.
        rim, within: of near corners.
        near, far: of all.
    """

    smallest_px: float
    near_px: float
    far_px: float
    rim: float
    within: float
    near: float
    far: float

    @property
    def is_shifted(self) -> bool:
        """Whether the next corners shift near ones at the rim."""
        return bool(self.rim > max(_RIM * self.within, _VISIBLE_PX) and self.near > _NEAR * self.far)


def crowding(observations: Observations, residuals: FloatArray) -> Crowding:
    """See the text of the module; residuals (n, 2) in px, projected − observed."""
    spacings, is_within = _neighbours(observations)
    known = np.isfinite(spacings)
    near_px, far_px = np.quantile(spacings[known], [1 / 3, 2 / 3]) if known.any() else (np.nan, np.nan)
    near, far = known & (spacings <= near_px), known & (spacings >= far_px)
    squares = np.sum(residuals**2, axis=1)
    # A corner with no projection is as wrong as can be, but there is no telling by how much.
    seen = np.isfinite(squares)

    def rms(which: np.ndarray) -> float:
        return float(np.sqrt(np.mean(squares[which & seen]))) if np.sum(which & seen) >= _FEWEST else np.nan

    return Crowding(
        smallest_px=float(spacings[known].min()) if known.any() else np.nan,
        near_px=float(near_px),
        far_px=float(far_px),
        rim=rms(near & ~is_within),
        within=rms(near & is_within),
        near=rms(near),
        far=rms(far),
    )


def window_finding(observations: Observations, residuals: FloatArray) -> Finding | None:
    """What speaks for a window that was too large, by the corners alone."""
    found = crowding(observations, residuals)
    if not found.is_shifted:
        return None
    return Finding(
        "window_too_large",
        f"where the next corner is nearest ({found.smallest_px:.0f} to {found.near_px:.0f} px), corners at the rim of "
        f"the board err by {found.rim:.2f} px and those within by {found.within:.2f} px; where it is farther than "
        f"{found.far_px:.0f} px all err by {found.far:.2f} px: the window of their refinement reached the next corners",
        _remedy(found.smallest_px),
    )


def stated_finding(
    stated_px: float, observations: Observations, residuals: FloatArray, *, is_ours: bool = False
) -> Finding | None:
    """What speaks for it by the error that a camera was calibrated with, beside that of our corners with this camera.

    Args:
        stated_px: rms error that its file states; NaN where it does not.
        residuals: of our corners.
        is_ours: its corners were found here, in a window that adapts to each photo.
    """
    ours = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
    if not stated_px > max(_ABOVE * ours, ours + _VISIBLE_PX):
        return None
    smallest = crowding(observations, residuals).smallest_px
    told = (
        f"its own corners erred by {stated_px:.3f} px when it was calibrated; ours of these photos err by {ours:.3f} px"
    )
    if not is_ours and _REACHED * smallest < _USUAL_WINDOW_PX:
        return Finding(
            "window_too_large",
            f"{told}: corners are {smallest:.0f} px apart, and the usual window of {_USUAL_WINDOW_PX:.0f} px to either "
            "side reaches the next ones",
            f"calibrate anew from photos; {_remedy(smallest)}",
        )
    return Finding("worse_corners", told, "calibrate anew, from photos as good as these")


def _remedy(smallest_px: float) -> str:
    half = max(2, int(SHARE_OF_SPACING * smallest_px))
    return (
        f"refine corners in a window of no more than {half} px to either side here, "
        "or give the photos: `calib` fits the window to each"
    )


def _neighbours(observations: Observations) -> tuple[Vector, np.ndarray]:
    """(n,) px to the nearest of the corners next to each on the board, inf without one; and whether it has four."""
    board = observations.board[:, :2]
    apart = np.linalg.norm(board[:, None] - board[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    is_next = apart <= _NEXT * apart.min(initial=np.inf)
    spacings, is_within = np.full(len(observations.rows), np.inf), np.zeros(len(observations.rows), bool)
    for v in range(len(observations)):
        rows = slice(observations.offsets[v], observations.offsets[v + 1])
        pairs = is_next[np.ix_(observations.rows[rows], observations.rows[rows])]
        points = observations.points2D[rows]
        lengths = np.where(pairs, np.linalg.norm(points[:, None] - points[None], axis=2), np.inf)
        spacings[rows] = lengths.min(axis=1, initial=np.inf)
        is_within[rows] = pairs.sum(axis=1) >= 4
    return spacings, is_within
