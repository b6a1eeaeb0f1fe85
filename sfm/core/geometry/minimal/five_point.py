"""The five-point solver for calibrated relative pose."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Rays
from sfm.core.geometry.minimal._five_point_kernels import MAX_SOLUTIONS, five_point
from sfm.core.geometry.minimal._samples import sample_of


def solve_five_point(rays1: Rays, rays2: Rays) -> FloatArray:
    """All essential matrices (S ≤ 10, 3, 3) of norm √2 with r2ᵀ E r1 = 0 for five pairs of rays.

    Degenerate pairs (coincident rays, say) give none or meaningless ones, never NaN.

    Raises:
        ValueError: there are not five pairs.
    Reference:
        Nistér, An efficient solution to the five-point relative pose problem, PAMI 2004.
    """
    models = np.empty((MAX_SOLUTIONS, 9))
    count = five_point(*sample_of((rays1, (5, 3)), (rays2, (5, 3))), models)
    return models[:count].reshape(-1, 3, 3)
