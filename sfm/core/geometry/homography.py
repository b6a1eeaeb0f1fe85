"""Homographies x2 ~ H x1: estimation from points and decomposition into a motion and a plane.

For points on the plane nᵀ X1 = d of camera 1 and X2 = R X1 + t, H = K2 (R + t nᵀ / d) K1⁻¹. Scaled so that its middle
singular value is 1, the calibrated H has HᵀH = V diag(σ1², 1, σ3²) Vᵀ. The directions

    u± ∝ √(1 − σ3²) v1 ± √(σ1² − 1) v3

together with v2 span the two planes in which H preserves lengths; mapping the frames [v2, u±, v2 × u±] by H gives the
two candidate rotations, normals v2 × u± and translations (H − R) n. Both signs of (t, n) make four.

Reference:
    Ma, Soatto, Košecká & Sastry, An Invitation to 3-D Vision, §5.3.3. Hartley & Zisserman, 2nd ed., §4.1.
"""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Matrix3, Points2D, Vector
from sfm.core.errors import Rejected
from sfm.core.geometry.homogeneous import normalising_transform, to_homogeneous, transform_points
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3


def homography_from_pose(cam2_from_cam1: Rigid3, normal: Vector, distance: float) -> Matrix3:
    """R + t nᵀ / d, for the plane n · X = d in the frame of camera 1, between normalised coordinates."""
    return cam2_from_cam1.rotation.matrix + np.outer(cam2_from_cam1.translation, normal) / distance


def fit_homography(points2D_1: Points2D, points2D_2: Points2D) -> Matrix3 | Rejected:
    """The H of unit norm that minimises the algebraic error of at least four pairs in normalised coordinates.

    Raises:
        ValueError: the point sets differ in length.
    """
    if len(points2D_1) != len(points2D_2):
        raise ValueError(f"{len(points2D_1)} points against {len(points2D_2)}")
    if len(points2D_1) < 4:
        return Rejected("too_few_points", f"{len(points2D_1)} of 4 needed")
    t1, t2 = normalising_transform(points2D_1), normalising_transform(points2D_2)
    x1 = to_homogeneous(transform_points(t1, points2D_1))
    x2, y2 = transform_points(t2, points2D_2).T[:, :, None]
    zero = np.zeros_like(x1)
    a = np.concatenate([np.concatenate([x1, zero, -x2 * x1], 1), np.concatenate([zero, x1, -y2 * x1], 1)])
    _, s, vt = np.linalg.svd(a)
    if not s[7] > 1e-10 * s[0]:
        return Rejected("degenerate_points", "three of four points are collinear, or points coincide")
    h = np.linalg.solve(t2, vt[8].reshape(3, 3)) @ t1
    return h / np.linalg.norm(h)


def transfer_errors(homography: Matrix3, points2D_1: Points2D, points2D_2: Points2D) -> Vector:
    """|π(H x1) − x2| in px of image 2; NaN where H x1 lies at infinity."""
    return np.linalg.norm(transform_points(homography, points2D_1) - points2D_2, axis=1)


def decompose_homography(
    homography: Matrix3, calibration1: Matrix3, calibration2: Matrix3
) -> tuple[Rigid3, FloatArray]:
    """The motions (S,) `cam2_from_cam1` and plane normals (S, 3) in camera 1 that explain a homography.

    Translations are in units of the plane's distance. A rotation-only homography gives one motion, of zero
    translation, with a zero normal; others give four, of which those with n · r1 > 0 on all visible rays can be real.
    H must have the sign that maps visible points to positive w: x2ᵀ K2⁻ᵀ H x1 > 0.

    Raises:
        ValueError: the homography is singular or not finite.
    """
    h = np.linalg.solve(calibration2, homography @ calibration1)
    if not np.isfinite(h).all():
        raise ValueError("the homography is not finite")
    _, s, vt = np.linalg.svd(h)
    if not s[2] > 1e-12 * s[0]:
        raise ValueError("the homography is singular")
    h = h / s[1] * np.sign(np.linalg.det(h))
    s1, s3 = (s[0] / s[1]) ** 2, (s[2] / s[1]) ** 2
    if s1 - s3 < 1e-9:
        return Rigid3(Rotation3.from_matrix(_nearest_rotation(h)[None]), np.zeros((1, 3))), np.zeros((1, 3))
    v1, v2, v3 = vt * np.linalg.det(vt)
    rotations, translations, normals = [], [], []
    for sign in (1.0, -1.0):
        u = np.sqrt(max(1 - s3, 0)) * v1 + sign * np.sqrt(max(s1 - 1, 0)) * v3
        u /= np.linalg.norm(u)
        n = np.cross(v2, u)
        source = np.stack([v2, u, n], 1)
        image = np.stack([h @ v2, h @ u, np.cross(h @ v2, h @ u)], 1)
        r = _nearest_rotation(image @ source.T)
        t = (h - r) @ n
        rotations += [r, r]
        translations += [t, -t]
        normals += [n, -n]
    return Rigid3(Rotation3.from_matrix(np.array(rotations)), np.array(translations)), np.array(normals)


def _nearest_rotation(matrix: Matrix3) -> Matrix3:
    u, _, vt = np.linalg.svd(matrix)
    return (u * [1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
