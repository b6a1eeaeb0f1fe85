"""Projection kernels; `params` may be a row padded to `MAX_PARAMS`."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

MAX_PARAMS = 12


@nb.njit(cache=True, nogil=True)
def project_point(model_id, params, x, y, z):
    """(u, v, ok) of a point in the camera frame."""
    if not z > 0.0:
        return math.nan, math.nan, False
    a, b = x / z, y / z
    if model_id == 1:
        return params[0] * a + params[2], params[1] * b + params[3], True
    k = params[3] if model_id == 2 else 0.0
    r2 = a * a + b * b
    if not 1.0 + 3.0 * k * r2 > 0.0:
        return math.nan, math.nan, False
    d = 1.0 + k * r2
    return params[0] * d * a + params[1], params[0] * d * b + params[2], True


@nb.njit(cache=True, nogil=True)
def project_point_jacobians(model_id, params, x, y, z, by_point, by_params):
    """(u, v, ok); fills `by_point` (2, 3) and `by_params` (2, 12)."""
    by_params[:] = 0.0
    u, v, ok = project_point(model_id, params, x, y, z)
    if not ok:
        by_point[:] = 0.0
        return u, v, ok
    a, b = x / z, y / z
    if model_id == 1:
        fx, fy, k = params[0], params[1], 0.0
        by_params[0, 0] = a
        by_params[1, 1] = b
        by_params[0, 2] = 1.0
        by_params[1, 3] = 1.0
    else:
        fx = fy = params[0]
        k = params[3] if model_id == 2 else 0.0
        r2 = a * a + b * b
        by_params[0, 0] = a * (1.0 + k * r2)
        by_params[1, 0] = b * (1.0 + k * r2)
        by_params[0, 1] = 1.0
        by_params[1, 2] = 1.0
        if model_id == 2:
            by_params[0, 3] = fx * r2 * a
            by_params[1, 3] = fx * r2 * b
    d = 1.0 + k * (a * a + b * b)
    ua, ub = fx * (d + 2.0 * k * a * a), fx * 2.0 * k * a * b
    va, vb = fy * 2.0 * k * a * b, fy * (d + 2.0 * k * b * b)
    by_point[0, 0] = ua / z
    by_point[0, 1] = ub / z
    by_point[0, 2] = -(ua * a + ub * b) / z
    by_point[1, 0] = va / z
    by_point[1, 1] = vb / z
    by_point[1, 2] = -(va * a + vb * b) / z
    return u, v, ok


@nb.njit(cache=True, nogil=True)
def unproject_point(model_id, params, u, v):
    """(x, y, z, ok): the unit ray of a pixel."""
    if model_id == 1:
        a, b, k = (u - params[2]) / params[0], (v - params[3]) / params[1], 0.0
    else:
        a, b = (u - params[1]) / params[0], (v - params[2]) / params[0]
        k = params[3] if model_id == 2 else 0.0
    target = math.hypot(a, b)
    r = target
    for _ in range(50):
        step = (r + k * r * r * r - target) / (1.0 + 3.0 * k * r * r)
        r -= step
        if abs(step) <= 1e-15 * (1.0 + r):
            break
    ok = abs(r + k * r**3 - target) < 1e-10 * (1.0 + target) and 1.0 + 3.0 * k * r * r > 0.0
    if not ok:
        return math.nan, math.nan, math.nan, False
    s = r / target if target > 0.0 else 1.0
    n = 1.0 / math.sqrt(1.0 + r * r)
    return a * s * n, b * s * n, n, True


@nb.njit(cache=True, nogil=True)
def project(model_id, params, points3D):
    """Pixels (N, 2) and validity (N,)."""
    n = len(points3D)
    points2D, valid = np.empty((n, 2)), np.empty(n, np.bool_)
    for i in range(n):
        points2D[i, 0], points2D[i, 1], valid[i] = project_point(
            model_id, params, points3D[i, 0], points3D[i, 1], points3D[i, 2]
        )
    return points2D, valid


@nb.njit(cache=True, nogil=True)
def project_with_jacobians(model_id, params, points3D):
    """Pixels (N, 2), derivatives (N, 2, 3) and (N, 2, 12), validity (N,)."""
    n = len(points3D)
    points2D, valid = np.empty((n, 2)), np.empty(n, np.bool_)
    by_point, by_params = np.empty((n, 2, 3)), np.empty((n, 2, MAX_PARAMS))
    for i in range(n):
        points2D[i, 0], points2D[i, 1], valid[i] = project_point_jacobians(
            model_id, params, points3D[i, 0], points3D[i, 1], points3D[i, 2], by_point[i], by_params[i]
        )
    return points2D, by_point, by_params, valid


@nb.njit(cache=True, nogil=True)
def unproject(model_id, params, points2D):
    """Unit rays (N, 3) and validity (N,)."""
    n = len(points2D)
    rays, valid = np.empty((n, 3)), np.empty(n, np.bool_)
    for i in range(n):
        rays[i, 0], rays[i, 1], rays[i, 2], valid[i] = unproject_point(
            model_id, params, points2D[i, 0], points2D[i, 1]
        )
    return rays, valid
