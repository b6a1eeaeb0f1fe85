"""The sampling problem of an absolute pose with an unknown focal length."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Points2D, Points3D
from sfm.core.cameras import Camera
from sfm.core.geometry.minimal._p4pf_kernels import MAX_SOLUTIONS, p4pf
from sfm.core.robust._focal_resection_kernels import FocalResection
from sfm.core.robust.focal import centered_pixels
from sfm.core.robust.ransac import CompiledProblem, Solver


def focal_resection(
    points2D: Points2D, points3D: Points3D, camera: Camera, max_error_px: float
) -> tuple[CompiledProblem, Mask]:
    """The sampling problem, by P4Pf, of the finite points whose pixels have a ray, and which these are.

    Errors are those of reprojection in px of the undistorted image over the camera's mean focal length, which is the
    unit; the focal length itself is free. For models see `state_of` and `_focal_resection_kernels`.

    Raises:
        ValueError: the camera is not perspective.
    """
    pixels, valid = centered_pixels(points2D, camera)
    usable = valid & np.isfinite(points3D).all(1)
    unit_px = camera.mean_focal_length
    data = np.ascontiguousarray(np.concatenate([pixels / unit_px, points3D], axis=1)[usable].T)
    return CompiledProblem(FocalResection(data), Solver(p4pf, 4, MAX_SOLUTIONS), max_error_px / unit_px), usable


def state_of(model: FloatArray) -> FloatArray:
    """R (9, by rows), t (3) and the logarithm of the focal length, in units of that of the camera, of a model."""
    focal = float(np.sqrt(np.linalg.norm(model[:3]) * np.linalg.norm(model[3:6])))
    state = np.append(model[:12], np.log(focal))
    state[[0, 1, 2, 3, 4, 5, 9, 10]] /= focal
    return state
