"""Projection of many points of one camera side by side, for loops that the compiler turns into vector instructions.

A *lane* is one point. All numbers of `LANES` points lie in one array `w`, a row of LANES for each quantity, so that the
compiler sees that rows do not overlap; rows are numbered by the constants below and a client's own begin at `ROWS`.
Rows that are only known at run time are taken as slices: an index that might be negative would keep a loop from
becoming vector instructions, 15 times as slow.
Every loop over lanes has a fixed length and no branch: lanes without a projection carry harmless numbers and OK = 0.
Perspective models with the common distortion are done so; others go lane by lane through `_kernels`, which also
defines what is right.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.core.cameras._kernels import (
    MAX_PARAMS,
    _coefficients,
    _scale_and_offset,
    project_point_jacobians,
)

LANES = 64

X, Y, Z = 0, 1, 2
"""The points in the camera frame: what a client fills."""
U, V, OK = 3, 4, 5
"""Pixels, and 1 where there is one."""
BY_POINT = 6
"""Six rows: the derivatives of u by x, y, z, then those of v."""
_A, _B, _S, _G, _D, _A_DISTORTED, _B_DISTORTED = 12, 13, 14, 15, 16, 17, 18
"""Ideal point, its squared radius, the radial factor and its denominator's inverse; the point on the sensor over f."""
BY_PARAMS = 19
"""Two rows for each parameter of the model, u before v; see `fill_by_param`."""
ROWS = BY_PARAMS + 2 * MAX_PARAMS

_SIMPLE_PINHOLE, _PINHOLE, _SIMPLE_RADIAL, _RADIAL, _OPENCV, _FULL_OPENCV = 0, 1, 2, 3, 4, 6
_FULL_OPENCV_THIN_PRISM = 10001
_F, _FX, _FY, _CX, _CY, _K, _P1, _P2, _DENOMINATOR, _PRISM = 0, 1, 2, 3, 4, 5, 9, 10, 11, 14
"""What a parameter is; k1 …, those of the denominator and of the thin prism count on from their first."""


@njit(cache=True, nogil=True, error_model="numpy")
def is_perspective(model_id):
    """Whether all lanes of the model are done at once."""
    return model_id <= _OPENCV or model_id in (_FULL_OPENCV, _FULL_OPENCV_THIN_PRISM)


@njit(cache=True, nogil=True, error_model="numpy")
def project_lanes(model_id, params, squared_limit, w):
    """Fills pixels, OK and their derivatives by the point.

    `squared_limit` is that of `distortion_limit`; below zero it lets pass what a perspective model folds over.
    """
    if is_perspective(model_id):
        fx, fy, cx, cy, _ = _scale_and_offset(model_id, params)
        if model_id <= _PINHOLE:
            k1 = k2 = k3 = d1 = d2 = d3 = p1 = p2 = s1 = s2 = s3 = s4 = 0.0
        else:
            k1, k2, k3, _, d1, d2, d3, p1, p2, s1, s2, s3, s4 = _coefficients(model_id, params)
        _project_perspective(fx, fy, cx, cy, k1, k2, k3, d1, d2, d3, p1, p2, s1, s2, s3, s4, squared_limit, w)
        return
    by_point, by_params = np.empty((2, 3)), np.empty((2, MAX_PARAMS))
    u, v, ok = 0.0, 0.0, False
    for n in range(LANES):
        x, y, z = w[X * LANES + n], w[Y * LANES + n], w[Z * LANES + n]
        # Where there are fewer points than lanes, clients repeat the last.
        if n == 0 or x != w[X * LANES + n - 1] or y != w[Y * LANES + n - 1] or z != w[Z * LANES + n - 1]:
            u, v, ok = project_point_jacobians(model_id, params, x, y, z, by_point, by_params)
        w[U * LANES + n], w[V * LANES + n], w[OK * LANES + n] = (u, v, 1.0) if ok else (0.0, 0.0, 0.0)
        for r in range(2):
            for k in range(3):
                w[(BY_POINT + 3 * r + k) * LANES + n] = by_point[r, k]
            for k in range(len(params)):
                w[(BY_PARAMS + 2 * k + r) * LANES + n] = by_params[r, k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _project_perspective(fx, fy, cx, cy, k1, k2, k3, d1, d2, d3, p1, p2, s1, s2, s3, s4, squared_limit, w):
    limit, least = abs(squared_limit), (-np.inf if squared_limit < 0.0 else 0.0)
    for n in range(LANES):
        z = w[Z * LANES + n]
        ahead = z > 0.0
        q = 1.0 / (z if ahead else 1.0)
        a, b = w[X * LANES + n] * q, w[Y * LANES + n] * q
        s = a * a + b * b
        # Not `s < limit` alone: without a limit all finite points pass, NaN never does.
        inside = ahead & (s < limit)
        a, b, s = (a if inside else 0.0), (b if inside else 0.0), (s if inside else 0.0)
        denominator = 1.0 / (1.0 + s * (d1 + s * (d2 + s * d3)))
        g = (1.0 + s * (k1 + s * (k2 + s * k3))) * denominator
        slope = k1 + s * (2.0 * k2 + s * 3.0 * k3) - g * (d1 + s * (2.0 * d2 + s * 3.0 * d3))
        twice = 2.0 * slope * denominator
        cross = twice * a * b + 2.0 * (p1 * a + p2 * b)
        prism_a, prism_b = 2.0 * s1 + 4.0 * s2 * s, 2.0 * s3 + 4.0 * s4 * s
        aa = g + twice * a * a + 2.0 * p1 * b + 6.0 * p2 * a + prism_a * a
        bb = g + twice * b * b + 2.0 * p2 * a + 6.0 * p1 * b + prism_b * b
        ab, ba = cross + prism_a * b, cross + prism_b * a
        a_distorted = a * g + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a) + (s1 + s2 * s) * s
        b_distorted = b * g + 2.0 * p2 * a * b + p1 * (s + 2.0 * b * b) + (s3 + s4 * s) * s
        u, v = fx * a_distorted + cx, fy * b_distorted + cy
        ok = inside & (aa * bb - ab * ba > least) & (abs(u) + abs(v) < np.inf)
        w[U * LANES + n], w[V * LANES + n] = (u if ok else 0.0), (v if ok else 0.0)
        w[OK * LANES + n] = 1.0 if ok else 0.0
        ux, uy, vx, vy = fx * aa * q, fx * ab * q, fy * ba * q, fy * bb * q
        w[BY_POINT * LANES + n], w[(BY_POINT + 1) * LANES + n] = ux, uy
        w[(BY_POINT + 2) * LANES + n] = -(ux * a + uy * b)
        w[(BY_POINT + 3) * LANES + n], w[(BY_POINT + 4) * LANES + n] = vx, vy
        w[(BY_POINT + 5) * LANES + n] = -(vx * a + vy * b)
        w[_A * LANES + n], w[_B * LANES + n], w[_S * LANES + n] = a, b, s
        w[_G * LANES + n], w[_D * LANES + n] = g, denominator
        w[_A_DISTORTED * LANES + n], w[_B_DISTORTED * LANES + n] = a_distorted, b_distorted


