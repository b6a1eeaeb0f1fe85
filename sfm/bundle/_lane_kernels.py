"""What one image contributes to the normal equations, many observations side by side.

The rows of the workspace continue those of `sfm.core.cameras._lane_kernels`, which see for how lanes work. Lanes beyond
the end of an image repeat its last observation with precision zero, and so contribute nothing.
"""

from __future__ import annotations

import math

import numba as nb

from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.cameras._lane_kernels import BY_POINT, LANES, OK, U, V, X, Y, Z
from sfm.core.cameras._lane_kernels import ROWS as _CAMERA_ROWS
from sfm.core.optim._loss_kernels import TRIVIAL, loss_and_weight

_WORLD = _CAMERA_ROWS
_OBSERVED = _WORLD + 3
_PRECISION = _OBSERVED + 2
ERROR = _PRECISION + 1
"""Two rows: residuals over their standard deviations; times the root of the robust weight after `weigh`."""
COST = ERROR + 2
"""ρ of each observation."""
_ROOT = COST + 1
BY_POINT_IN_WORLD = _ROOT + 1
"""P: the six derivatives of the weighted residual by the point in the world."""
OUT = BY_POINT_IN_WORLD + 6
"""What goes to points: the six of PᵀP, the three of Pᵀe, then three for each free column of what images share."""
_MAX_COLUMNS = MAX_PARAMS + 6
BY_TURN = OUT + 9 + 3 * _MAX_COLUMNS
"""Six rows: the derivatives by ω of the frame, three of u, then three of v. Those by υ are P."""
BY_COLUMN = BY_TURN + 6
"""Two rows for each free column."""
BY_SENSOR = BY_COLUMN + 2 * _MAX_COLUMNS
"""Two rows for one column of a sensor's tangent."""
ROWS = BY_SENSOR + 2


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def fetch(first, last, point, observed, precision, points3D, R, t, w):
    """Fills the lanes with the observations `first:last` of an image, and with their points in the camera frame."""
    for n in range(LANES):
        o = min(first + n, last - 1)
        p = point[o]
        w[_WORLD * LANES + n] = points3D[p, 0]
        w[(_WORLD + 1) * LANES + n] = points3D[p, 1]
        w[(_WORLD + 2) * LANES + n] = points3D[p, 2]
        w[_OBSERVED * LANES + n], w[(_OBSERVED + 1) * LANES + n] = observed[o, 0], observed[o, 1]
        w[_PRECISION * LANES + n] = precision[o] if first + n < last else 0.0
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22, t0, t1, t2 = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
    for n in range(LANES):
        x, y, z = w[_WORLD * LANES + n], w[(_WORLD + 1) * LANES + n], w[(_WORLD + 2) * LANES + n]
        w[X * LANES + n] = r00 * x + r01 * y + r02 * z + t0
        w[Y * LANES + n] = r10 * x + r11 * y + r12 * z + t1
        w[Z * LANES + n] = r20 * x + r21 * y + r22 * z + t2


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def weigh(loss, scale, lost_cost, w):
    """Residuals, their cost and the root of weight and precision; what has no projection costs `lost_cost`."""
    for n in range(LANES):
        precision = w[_PRECISION * LANES + n]
        seen = w[OK * LANES + n] * precision
        du = w[U * LANES + n] - w[_OBSERVED * LANES + n]
        dv = w[V * LANES + n] - w[(_OBSERVED + 1) * LANES + n]
        eu, ev = (du * seen if seen > 0.0 else 0.0), (dv * seen if seen > 0.0 else 0.0)
        w[ERROR * LANES + n], w[(ERROR + 1) * LANES + n] = eu, ev
        w[COST * LANES + n] = eu * eu + ev * ev
        w[_ROOT * LANES + n] = seen
    if loss != TRIVIAL:
        for n in range(LANES):
            rho, weight = loss_and_weight(loss, scale, w[COST * LANES + n])
            weight = math.sqrt(weight)
            w[COST * LANES + n] = rho
            w[ERROR * LANES + n] *= weight
            w[(ERROR + 1) * LANES + n] *= weight
            w[_ROOT * LANES + n] *= weight
    for n in range(LANES):
        lost = (w[OK * LANES + n] == 0.0) & (w[_PRECISION * LANES + n] > 0.0)
        w[COST * LANES + n] = 2.0 * lost_cost if lost else w[COST * LANES + n]


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def derive_by_point(R, w):
    """P = A R, PᵀP and Pᵀe."""
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    for n in range(LANES):
        root, eu, ev = w[_ROOT * LANES + n], w[ERROR * LANES + n], w[(ERROR + 1) * LANES + n]
        seen = root > 0.0
        a0 = w[BY_POINT * LANES + n] * root if seen else 0.0
        a1 = w[(BY_POINT + 1) * LANES + n] * root if seen else 0.0
        a2 = w[(BY_POINT + 2) * LANES + n] * root if seen else 0.0
        b0 = w[(BY_POINT + 3) * LANES + n] * root if seen else 0.0
        b1 = w[(BY_POINT + 4) * LANES + n] * root if seen else 0.0
        b2 = w[(BY_POINT + 5) * LANES + n] * root if seen else 0.0
        p0, q0 = a0 * r00 + a1 * r10 + a2 * r20, b0 * r00 + b1 * r10 + b2 * r20
        p1, q1 = a0 * r01 + a1 * r11 + a2 * r21, b0 * r01 + b1 * r11 + b2 * r21
        p2, q2 = a0 * r02 + a1 * r12 + a2 * r22, b0 * r02 + b1 * r12 + b2 * r22
        w[BY_POINT_IN_WORLD * LANES + n] = p0
        w[(BY_POINT_IN_WORLD + 1) * LANES + n] = p1
        w[(BY_POINT_IN_WORLD + 2) * LANES + n] = p2
        w[(BY_POINT_IN_WORLD + 3) * LANES + n] = q0
        w[(BY_POINT_IN_WORLD + 4) * LANES + n] = q1
        w[(BY_POINT_IN_WORLD + 5) * LANES + n] = q2
        w[OUT * LANES + n], w[(OUT + 1) * LANES + n] = p0 * p0 + q0 * q0, p0 * p1 + q0 * q1
        w[(OUT + 2) * LANES + n], w[(OUT + 3) * LANES + n] = p0 * p2 + q0 * q2, p1 * p1 + q1 * q1
        w[(OUT + 4) * LANES + n], w[(OUT + 5) * LANES + n] = p1 * p2 + q1 * q2, p2 * p2 + q2 * q2
        w[(OUT + 6) * LANES + n] = p0 * eu + q0 * ev
        w[(OUT + 7) * LANES + n] = p1 * eu + q1 * ev
        w[(OUT + 8) * LANES + n] = p2 * eu + q2 * ev


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def derive_by_turn(center, w):
    """P [−[u]×], u from the centre of the frame to the point."""
    c0, c1, c2 = center[0], center[1], center[2]
    for n in range(LANES):
        seen = w[_ROOT * LANES + n] > 0.0
        u0 = w[_WORLD * LANES + n] - c0 if seen else 0.0
        u1 = w[(_WORLD + 1) * LANES + n] - c1 if seen else 0.0
        u2 = w[(_WORLD + 2) * LANES + n] - c2 if seen else 0.0
        p0, p1 = w[BY_POINT_IN_WORLD * LANES + n], w[(BY_POINT_IN_WORLD + 1) * LANES + n]
        p2, q0 = w[(BY_POINT_IN_WORLD + 2) * LANES + n], w[(BY_POINT_IN_WORLD + 3) * LANES + n]
        q1, q2 = w[(BY_POINT_IN_WORLD + 4) * LANES + n], w[(BY_POINT_IN_WORLD + 5) * LANES + n]
        w[BY_TURN * LANES + n], w[(BY_TURN + 1) * LANES + n] = p2 * u1 - p1 * u2, p0 * u2 - p2 * u0
        w[(BY_TURN + 2) * LANES + n], w[(BY_TURN + 3) * LANES + n] = p1 * u0 - p0 * u1, q2 * u1 - q1 * u2
        w[(BY_TURN + 4) * LANES + n], w[(BY_TURN + 5) * LANES + n] = q0 * u2 - q2 * u0, q1 * u0 - q0 * u1


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def derive_by_sensor(place, w):
    """Column `place` of A [−[x]×, I], the tangent of the sensor on its rig."""
    axis = place % 3
    # a · (ω × x) = ω · (x × a)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    x, y = _row(X + i, w), _row(X + j, w)
    for side in range(2):
        to, first = _row(BY_SENSOR + side, w), BY_POINT + 3 * side
        along, a, b = _row(first + axis, w), _row(first + i, w), _row(first + j, w)
        for n in range(LANES):
            to[n] = along[n] if place >= 3 else x[n] * b[n] - y[n] * a[n]


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def derive_by_column(k, source, w):
    """Takes rows `source` and the next as free column number k: weighted, and with its product with P."""
    by_u, by_v = _row(BY_COLUMN + 2 * k, w), _row(BY_COLUMN + 2 * k + 1, w)
    from_u, from_v = _row(source, w), _row(source + 1, w)
    for n in range(LANES):
        root = w[_ROOT * LANES + n]
        by_u[n] = from_u[n] * root if root > 0.0 else 0.0
    for n in range(LANES):
        root = w[_ROOT * LANES + n]
        by_v[n] = from_v[n] * root if root > 0.0 else 0.0
    for a in range(3):
        p, q, to = _row(BY_POINT_IN_WORLD + a, w), _row(BY_POINT_IN_WORLD + 3 + a, w), _row(OUT + 9 + 3 * k + a, w)
        for n in range(LANES):
            to[n] = p[n] * by_u[n] + q[n] * by_v[n]


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def total(a, b, c, d, w):
    """Σ over the lanes of row a × row b + row c × row d. The compiler chooses the order, always the same one."""
    first, second, third, fourth = _row(a, w), _row(b, w), _row(c, w), _row(d, w)
    s = 0.0
    for n in range(LANES):
        s += first[n] * second[n] + third[n] * fourth[n]
    return s


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _row(number, w):
    return w[number * LANES : (number + 1) * LANES]
