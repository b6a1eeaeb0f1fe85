"""The algebra of two views: essential and fundamental matrices.

With X2 = R X1 + t the rays of a point satisfy r2ᵀ E r1 = 0, E = [t]× R, and its pixels x2ᵀ F x1 = 0,
F = K2⁻ᵀ E K1⁻¹. E has the singular values (s, s, 0); E and −E, and any other multiple, mean the same. Four poses have
the same E up to sign and the length of t: (R, ±t) and (R', ±t), R' = R turned by π about t. In only one of them do
the points lie in front of both cameras.

Reference:
    Hartley & Zisserman, Multiple View Geometry, 2nd ed., ch. 9. Horn, Recovering baseline and orientation from
    essential matrix, 1990, for the decomposition without an SVD.
"""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Matrix3, Points2D, Rays, Vector
from sfm.core.geometry._epipolar_kernels import essential_to_pose, front_counts
from sfm.core.geometry.homogeneous import normalise_lines, to_homogeneous
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew


def essential_from_pose(cam2_from_cam1: Rigid3) -> FloatArray:
    """E = [t]× R (..., 3, 3) of a pose or a batch."""
    return skew(cam2_from_cam1.translation) @ cam2_from_cam1.rotation.matrix


def fundamental_from_essential(essential: Matrix3, calibration1: Matrix3, calibration2: Matrix3) -> Matrix3:
    """F = K2⁻ᵀ E K1⁻¹."""
    return np.linalg.inv(calibration2).T @ essential @ np.linalg.inv(calibration1)


def essential_from_fundamental(fundamental: Matrix3, calibration1: Matrix3, calibration2: Matrix3) -> Matrix3:
    """The nearest E to K2ᵀ F K1: its two non-zero singular values are replaced by 1."""
    u, _, vt = np.linalg.svd(calibration2.T @ fundamental @ calibration1)
    return (u * [1.0, 1.0, 0.0]) @ vt


def decompose_essential(essential: Matrix3) -> Rigid3:
    """The four `cam2_from_cam1` (4,) with unit translation, ordered (R, t), (R, −t), (R', t), (R', −t).

    A matrix that is not exactly essential is taken as its nearest one.

    Raises:
        ValueError: the matrix has a rank below two or is not finite.
    """
    matrix = np.ascontiguousarray(essential, dtype=np.float64)
    rotations, t = np.empty((2, 9)), np.empty(3)
    if not essential_to_pose(matrix.ravel(), rotations, t):
        raise ValueError("not an essential matrix: its rank is below two, or it is not finite")
    rotation = Rotation3.from_matrix(rotations.reshape(2, 3, 3)[[0, 0, 1, 1]])
    return Rigid3(rotation, np.array([t, -t, t, -t]))


def pose_from_essential(essential: Matrix3, rays1: Rays, rays2: Rays) -> tuple[Rigid3, Mask]:
    """The decomposition under which most rays meet in front of both cameras, and which of the rays do so.

    Args:
        rays1, rays2: unit rays of the inliers, row by row.
    Raises:
        ValueError: as `decompose_essential`.
    """
    poses = decompose_essential(essential)
    front = front_counts(poses.rotation.matrix, poses.translation, rays1, rays2)
    best = int(np.argmax(front.sum(1)))
    return poses[best], front[best]


def epipolar_lines(fundamental: Matrix3, points2D_1: Points2D) -> FloatArray:
    """Lines (N, 3) of unit normal in image 2 on which the partners of points of image 1 lie.

    Use the transposed matrix for lines in image 1.
    """
    return normalise_lines(to_homogeneous(points2D_1) @ fundamental.T)


def epipoles(fundamental: Matrix3) -> tuple[Vector, Vector]:
    """Unit homogeneous (3,) image of centre 2 in image 1, and of centre 1 in image 2: the null vectors of F and Fᵀ."""
    u, _, vt = np.linalg.svd(fundamental)
    return vt[2], u[:, 2]


def squared_sampson_errors(fundamental: Matrix3, points2D_1: Points2D, points2D_2: Points2D) -> Vector:
    """(x2ᵀ F x1)² / (|F x1|₁₂² + |Fᵀ x2|₁₂²), in px²: first-order squared distance to the nearest exact pair.

    Reference:
        Luong & Faugeras, The fundamental matrix, IJCV 1996.
    """
    x1, x2 = to_homogeneous(points2D_1), to_homogeneous(points2D_2)
    lines2, lines1 = x1 @ fundamental.T, x2 @ fundamental
    algebraic = np.einsum("ni,ni->n", x2, lines2)
    return algebraic**2 / (np.square(lines2[:, :2]).sum(1) + np.square(lines1[:, :2]).sum(1))


def squared_tangent_sampson_errors(
    essential: Matrix3, rays1: Rays, rays2: Rays, jacobians1: FloatArray, jacobians2: FloatArray
) -> Vector:
    """(r2ᵀ E r1)² / (|J1ᵀ Eᵀ r2|² + |J2ᵀ E r1|²), in px², for any camera model.

    Args:
        jacobians1, jacobians2: (N, 3, 2) derivatives of the unit rays by the pixel, see `ray_jacobians`.
    Reference:
        Terekhov & Larsson, Tangent Sampson error, CVPR 2023.
    """
    lines2, lines1 = rays1 @ essential.T, rays2 @ essential
    algebraic = np.einsum("ni,ni->n", rays2, lines2)
    gradient1 = np.einsum("nij,ni->nj", jacobians1, lines1)
    gradient2 = np.einsum("nij,ni->nj", jacobians2, lines2)
    return algebraic**2 / (np.square(gradient1).sum(1) + np.square(gradient2).sum(1))


def ray_jacobians(pixels_by_point: FloatArray) -> FloatArray:
    """Derivatives (N, 3, 2) of unit rays by their pixel, from those (N, 2, 3) of pixels by a point on the unit ray.

    A projection B does not change along the ray, so its inverse on the tangent plane is Bᵀ (B Bᵀ)⁻¹.
    """
    b = pixels_by_point
    uu, vv = np.square(b[:, 0]).sum(1), np.square(b[:, 1]).sum(1)
    uv = np.einsum("ni,ni->n", b[:, 0], b[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (uu * vv - uv * uv)
        first = (vv * inverse)[:, None] * b[:, 0] - (uv * inverse)[:, None] * b[:, 1]
        second = (uu * inverse)[:, None] * b[:, 1] - (uv * inverse)[:, None] * b[:, 0]
    return np.stack([first, second], -1)
