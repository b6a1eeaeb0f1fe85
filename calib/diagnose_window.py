"""Whether corners were shifted by the squares next to theirs, because they were refined in too large a window.

A refinement looks for the point that all edges in its window run towards. Edges of the next squares do not. At the rim
of a board, on the side that is tilted away, they pull from one side: where the window just reaches them, corners at the
rim are off by pixels, and those within are not; where it reaches farther all are; and where squares are larger than the
window none is. No lens, no bend of the board and no blur does that.

    near, middle, far   thirds of all corners by the distance of the next one, px
    rim, within         corners with fewer than four neighbours in their photo, and the others

What was left out of a calibration belongs to it: these are the outliers.

Reference:
    docs.opencv.org, camera calibration tutorial: a window of 11 px to either side, which reaches the next squares
    wherever corners are nearer than about 26 px.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np

from calib.diagnose import Finding
from calib.refine_views import Observations
from sfm.core.arrays import BoolArray, FloatArray, Value, Vector

SHARE_OF_SPACING = 0.35
"""Half-window over the smallest spacing of corners that does not reach the next ones, seen obliquely."""
_USUAL_WINDOW_PX = 11.0
"""To either side: OpenCV's tutorial and most scripts."""
_REACHED = 0.45
"""Of the spacing of corners, from where on a half-window begins to see the next ones."""
_RIM, _NEAR = 1.7, 2.5
"""Rms error of corners at the rim over those within, and of near ones at the rim over all far ones, that are told. With
good corners of eleven sets where the first is more the second is 2.3 at most; with windows that are too large they are
1.8 to 4.7 and 2.9 to 28."""
_VISIBLE_PX = 0.1
_FEWEST = 15
"""Corners of a kind that tell something."""
_NEXT = 1.2
"""Times the smallest distance on the board up to which corners are next to one another."""
_ABOVE = 1.5
"""Stated error over that of our corners of photos of the same camera, beyond which its corners were worse."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Crowding(Value):
    """Errors by how near the next corners are; NaN where there are too few corners of a kind.

    Attributes:
        smallest_px: least distance of two corners that are next to one another.
        near_px, far_px: distances below which, and beyond which, the next corner is near or far.
        rim, far: rms error of near corners at the rim, and of all far corners, px.
        rim_over_within: ratio of rms errors, near or in the middle, whichever is larger.
    """

    smallest_px: float
    near_px: float
    far_px: float
    rim: float
    far: float
    rim_over_within: float

    @property
    def is_shifted(self) -> bool:
        """Whether the next squares shift corners."""
        return bool(self.rim > max(_NEAR * self.far, _VISIBLE_PX) and self.rim_over_within > _RIM)


def crowding(observations: Observations, residuals: FloatArray) -> Crowding:
    """See the text of the module; residuals (n, 2) in px, projected − observed."""
    squares = np.sum(residuals**2, axis=1)
    seen = np.isfinite(squares)
    spacings, is_within = _neighbours(observations, np.where(seen[:, None], residuals, 0.0))
    seen &= np.isfinite(spacings)
    if not seen.any():
        return Crowding(*[math.nan] * 6)
    near_px, far_px = (float(limit) for limit in np.quantile(spacings[seen], [1 / 3, 2 / 3]))

    def rms(which: BoolArray) -> float:
        some = which & seen
        return math.sqrt(float(np.mean(squares[some]))) if np.sum(some) >= _FEWEST else math.nan

    near, far = spacings <= near_px, spacings >= far_px
    ratios = [rms(third & ~is_within) / max(rms(third & is_within), 1e-9) for third in (near, ~near & ~far)]
    return Crowding(
        smallest_px=float(spacings[seen].min()),
        near_px=near_px,
        far_px=far_px,
        rim=rms(near & ~is_within),
        far=rms(far),
        rim_over_within=max((ratio for ratio in ratios if math.isfinite(ratio)), default=math.nan),
    )


def window_finding(observations: Observations, residuals: FloatArray) -> Finding | None:
    """What speaks for a window that was too large, by the corners alone."""
    found = crowding(observations, residuals)
    if not found.is_shifted:
        return None
    return Finding(
        "window_too_large",
        f"corners at the rim of the board err by {found.rim:.2f} px where the next corner is near "
        f"({found.smallest_px:.0f} to {found.near_px:.0f} px), all by {found.far:.2f} px where it is farther than "
        f"{found.far_px:.0f} px, and the rim by {found.rim_over_within:.1f} times as much as what lies within: the "
        "window of their refinement reached the next squares",
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
    told = f"its own corners erred by {stated_px:.3f} px when it was calibrated, ours of these photos by {ours:.3f} px"
    if not is_ours and _REACHED * smallest < _USUAL_WINDOW_PX:
        return Finding(
            "window_too_large",
            f"{told}: corners are {smallest:.0f} px apart, and the usual window of {_USUAL_WINDOW_PX:.0f} px to either "
            "side reaches the next squares",
            f"calibrate anew from photos; {_remedy(smallest)}",
        )
    return Finding("worse_corners", told, "calibrate anew, from photos as good as these")


def _remedy(smallest_px: float) -> str:
    half = max(2, int(SHARE_OF_SPACING * smallest_px))
    return (
        f"refine corners in a window of no more than {half} px to either side here, "
        "or give the photos: `calib` fits the window to each"
    )


def _neighbours(observations: Observations, residuals: FloatArray) -> tuple[Vector, BoolArray]:
    """(n,) px to the nearest of the corners next to each on the board, inf without one; and whether it has four.

    Where corners should be is what counts: one that was shifted far may lie on the next.
    """
    board = observations.board[:, :2]
    apart = np.linalg.norm(board[:, None] - board[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    is_next = apart <= _NEXT * apart.min(initial=np.inf)
    spacings, is_within = np.full(len(observations.rows), np.inf), np.zeros(len(observations.rows), bool)
    for start, end in itertools.pairwise(observations.offsets.tolist()):
        pairs = is_next[np.ix_(observations.rows[start:end], observations.rows[start:end])]
        points = observations.points2D[start:end] + residuals[start:end]
        lengths = np.where(pairs, np.linalg.norm(points[:, None] - points[None], axis=2), np.inf)
        spacings[start:end] = lengths.min(axis=1, initial=np.inf)
        is_within[start:end] = pairs.sum(axis=1) >= 4
    return spacings, is_within
