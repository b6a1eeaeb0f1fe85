"""Robust alignment of two point sets by a similarity or a rigid motion."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import Mask, Points3D, Vector
from sfm.core.errors import Rejected
from sfm.core.geometry.similarity import Sim3, estimate_similarity
from sfm.core.robust.ransac import RansacConfig, required_iterations
from sfm.core.robust.relative_pose import check_lengths

_CONFIG = RansacConfig(min_iterations=100, max_iterations=2000)
_REFITS = 10


def align_robust(
    points_in_a: Points3D,
    points_in_b: Points3D,
    max_error: float,
    *,
    rng: np.random.Generator,
    with_scale: bool = True,
) -> tuple[Sim3, Mask] | Rejected:
    """`b_from_a` that brings most points of a within `max_error`, in units of b, of their partners, and which ones.

    Samples of three give similarities; each new best is refitted to its inliers until these stay the same.

    Raises:
        ValueError: the sets differ in length, or `max_error` is not positive.
    """
    check_lengths(points_in_a, points_in_b)
    if not max_error > 0:
        raise ValueError(f"max_error must be positive, got {max_error}")
    usable = np.flatnonzero(np.isfinite(points_in_a).all(1) & np.isfinite(points_in_b).all(1))
    a, b = points_in_a[usable], points_in_b[usable]
    if len(a) < 3:
        return Rejected("too_few_points", f"{len(a)} of 3 needed")
    best, best_score, drawn, limit = None, len(a) * max_error**2, 0, _CONFIG.max_iterations
    while drawn < limit:
        drawn += 1
        sample = rng.choice(len(a), 3, replace=False)
        candidate = estimate_similarity(a[sample], b[sample], with_scale=with_scale)
        if not isinstance(candidate, Sim3) or _score(candidate, a, b, max_error)[0] >= best_score:
            continue
        best = _refitted(candidate, a, b, max_error, with_scale)
        best_score, mask = _score(best, a, b, max_error)
        limit = required_iterations(int(mask.sum()), len(a), 3, _CONFIG)
    if best is None:
        return Rejected("no_model", f"none of {drawn} samples gave one")
    inliers = np.zeros(len(points_in_a), dtype=np.bool_)
    inliers[usable] = _score(best, a, b, max_error)[1]
    return best, inliers


def _squared_distances(b_from_a: Sim3, a: Points3D, b: Points3D) -> Vector:
    return np.square(b_from_a @ a - b).sum(1)


def _score(b_from_a: Sim3, a: Points3D, b: Points3D, max_error: float) -> tuple[float, Mask]:
    squares = _squared_distances(b_from_a, a, b)
    return float(np.minimum(squares, max_error**2).sum()), squares <= max_error**2


def _refitted(candidate: Sim3, a: Points3D, b: Points3D, max_error: float, with_scale: bool) -> Sim3:
    score, mask = _score(candidate, a, b, max_error)
    for _ in range(_REFITS):
        refit = estimate_similarity(a[mask], b[mask], with_scale=with_scale)
        if not isinstance(refit, Sim3):
            break
        new_score, new_mask = _score(refit, a, b, max_error)
        if new_score >= score:
            break
        candidate, score, mask = refit, new_score, new_mask
    return candidate
