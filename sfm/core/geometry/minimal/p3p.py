"""Absolute pose from three points."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import Points3D, Rays
from sfm.core.geometry.minimal._p3p_kernels import MAX_SOLUTIONS, p3p
from sfm.core.geometry.minimal._samples import sample_of
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3


def solve_p3p(rays: Rays, points3D: Points3D) -> Rigid3:
    """All poses `cam_from_world` (S ≤ 4,) under which three points lie on unit rays, at positive depths.

    Collinear points, and rays of which two coincide, have none.

    Raises:
        ValueError: there are not three of each.
    Reference:
        Ding et al., Revisiting the P3P problem, CVPR 2023.
    """
    models = np.empty((MAX_SOLUTIONS, 12))
    data, sample = sample_of((rays, (3, 3)), (np.zeros((3, 6)), (3, 6)), (points3D, (3, 3)))
    count = p3p(data, sample, models)
    return Rigid3(Rotation3.from_matrix(models[:count, :9].reshape(-1, 3, 3)), models[:count, 9:])
