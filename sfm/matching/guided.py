"""Matches that a known geometry of two images allows: along epipolar lines, or at the place of a homography.

A repeated thing has many look-alikes in the other image, so that the ratio test rejects it; few of them lie on its
epipolar line. What is found agrees with the geometry by construction: it says nothing about whether that is right, and
global mapping has been seen to suffer from it, hence it is an option.
"""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Points2D
from sfm.core.cameras import Camera
from sfm.core.cameras.undistortion import pinhole_pixels
from sfm.core.geometry.epipolar import ray_jacobians
from sfm.core.geometry.homogeneous import to_homogeneous
from sfm.core.scene import DescriptorKind, Features, Matches, TwoViewGeometry
from sfm.matching import _guided_kernels as kernels
from sfm.matching.nearest import MatchingConfig, accepted_matches, check_descriptors

_FAR = 2**40


def match_guided(
    features1: Features,
    features2: Features,
    geometry: TwoViewGeometry,
    camera1: Camera,
    camera2: Camera,
    config: MatchingConfig = MatchingConfig(),
) -> Matches:
    """Matches of two images within `config.guided_error_px` of their geometry, sorted by the index in image 1.

    Ratio and distance are judged among the features that agree with the geometry: E where it has one, for any camera
    (Sampson's distance by the derivatives of the rays), else H, else F in px of the images without distortion.

    Raises:
        ValueError: the geometry has no matrix, or the descriptors differ in kind or length.
    """
    check_descriptors(features1, features2)
    found1, found2 = _nothing_found(len(features1)), _nothing_found(len(features2))
    tables = features1.descriptors, features2.descriptors
    bits, square = features1.kind == DescriptorKind.BINARY, config.guided_error_px**2
    if geometry.E is not None:
        (x1, J1), (x2, J2) = (_rays(f.points2D, c) for f, c in ((features1, camera1), (features2, camera2)))
        kernels.scan_epipolar(*tables, x1, x2, J1, J2, np.array(geometry.E), square, bits, found1, found2)
    elif geometry.H is not None:
        x1, x2 = (_pixels(f.points2D, c)[0] for f, c in ((features1, camera1), (features2, camera2)))
        kernels.scan_homography(*tables, x1, x2, np.array(geometry.H), square, bits, found1, found2)
    elif geometry.F is not None:
        (x1, J1), (x2, J2) = (_pixels(f.points2D, c) for f, c in ((features1, camera1), (features2, camera2)))
        kernels.scan_epipolar(*tables, x1, x2, J1, J2, np.array(geometry.F), square, bits, found1, found2)
    else:
        raise ValueError(f"a {geometry.kind.name} geometry without a matrix guides nothing")
    return accepted_matches((*found1.T, *found2.T), features1.kind, features1.descriptors.shape[1], config)


def _rays(points2D: Points2D, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Unit rays and their derivatives by the pixel; NaN, which agrees with nothing, where a camera sees nothing."""
    rays, valid = camera.unproject(points2D)
    _, by_point, _, _ = camera.project_with_jacobians(rays)
    rays = np.where(valid[:, None], rays, np.nan)
    return np.ascontiguousarray(rays), np.ascontiguousarray(ray_jacobians(by_point))


def _pixels(points2D: Points2D, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Homogeneous pixels of the camera without its distortion, where F and H live, and their derivatives."""
    if camera.model_info.extra_indices:
        points2D = pinhole_pixels(*camera.unproject(points2D), camera)
    derivatives = np.zeros((len(points2D), 3, 2))
    derivatives[:, 0, 0] = derivatives[:, 1, 1] = 1
    return np.ascontiguousarray(to_homogeneous(points2D)), derivatives


def _nothing_found(count: int) -> np.ndarray:
    found = np.full((count, 3), _FAR, np.int64)
    found[:, 2] = -1
    return found
