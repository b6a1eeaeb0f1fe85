"""The last round: images that see too few points to be registered like the others.

Thirty points that agree with a pose are asked for while a model grows, since all that follows is built on it. When
nothing else fits any more, an image that sees half as many may still be certain. Three questions decide.

Is it chance? Points that lie side by side are wrong together, so each cell of a grid over the image counts once. Of n
cells with visible points k agree with the pose, each of which would by chance with probability α = π ε² / (w h). Among
all choices of k cells and of the m that determine the pose, of which there are 4,

    NFA = 4 (n − m) C(n, k) C(k, m) α^(k − m)

agreements as good as this one are expected of random points.

Do those agree that had no part in it? Most matches with registered images belong to no point; half of these have to
lie on the epipolar lines of the new pose.

Does it last? After adjustment with its neighbours the image must still hold as many points that two others see.

Reference:
    Moulon, Monasse & Marlet, Adaptive structure from motion with a contrario model estimation, ACCV 2012.
"""

from __future__ import annotations

import math

import numpy as np

from sfm.core.arrays import Mask
from sfm.core.errors import Rejected
from sfm.core.scene import ViewGraph
from sfm.mapping.agreement import agreement_of_unused_matches
from sfm.mapping.state import State

_GRID = 16
_SOLUTIONS, _SAMPLE = 4, 3
_MAX_LOG10_FALSE_ALARMS = -6.0
"""At 12 px in a photo of 1024 × 768, six cells of six, or eight of sixteen."""
_MIN_AGREEING_POINTS = 0.5
_MIN_UNUSED_MATCHES = 8
_MIN_AGREEING_MATCHES = 0.5
"""On thinned graphs of real photos 0.63 or more agree where the pose is right, 0.06 to 0.46 where it is 2° or more off;
from fewer than eight matches nothing is concluded."""


def log10_false_alarms(agreeing: int, visible: int, chance: float) -> float:
    """log₁₀ of the number of poses that `agreeing` of `visible` random cells would agree with, see above."""
    if agreeing <= _SAMPLE:
        return math.inf
    choices = math.comb(visible, agreeing) * math.comb(agreeing, _SAMPLE)
    poses = _SOLUTIONS * (visible - _SAMPLE)
    return math.log10(poses * choices) + (agreeing - _SAMPLE) * math.log10(chance)


def chance_doubt(state: State, image: int, max_error_px: float) -> Rejected | None:
    """Why the agreement of a newly registered image with the points that it sees may be chance; None: it is none."""
    scene = state.scene
    rows = scene.observations_of(image)
    rows = rows[state.has_point[scene.track_of[rows]]]
    size = scene.sizes[image]
    column, row = (scene.xy[rows] / size * _GRID).astype(np.int64).clip(0, _GRID - 1).T
    cells, cell_of = np.unique(row * _GRID + column, return_inverse=True)
    # A cell agrees if half of its points do.
    agreeing = int(np.sum(np.bincount(cell_of, weights=state.on[rows] - 0.5, minlength=len(cells)) >= 0))
    chance = math.pi * max_error_px**2 / float(size.prod())
    alarms = log10_false_alarms(agreeing, len(cells), min(chance, 1.0))
    if alarms <= _MAX_LOG10_FALSE_ALARMS:
        return None
    return Rejected("maybe_by_chance", f"points agree in {agreeing} of {len(cells)} parts of the image only")


def match_doubt(state: State, first: Mask, second: Mask, view_graph: ViewGraph, max_error_px: float) -> Rejected | None:
    """Whether the matches between two groups of registered images that had no part in their poses contradict them.

    Args:
        first, second: (I,) which images are in which group, e.g. a new one and all others.
    """
    agreeing, total = agreement_of_unused_matches(state, view_graph, first, second, max_error_px)
    if total < _MIN_UNUSED_MATCHES or agreeing >= _MIN_AGREEING_MATCHES * total:
        return None
    return Rejected("contradicts_matches", f"{agreeing} of {total} matches that belong to no point agree")


def loss_doubt(state: State, image: int, min_observations: int) -> Rejected | None:
    """Whether adjustment left a newly registered image too few points that two others see, or too small a share of
    those on its tracks.
    """
    scene = state.scene
    mine = scene.observations_of(image)
    by_others = np.bincount(scene.track_of[state.on], minlength=len(state.has_point))
    by_others[scene.track_of[mine[state.on[mine]]]] -= 1
    seen = mine[by_others[scene.track_of[mine]] >= 2]
    held = int(state.on[seen].sum())
    if held >= max(min_observations, _MIN_AGREEING_POINTS * len(seen)):
        return None
    return Rejected("few_points_hold", f"{held} of {len(seen)} points that two others see still fit")
