"""Triangulation: the point that rays of two or more cameras see.

A camera of pose (R, t) has its centre at c = −Rᵀ t; its unit ray r points along d = Rᵀ r in the world.

Two views: with w = c₂ − c₁ and n = d₁ × d₂ the nearest points of the two lines lie at
    s₁ = n · (w × d₂) / n²,    s₂ = n · (w × d₁) / n²
along them; the point in the middle has the least sum of squared distances to the lines.

Many views: Σ ‖(I − r rᵀ)(R X + t)‖² is least where  Σ (I − d dᵀ) X = Σ (I − d dᵀ) c, three equations. That sum
favours far cameras, whose pixels are large in space. Dividing each term by the squared range turns distances into
sines of angles; the ranges come from the pass before, and three passes settle to well below the noise.

"In front" means a positive distance along the ray: for a pinhole the sign of the depth, and right for a fisheye
that sees beyond 180°, where z may be negative.

References:
    Lee & Civera, Triangulation: Why Optimize?, arXiv:1907.11917.
    Hartley & Sturm, Triangulation, CVIU 1997 (section 5.1, the midpoint and its faults).
"""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Points3D, Rays, Vector
from sfm.core.errors import Rejected
from sfm.core.geometry import _triangulation_kernels as _kernels
from sfm.core.geometry.rigid import Rigid3


def triangulate_midpoint(cam2_from_cam1: Rigid3, rays1: Rays, rays2: Rays) -> tuple[Points3D, Mask]:
    """Midpoint of the shortest segment between corresponding rays.

    Noise-free rays satisfy  range1 * ray1 = X  and  range2 * ray2 = R X + t.

    Args:
        cam2_from_cam1: a single motion, in scene units.
        rays1: unit bearings in the frame of camera 1.
        rays2: unit bearings in the frame of camera 2, row by row the partners of `rays1`.

    Returns:
        Points in the frame of camera 1 (NaN where the rays are parallel), and whether they are in front of both.

    Raises:
        ValueError: `rays1` and `rays2` differ in length, or the motion is a batch.
    """
    if len(rays1) != len(rays2):
        raise ValueError(f"{len(rays1)} rays against {len(rays2)}")
    if cam2_from_cam1.shape != ():
        raise ValueError(f"expected a single motion, got a batch {cam2_from_cam1.shape}")
    return _kernels.triangulate_pairs(
        np.eye(3),
        np.zeros(3),
        cam2_from_cam1.rotation.matrix,
        np.array(cam2_from_cam1.translation),
        np.ascontiguousarray(rays1),
        np.ascontiguousarray(rays2),
    )


def triangulate_many(cams_from_world: Rigid3, rays: Rays, *, refine: bool = True) -> Vector | Rejected:
    """The world point that k ≥ 2 cameras see along one ray each.

    Args:
        cams_from_world: a batch (k,), in scene units.
        rays: unit bearings, row by row in the frames of the cameras.
        refine: minimise angles instead of distances, as the module's head explains.

    Returns:
        The point (3,), which may lie behind cameras (`in_front` tells); `Rejected` where there are fewer than two
        rays or all agree in direction to about 1e-6 rad.

    Raises:
        ValueError: as many rays as cameras are needed.
    """
    if cams_from_world.shape != (len(rays),):
        raise ValueError(f"{len(rays)} rays of cameras {cams_from_world.shape}")
    if len(rays) < 2:
        return Rejected("too_few_rays", f"{len(rays)} of 2 needed")
    solve = _kernels.triangulate_rays_refined if refine else _kernels.triangulate_rays
    point = np.empty(3)
    found = solve(
        cams_from_world.rotation.matrix, np.array(cams_from_world.translation), np.ascontiguousarray(rays), point
    )
    return point if found else Rejected("parallel_rays", f"{len(rays)} rays fix no point")


def triangulation_angles(centers1: FloatArray, centers2: FloatArray, points3D: FloatArray) -> FloatArray:
    """Angles between the lines from two camera centres to points, all in the world; radians in [0, π/2].

    Lines that meet at π − α fix a point as badly as lines that meet at α (it lies between the cameras, where the
    distance is as uncertain as at infinity), so the angle is folded. Tiny angles keep their digits: tan is taken
    from the cross and the dot product, not cos from the latter. A point at a camera's centre has angle 0.

    Args:
        centers1: (..., 3), as `centers2`; all three arguments broadcast against each other.
    """
    a, b = points3D - centers1, points3D - centers2
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.abs((a * b).sum(-1))))


def in_front(cams_from_world: Rigid3, rays: Rays, points3D: Points3D) -> Mask:
    """Cheirality: whether world points lie at a positive distance along the rays that saw them.

    Args:
        cams_from_world: one camera for all rows, or a batch (N,) row by row.
        rays: unit bearings in the frame of the camera of their row.
    """
    return ((cams_from_world @ points3D) * rays).sum(-1) > 0
