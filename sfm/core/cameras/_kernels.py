"""Projection of points, its derivatives, and unprojection of pixels, for every model of the table.

    point in the camera frame → ideal point (a, b) → distorted (a', b') → pixel (fx a' + cx, fy b' + cy)

Only the first step is a model's own; the second, where a model has it, is one polynomial family. The `*_point`
functions are meant to be called from other kernels. `params` is the model's row and may be padded to `MAX_PARAMS`.
A failure is `ok = False` with NaN, and with Jacobians of zeros.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sfm.core.cameras._distortion_kernels import distort, radial_limit, undistort
from sfm.core.cameras._double_sphere_kernels import double_spherical, double_spherical_by_shape, ray_from_double_sphere
from sfm.core.cameras._equirectangular_kernels import longitude_latitude, ray_from_longitude_latitude
from sfm.core.cameras._eucm_kernels import ellipsoidal, ellipsoidal_by_shape, ray_from_ellipsoidal
from sfm.core.cameras._fisheye_kernels import equidistant, ray_from_equidistant

MAX_PARAMS = 16
"""Length of a parameter row that holds any model."""

_SIMPLE_PINHOLE, _PINHOLE, _SIMPLE_RADIAL, _RADIAL, _OPENCV, _OPENCV_FISHEYE, _FULL_OPENCV = range(7)
_SIMPLE_RADIAL_FISHEYE, _RADIAL_FISHEYE, _THIN_PRISM_FISHEYE = 8, 9, 10
_EUCM, _EQUIRECTANGULAR = 16, 17
_FULL_OPENCV_THIN_PRISM, _DOUBLE_SPHERE = 10001, 10002


@njit(cache=True, nogil=True, error_model="numpy")
def project_point(model_id, params, x, y, z):
    """(u, v, ok): the pixel of a point in the camera frame."""
    fx, fy, cx, cy, _ = _scale_and_offset(model_id, params)
    a, b, _, _, _, _, _, _, ok = _ideal_point(model_id, params, x, y, z)
    if ok and _is_distorted(model_id):
        a, b, _, _, _, _, ok = distort(_coefficients(model_id, params), a, b)
    u, v = fx * a + cx, fy * b + cy
    if ok and math.isfinite(u) and math.isfinite(v):
        return u, v, True
    return math.nan, math.nan, False


@njit(cache=True, nogil=True, error_model="numpy")
def project_point_jacobians(model_id, params, x, y, z, by_point, by_params):
    """(u, v, ok) as `project_point`; fills the derivatives `by_point` (2, 3) and `by_params` (2, MAX_PARAMS)."""
    fx, fy, cx, cy, extra = _scale_and_offset(model_id, params)
    a, b, ax, ay, az, bx, by, bz, ok = _ideal_point(model_id, params, x, y, z)
    u_a, u_b, v_a, v_b = fx, 0.0, 0.0, fy
    for i in range(2):
        for j in range(MAX_PARAMS):
            by_params[i, j] = 0.0
    if ok and _is_distorted(model_id):
        coefficients = _coefficients(model_id, params)
        _fill_by_coefficients(model_id, coefficients, fx, fy, a, b, extra, by_params)
        a, b, aa, ab, ba, bb, ok = distort(coefficients, a, b)
        u_a, u_b, v_a, v_b = fx * aa, fx * ab, fy * ba, fy * bb
    u, v = fx * a + cx, fy * b + cy
    if not (ok and math.isfinite(u) and math.isfinite(v)):
        for i in range(2):
            for j in range(3):
                by_point[i, j] = 0.0
            for j in range(MAX_PARAMS):
                by_params[i, j] = 0.0
        return math.nan, math.nan, False
    by_point[0, 0] = u_a * ax + u_b * bx
    by_point[0, 1] = u_a * ay + u_b * by
    by_point[0, 2] = u_a * az + u_b * bz
    by_point[1, 0] = v_a * ax + v_b * bx
    by_point[1, 1] = v_a * ay + v_b * by
    by_point[1, 2] = v_a * az + v_b * bz
    if model_id == _EQUIRECTANGULAR:
        by_params[0, 0], by_params[1, 1] = u / params[0], v / params[1]
        return u, v, True
    by_params[0, 0], by_params[1, extra - 3] = a, b
    by_params[0, extra - 2], by_params[1, extra - 1] = 1.0, 1.0
    if model_id == _EUCM:
        by_alpha, by_beta = ellipsoidal_by_shape(params[4], params[5], x, y, z)
        by_params[0, 4], by_params[0, 5] = -fx * a * by_alpha, -fx * a * by_beta
        by_params[1, 4], by_params[1, 5] = -fy * b * by_alpha, -fy * b * by_beta
    elif model_id == _DOUBLE_SPHERE:
        by_xi, by_alpha = double_spherical_by_shape(params[4], params[5], x, y, z)
        by_params[0, 4], by_params[0, 5] = -fx * a * by_xi, -fx * a * by_alpha
        by_params[1, 4], by_params[1, 5] = -fy * b * by_xi, -fy * b * by_alpha
    return u, v, True


@njit(cache=True, nogil=True, error_model="numpy")
def unproject_point(model_id, params, u, v):
    """(x, y, z, ok): the unit ray of a pixel."""
    fx, fy, cx, cy, _ = _scale_and_offset(model_id, params)
    a, b, undistorted = (u - cx) / fx, (v - cy) / fy, True
    if _is_distorted(model_id):
        a, b, undistorted = undistort(_coefficients(model_id, params), a, b)
    if _is_equidistant(model_id):
        x, y, z, ok = ray_from_equidistant(a, b)
    elif model_id == _EUCM:
        x, y, z, ok = ray_from_ellipsoidal(params[4], params[5], a, b)
    elif model_id == _DOUBLE_SPHERE:
        x, y, z, ok = ray_from_double_sphere(params[4], params[5], a, b)
    elif model_id == _EQUIRECTANGULAR:
        x, y, z, ok = ray_from_longitude_latitude(a, b)
    else:
        z = 1.0 / math.sqrt(1.0 + a * a + b * b)
        x, y, ok = a * z, b * z, z > 0.0
    if ok and undistorted:
        return x, y, z, True
    return math.nan, math.nan, math.nan, False


@njit(cache=True, nogil=True, error_model="numpy")
def distortion_limit(model_id, params):
    """√(a² + b²) up to which the distortion of the model can be inverted; inf without distortion."""
    return radial_limit(_coefficients(model_id, params)) if _is_distorted(model_id) else math.inf


@njit(cache=True, nogil=True, error_model="numpy")
def project(model_id, params, points3D):
    """Pixels (N, 2) of points (N, 3) and their validity (N,)."""
    n = len(points3D)
    points2D, valid = np.empty((n, 2)), np.empty(n, np.bool_)
    for i in range(n):
        points2D[i, 0], points2D[i, 1], valid[i] = project_point(
            model_id, params, points3D[i, 0], points3D[i, 1], points3D[i, 2]
        )
    return points2D, valid


@njit(cache=True, nogil=True, error_model="numpy")
def project_with_jacobians(model_id, params, points3D):
    """Pixels (N, 2), derivatives by the point (N, 2, 3) and the parameters (N, 2, MAX_PARAMS), validity (N,)."""
    n = len(points3D)
    points2D, valid = np.empty((n, 2)), np.empty(n, np.bool_)
    by_point, by_params = np.empty((n, 2, 3)), np.empty((n, 2, MAX_PARAMS))
    for i in range(n):
        points2D[i, 0], points2D[i, 1], valid[i] = project_point_jacobians(
            model_id, params, points3D[i, 0], points3D[i, 1], points3D[i, 2], by_point[i], by_params[i]
        )
    return points2D, by_point, by_params, valid


@njit(cache=True, nogil=True, error_model="numpy")
def unproject(model_id, params, points2D):
    """Unit rays (N, 3) of pixels (N, 2) and their validity (N,)."""
    n = len(points2D)
    rays, valid = np.empty((n, 3)), np.empty(n, np.bool_)
    for i in range(n):
        rays[i, 0], rays[i, 1], rays[i, 2], valid[i] = unproject_point(model_id, params, points2D[i, 0], points2D[i, 1])
    return rays, valid


@njit(cache=True, nogil=True, error_model="numpy")
def _is_equidistant(model_id):
    return model_id == _OPENCV_FISHEYE or _SIMPLE_RADIAL_FISHEYE <= model_id <= _THIN_PRISM_FISHEYE


@njit(cache=True, nogil=True, error_model="numpy")
def _is_distorted(model_id):
    return _SIMPLE_RADIAL <= model_id <= _THIN_PRISM_FISHEYE or model_id == _FULL_OPENCV_THIN_PRISM


@njit(cache=True, nogil=True, error_model="numpy")
def _scale_and_offset(model_id, params):
    """(fx, fy, cx, cy, position of the first parameter behind them)."""
    if model_id == _EQUIRECTANGULAR:
        return params[0] / (2.0 * math.pi), params[1] / math.pi, 0.5 * params[0], 0.5 * params[1], 0
    if (
        model_id in (_PINHOLE, _THIN_PRISM_FISHEYE, _EUCM)
        or _OPENCV <= model_id <= _FULL_OPENCV
        or model_id >= _FULL_OPENCV_THIN_PRISM
    ):
        return params[0], params[1], params[2], params[3], 4
    return params[0], params[0], params[1], params[2], 3


@njit(cache=True, nogil=True, error_model="numpy")
def _ideal_point(model_id, params, x, y, z):
    """(a, b, the derivatives of a by x, y, z, those of b, ok)."""
    if _is_equidistant(model_id):
        return equidistant(x, y, z)
    if model_id == _EUCM:
        return ellipsoidal(params[4], params[5], x, y, z)
    if model_id == _DOUBLE_SPHERE:
        return double_spherical(params[4], params[5], x, y, z)
    if model_id == _EQUIRECTANGULAR:
        return longitude_latitude(x, y, z)
    q = 1.0 / z if z > 0.0 else math.nan
    a, b = x * q, y * q
    return a, b, q, 0.0, -a * q, 0.0, q, -b * q, z > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _coefficients(model_id, params):
    """(k1, k2, k3, k4, d1, d2, d3, p1, p2, s1, s2, s3, s4) of the common distortion."""
    k1 = k2 = k3 = k4 = d1 = d2 = d3 = p1 = p2 = s1 = s2 = s3 = s4 = 0.0
    if model_id in (_SIMPLE_RADIAL, _SIMPLE_RADIAL_FISHEYE):
        k1 = params[3]
    elif model_id in (_RADIAL, _RADIAL_FISHEYE):
        k1, k2 = params[3], params[4]
    elif model_id == _OPENCV_FISHEYE:
        k1, k2, k3, k4 = params[4], params[5], params[6], params[7]
    else:
        k1, k2, p1, p2 = params[4], params[5], params[6], params[7]
        if model_id in (_FULL_OPENCV, _FULL_OPENCV_THIN_PRISM):
            k3, d1, d2, d3 = params[8], params[9], params[10], params[11]
            if model_id == _FULL_OPENCV_THIN_PRISM:
                s1, s2, s3, s4 = params[12], params[13], params[14], params[15]
        elif model_id == _THIN_PRISM_FISHEYE:
            k3, k4, s1, s3 = params[8], params[9], params[10], params[11]
    return k1, k2, k3, k4, d1, d2, d3, p1, p2, s1, s2, s3, s4


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_by_coefficients(model_id, coefficients, fx, fy, a, b, extra, by_params):
    """Derivatives by the distortion parameters, in the model's order."""
    k1, k2, k3, _, d1, d2, d3, _, _, _, _, _, _ = coefficients
    s = a * a + b * b
    inverse = 1.0 / (1.0 + s * (d1 + s * (d2 + s * d3)))
    u, v = fx * a * s * inverse, fy * b * s * inverse
    is_simple = model_id in (_SIMPLE_RADIAL, _SIMPLE_RADIAL_FISHEYE)
    leading = 1 if is_simple else (4 if model_id == _OPENCV_FISHEYE else 2)
    for i in range(leading):
        by_params[0, extra + i], by_params[1, extra + i] = u, v
        u, v = u * s, v * s
    if model_id not in (_OPENCV, _FULL_OPENCV, _THIN_PRISM_FISHEYE, _FULL_OPENCV_THIN_PRISM):
        return
    by_params[0, 6], by_params[1, 6] = fx * 2.0 * a * b, fy * (s + 2.0 * b * b)
    by_params[0, 7], by_params[1, 7] = fx * (s + 2.0 * a * a), fy * 2.0 * a * b
    if model_id == _OPENCV:
        return
    by_params[0, 8], by_params[1, 8] = u, v
    if model_id == _THIN_PRISM_FISHEYE:
        by_params[0, 9], by_params[1, 9] = u * s, v * s
        by_params[0, 10], by_params[1, 11] = fx * s, fy * s
        return
    g = (1.0 + s * (k1 + s * (k2 + s * k3))) * inverse
    for i in range(3):
        by_params[0, 9 + i], by_params[1, 9 + i] = -g * by_params[0, 4], -g * by_params[1, 4]
        g *= s
    if model_id == _FULL_OPENCV_THIN_PRISM:
        by_params[0, 12], by_params[0, 13] = fx * s, fx * s * s
        by_params[1, 14], by_params[1, 15] = fy * s, fy * s * s
