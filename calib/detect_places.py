"""Corners that lie where their neighbours do not want them.

Board and lens are smooth, so a corner's place follows from those around it (see `detect_neighbours`). One that is
wrong also leads the predictions of its neighbours astray, hence the worst must go first. Only those whose prediction
it had a part in change when it goes: corners that are the worst far around go together, and only what was around them
is predicted again.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

from calib.detect_neighbours import FOR_PREDICTION, foretold, local_affines
from sfm.core.arrays import Mask, Points2D

LEAST_BEND = 0.08
"""Of the distance of neighbours; at the edge of a fisheye image the best quadratic function is off by 0.06."""
LEAST_BEND_PX = 0.5
LEAST_JUDGED = 5
"""Fewer corners say nothing about each other."""
_STEPS_AROUND = 2
"""From neighbour to neighbour: what a corner that goes changes is one step away, and what that is compared with two."""


def misplaced(board_points: Points2D, points2D: Points2D, radius_m: float, max_bend: float) -> Mask:
    """The corners that stand out, and those that do once these are gone, until none does.

    Args:
        board_points: (x, y) on the board in metres; row by row the partners of `points2D`, px.
        radius_m: `Board.clear_radius_m`.
        max_bend: most deviation from where the neighbours want a corner, by the median deviation.
    """
    count = len(points2D)
    bad, stale = np.zeros(count, bool), np.ones(count, bool)
    off, spans, near = np.zeros(count), np.zeros((count, 2)), np.full((count, FOR_PREDICTION), -1)
    while (left := np.flatnonzero(~bad)).size >= LEAST_JUDGED:
        known, places = board_points[left], points2D[left]
        anew = np.flatnonzero(stale[left])
        try:
            affines = local_affines(known, places, anew)
        except ValueError:  # what is left lies on a line
            return bad
        wanted, gain, order = foretold(known[anew], known, places)
        off[left[anew]] = np.linalg.norm(wanted - places[anew], axis=1) / gain
        spans[left[anew]] = np.linalg.svd(affines, compute_uv=False)
        near[left[anew]] = -1
        near[left[anew], : order.shape[1]] = left[order]
        scale = float(np.median(spans[left])) * 2 * radius_m
        limit = max(max_bend * float(np.median(off[left])), LEAST_BEND * scale, LEAST_BEND_PX)
        worst = (off > limit) & _worst_around(np.where(bad, -1.0, off), near)
        if not worst.any():
            return bad
        bad |= worst
        stale = np.any(worst[near] & (near >= 0), axis=1)
    return bad


def _worst_around(off: Float64[np.ndarray, " N"], near: Int64[np.ndarray, "N K"]) -> Mask:
    """Corners that are off by more than all around them; of equal ones the first.

    Args:
        near: the neighbours of each, −1 where there are no more.
    """
    rank = np.empty(len(off), np.int64)
    rank[np.argsort(-off, kind="stable")] = np.arange(len(off))
    first = rank.copy()
    for _ in range(_STEPS_AROUND):
        before = np.append(first, len(first))  # what −1 points to
        seen = np.minimum(before, np.append(before[near].min(axis=1), len(first)))
        np.minimum.at(seen, near, before[:-1, None])
        first = seen[:-1]
    return first == rank
