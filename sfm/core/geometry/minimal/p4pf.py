"""Absolute pose and focal length from four points."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import Points2D, Points3D, Vector
from sfm.core.geometry.minimal._p4pf_kernels import MAX_SOLUTIONS, p4pf
from sfm.core.geometry.minimal._samples import sample_of
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3


def solve_p4pf(points2D: Points2D, points3D: Points3D) -> tuple[Rigid3, Vector]:
    """All poses `cam_from_world` (S ≤ 8,) and focal lengths (S,) under which four points are seen at these pixels.

    Four points give eight equations for seven unknowns: with noise the solutions lie between them. The points may lie
    on one plane, but a plane that is seen frontally leaves the focal length undetermined, and three points on one line
    have no solution.

    Args:
        points2D: (4, 2) from the principal point, in any unit, which is that of the focal length; square pixels.
    Raises:
        ValueError: there are not four of each.
    Reference:
        Larsson, Kukelova & Zheng, Making minimal solvers for absolute pose estimation compact and robust, ICCV 2017.
    """
    data, sample = sample_of((points2D, (4, 2)), (points3D, (4, 3)))
    spread = float(np.abs(data[:2]).mean())
    scale = 1 / spread if 0 < spread < np.inf else 1.0
    data[:2] *= scale
    models = np.empty((MAX_SOLUTIONS, 12))
    models = models[: p4pf(data, sample, models)]
    focals = np.linalg.norm(models[:, :3], axis=1)
    models[:, [0, 1, 2, 3, 4, 5, 9, 10]] /= focals[:, None]
    return Rigid3(Rotation3.from_matrix(models[:, :9].reshape(-1, 3, 3)), models[:, 9:]), focals / scale