@njit(cache=True, nogil=True, error_model="numpy")
def fill_by_param(model_id, params, column, w):
    """Fills the two rows BY_PARAMS + 2 column of one parameter; call after `project_lanes`."""
    if not is_perspective(model_id):
        return
    fx, fy, _, _, _ = _scale_and_offset(model_id, params)
    _fill_perspective(_kind(model_id, column), fx, fy, BY_PARAMS + 2 * column, w)


@njit(cache=True, nogil=True, error_model="numpy")
def _kind(model_id, column):
    """What the parameter in `column` of a perspective model is."""
    if model_id in (_SIMPLE_PINHOLE, _SIMPLE_RADIAL, _RADIAL):
        return (_F, _CX, _CY, _K, _K + 1)[column]
    if column >= 12:
        return _PRISM + column - 12
    return (_FX, _FY, _CX, _CY, _K, _K + 1, _P1, _P2, _K + 2, _DENOMINATOR, _DENOMINATOR + 1, _DENOMINATOR + 2)[column]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _fill_perspective(kind, fx, fy, row, w):
    by_u, by_v = w[row * LANES : (row + 1) * LANES], w[(row + 1) * LANES : (row + 2) * LANES]
    # One loop for all kinds, where what is not meant is times zero, is compiled faster than a loop for each.
    along_x, along_y = (1.0 if kind <= _FX else 0.0), (1.0 if kind <= _FY and kind != _FX else 0.0)
    one_x, one_y = (1.0 if kind == _CX else 0.0), (1.0 if kind == _CY else 0.0)
    first, second = (1.0 if kind == _P1 else 0.0), (1.0 if kind == _P2 else 0.0)
    below = _DENOMINATOR <= kind < _PRISM
    radial = 1.0 if below or _K <= kind < _P1 else 0.0
    # s1 s + s2 s² bends u, s3 s + s4 s² bends v.
    prism, upper = kind >= _PRISM, (1.0 if kind in (_PRISM + 1, _PRISM + 3) else 0.0)
    prism_u, prism_v = (1.0 if prism and kind < _PRISM + 2 else 0.0), (1.0 if kind >= _PRISM + 2 else 0.0)
    power = kind - (_DENOMINATOR if below else _K)
    for n in range(LANES):
        a, b, s = w[_A * LANES + n], w[_B * LANES + n], w[_S * LANES + n]
        product = 2.0 * a * b
        factor = s * w[_D * LANES + n] * (-w[_G * LANES + n] if below else 1.0)
        factor *= radial * (s if power > 0 else 1.0) * (s if power > 1 else 1.0)
        bulge = s * (1.0 - upper + upper * s)
        bent_u = factor * a + first * product + second * (s + 2.0 * a * a) + prism_u * bulge
        bent_v = factor * b + second * product + first * (s + 2.0 * b * b) + prism_v * bulge
        by_u[n] = along_x * w[_A_DISTORTED * LANES + n] + one_x + fx * bent_u
        by_v[n] = along_y * w[_B_DISTORTED * LANES + n] + one_y + fy * bent_v
