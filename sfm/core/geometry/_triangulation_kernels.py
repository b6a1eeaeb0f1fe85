"""Kernels of triangulation; `triangulation.py` has the mathematics, these are also called by other kernels.

A pose is `cam_from_world` as R (3, 3) and t (3,), a ray is a unit vector in the frame of its camera.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# The cross product of parallel unit rays is their rounding, about 1e-16.
_PARALLEL_SINE = 1e-12
# A pivot of the normal equations is Σ sin² of the angles between the rays, known to about 1e-16.
_SINGULAR_PIVOT = 1e-13
_REWEIGHTING_PASSES = 3


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate_two_rays(R1, t1, ray1, R2, t2, ray2, out):
    """The world point in the middle of the shortest segment between two rays; False (and NaN) where parallel."""
    ax, ay, az = _to_world(R1, ray1)
    bx, by, bz = _to_world(R2, ray2)
    cx, cy, cz = _to_world(R1, t1)  # the centre of camera 1, negated
    ex, ey, ez = _to_world(R2, t2)
    wx, wy, wz = cx - ex, cy - ey, cz - ez
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    squared_sine = nx * nx + ny * ny + nz * nz
    if not squared_sine > _PARALLEL_SINE * _PARALLEL_SINE:
        out[0] = out[1] = out[2] = np.nan
        return False
    along1 = nx * (wy * bz - wz * by) + ny * (wz * bx - wx * bz) + nz * (wx * by - wy * bx)
    along2 = nx * (wy * az - wz * ay) + ny * (wz * ax - wx * az) + nz * (wx * ay - wy * ax)
    along1 /= squared_sine
    along2 /= squared_sine
    out[0] = 0.5 * (along1 * ax + along2 * bx - cx - ex)
    out[1] = 0.5 * (along1 * ay + along2 * by - cy - ey)
    out[2] = 0.5 * (along1 * az + along2 * bz - cz - ez)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate_rays(Rs, ts, rays, out):
    """The world point with the least Σ of squared distances to k ≥ 2 rays; False (and NaN) where undetermined."""
    return _solve(Rs, ts, rays, False, out)


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate_rays_refined(Rs, ts, rays, out):
    """As `triangulate_rays`, each squared distance divided by the squared range: near the least Σ sin² of angles."""
    found = True
    for k in range(1 + _REWEIGHTING_PASSES):
        found = found and _solve(Rs, ts, rays, k > 0, out)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def triangulation_angle(center1, center2, point):
    """Angle between the lines from two centres to a point, radians in [0, π/2], accurate for tiny angles too."""
    ax, ay, az = point[0] - center1[0], point[1] - center1[1], point[2] - center1[2]
    bx, by, bz = point[0] - center2[0], point[1] - center2[1], point[2] - center2[2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return np.arctan2(np.sqrt(nx * nx + ny * ny + nz * nz), abs(ax * bx + ay * by + az * bz))


@njit(cache=True, nogil=True, error_model="numpy")
def depth_in(R, t, point):
    """z of a world point in the camera frame."""
    return R[2, 0] * point[0] + R[2, 1] * point[1] + R[2, 2] * point[2] + t[2]


@njit(cache=True, nogil=True, error_model="numpy")
def range_along(R, t, ray, point):
    """How far along its ray a world point lies; positive is in front, for fields of view beyond 180° too."""
    total = 0.0
    for i in range(3):
        total += ray[i] * (R[i, 0] * point[0] + R[i, 1] * point[1] + R[i, 2] * point[2] + t[i])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate_pairs(R1, t1, R2, t2, rays1, rays2):
    """World points (N, 3) of two cameras' rays, and whether each lies in front of both."""
    points = np.empty((len(rays1), 3))
    in_front = np.empty(len(rays1), np.bool_)
    for i in range(len(rays1)):
        found = triangulate_two_rays(R1, t1, rays1[i], R2, t2, rays2[i], points[i])
        in_front[i] = (
            found and range_along(R1, t1, rays1[i], points[i]) > 0 and range_along(R2, t2, rays2[i], points[i]) > 0
        )
    return points, in_front


@njit(cache=True, nogil=True, error_model="numpy")
def _to_world(R, v):
    """Rᵀ v."""
    return (
        R[0, 0] * v[0] + R[1, 0] * v[1] + R[2, 0] * v[2],
        R[0, 1] * v[0] + R[1, 1] * v[1] + R[2, 1] * v[2],
        R[0, 2] * v[0] + R[1, 2] * v[1] + R[2, 2] * v[2],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(Rs, ts, rays, weigh, out):
    """Normal equations Σ w (I − d dᵀ)(X − c) = 0 by LDLᵀ; with `weigh`, w is the inverse squared range of `out`."""
    # Relative to the first centre, so that a scene far from the origin loses no digits.
    ox, oy, oz = _to_world(Rs[0], ts[0])
    xx = xy = xz = yy = yz = zz = bx = by = bz = 0.0
    for k in range(len(rays)):
        dx, dy, dz = _to_world(Rs[k], rays[k])
        cx, cy, cz = _to_world(Rs[k], ts[k])
        w = 1.0
        if weigh:
            squared_range = (out[0] + cx) ** 2 + (out[1] + cy) ** 2 + (out[2] + cz) ** 2
            if not squared_range > 0:
                continue
            w = 1 / squared_range
        cx, cy, cz = ox - cx, oy - cy, oz - cz
        along = dx * cx + dy * cy + dz * cz
        xx += w * (1 - dx * dx)
        yy += w * (1 - dy * dy)
        zz += w * (1 - dz * dz)
        xy -= w * dx * dy
        xz -= w * dx * dz
        yz -= w * dy * dz
        bx += w * (cx - along * dx)
        by += w * (cy - along * dy)
        bz += w * (cz - along * dz)
    least = _SINGULAR_PIVOT * (xx + yy + zz)
    out[0] = out[1] = out[2] = np.nan
    if not xx > least:
        return False
    xy_, xz_ = xy / xx, xz / xx
    pivot2 = yy - xy_ * xy
    if not pivot2 > least:
        return False
    yz_ = (yz - xy_ * xz) / pivot2
    pivot3 = zz - xz_ * xz - yz_ * yz_ * pivot2
    if not pivot3 > least:
        return False
    by -= xy_ * bx
    bz -= xz_ * bx + yz_ * by
    z = bz / pivot3
    y = by / pivot2 - yz_ * z
    out[0] = bx / xx - xy_ * y - xz_ * z - ox
    out[1] = y - oy
    out[2] = z - oz
    return True
