"""What each view contributes to the normal equations, and their solution with the poses eliminated.

A view's columns are its pose (ω, υ), the free parameters of the camera, the free coefficients of the board's shape,
and last the residual itself. `blocks[v]` is the lower triangle of [J | e]ᵀ [J | e]: normal matrix, gradient in the last
row, sum of squares in the corner. Observations go through in lanes, see `sfm.core.cameras._lane_kernels`; columns are
2 LANES long, all u before all v.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sfm.core.cameras._lane_kernels import BY_PARAMS, BY_POINT, LANES, OK, U, V, X, Y, Z, fill_by_param, project_lanes
from sfm.core.cameras._lane_kernels import ROWS as _CAMERA_ROWS
from sfm.core.optim._loss_kernels import TRIVIAL, loss_and_weight

POSE = 6
_PIVOT = 1e-14
"""Least pivot, over the diagonal before elimination, that is not a rounding error."""
_ROOT = _CAMERA_ROWS
"""Three rows: the root of the information, upper triangular, times that of the robust weight."""
_COLUMNS = _ROOT + 3


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_views(
    model_id, params, columns, squared_limit, rotations, translations, offsets, rows, board, basis, observed, roots,
    loss, scale, lost_cost, costs, blocks, residuals,
):  # fmt: skip
    """Fills the cost of each view and its block, or instead of blocks the residuals (n, 2) in px where they are wanted.

    Args:
        columns: free parameters; squared_limit: see `project_lanes`.
        board: (P, 3) at the current shape; basis: (P, 3, S) its derivatives by the free coefficients.
        roots: (n, 3) a, b, c of the whitening (a du + b dv, c dv).
        lost_cost: cost of an observation without projection.
        residuals: empty where they are not wanted; NaN where there is no projection.
    """
    shape = basis.shape[2]
    width = POSE + len(columns) + shape + 1
    w = np.empty((_COLUMNS + 2 * width) * LANES)
    for view in range(len(offsets) - 1):
        R, t = rotations[view], translations[view]
        if not len(residuals):
            blocks[view] = 0.0
        cost = 0.0
        for first in range(offsets[view], offsets[view + 1], LANES):
            last = min(first + LANES, offsets[view + 1])
            _fetch(first, last, rows, board, roots, R, t, w)
            project_lanes(model_id, params, squared_limit, w)
            cost += _weigh(first, last, observed, loss, scale, lost_cost, width - 1, w)
            if len(residuals):
                for n in range(first, last):
                    seen = w[OK * LANES + n - first] > 0.0
                    residuals[n, 0] = w[U * LANES + n - first] - observed[n, 0] if seen else math.nan
                    residuals[n, 1] = w[V * LANES + n - first] - observed[n, 1] if seen else math.nan
                continue
            _derive_by_pose(w)
            for k in range(len(columns)):
                fill_by_param(model_id, params, columns[k], w)
                _whiten(BY_PARAMS + 2 * columns[k], _COLUMNS + 2 * (POSE + k), w)
            for k in range(shape):
                _derive_by_shape(first, last, rows, basis, k, R, _COLUMNS + 2 * (POSE + len(columns) + k), w)
            _accumulate(width, w, blocks[view])
        costs[view] = 0.5 * cost


@njit(cache=True, nogil=True, error_model="numpy")
def _fetch(first, last, rows, board, roots, R, t, w):
    """Points in the camera frame and roots of information; lanes beyond the end repeat the last with none."""
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22, t0, t1, t2 = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
    for n in range(LANES):
        o = min(first + n, last - 1)
        p, inside = rows[o], first + n < last
        x, y, z = board[p, 0], board[p, 1], board[p, 2]
        w[X * LANES + n] = r00 * x + r01 * y + r02 * z + t0
        w[Y * LANES + n] = r10 * x + r11 * y + r12 * z + t1
        w[Z * LANES + n] = r20 * x + r21 * y + r22 * z + t2
        w[_ROOT * LANES + n] = roots[o, 0] if inside else 0.0
        w[(_ROOT + 1) * LANES + n] = roots[o, 1] if inside else 0.0
        w[(_ROOT + 2) * LANES + n] = roots[o, 2] if inside else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(first, last, observed, loss, scale, lost_cost, column, w):
    """The residual's column and Σ ρ; roots of lanes without projection become zero."""
    row = _COLUMNS + 2 * column
    to_u, to_v = w[row * LANES : (row + 1) * LANES], w[(row + 1) * LANES : (row + 2) * LANES]
    cost = 0.0
    for n in range(LANES):
        o = min(first + n, last - 1)
        seen = w[OK * LANES + n] > 0.0
        a, b, c = w[_ROOT * LANES + n], w[(_ROOT + 1) * LANES + n], w[(_ROOT + 2) * LANES + n]
        a, b, c = (a if seen else 0.0), (b if seen else 0.0), (c if seen else 0.0)
        du, dv = w[U * LANES + n] - observed[o, 0], w[V * LANES + n] - observed[o, 1]
        eu, ev = a * du + b * dv, c * dv
        square = eu * eu + ev * ev
        if loss != TRIVIAL:
            square, weight = loss_and_weight(loss, scale, square)
            root = math.sqrt(weight)
            eu, ev, a, b, c = eu * root, ev * root, a * root, b * root, c * root
        cost += square if seen else (2.0 * lost_cost if first + n < last else 0.0)
        to_u[n], to_v[n] = eu, ev
        w[_ROOT * LANES + n], w[(_ROOT + 1) * LANES + n], w[(_ROOT + 2) * LANES + n] = a, b, c
    return cost


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _derive_by_pose(w):
    """Whitened A [−[x]×, I]: for a row a of A, a · (ω × x) = ω · (x × a)."""
    c = _COLUMNS * LANES
    for n in range(LANES):
        x, y, z = w[X * LANES + n], w[Y * LANES + n], w[Z * LANES + n]
        ra, rb, rc = w[_ROOT * LANES + n], w[(_ROOT + 1) * LANES + n], w[(_ROOT + 2) * LANES + n]
        q0, q1 = rc * w[(BY_POINT + 3) * LANES + n], rc * w[(BY_POINT + 4) * LANES + n]
        q2 = rc * w[(BY_POINT + 5) * LANES + n]
        p0 = ra * w[BY_POINT * LANES + n] + rb * w[(BY_POINT + 3) * LANES + n]
        p1 = ra * w[(BY_POINT + 1) * LANES + n] + rb * w[(BY_POINT + 4) * LANES + n]
        p2 = ra * w[(BY_POINT + 2) * LANES + n] + rb * w[(BY_POINT + 5) * LANES + n]
        w[c + n], w[c + LANES + n] = y * p2 - z * p1, y * q2 - z * q1
        w[c + 2 * LANES + n], w[c + 3 * LANES + n] = z * p0 - x * p2, z * q0 - x * q2
        w[c + 4 * LANES + n], w[c + 5 * LANES + n] = x * p1 - y * p0, x * q1 - y * q0
        w[c + 6 * LANES + n], w[c + 7 * LANES + n] = p0, q0
        w[c + 8 * LANES + n], w[c + 9 * LANES + n] = p1, q1
        w[c + 10 * LANES + n], w[c + 11 * LANES + n] = p2, q2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _whiten(source, row, w):
    from_u, from_v = w[source * LANES : (source + 1) * LANES], w[(source + 1) * LANES : (source + 2) * LANES]
    to_u, to_v = w[row * LANES : (row + 1) * LANES], w[(row + 1) * LANES : (row + 2) * LANES]
    for n in range(LANES):
        to_u[n] = w[_ROOT * LANES + n] * from_u[n] + w[(_ROOT + 1) * LANES + n] * from_v[n]
        to_v[n] = w[(_ROOT + 2) * LANES + n] * from_v[n]


@njit(cache=True, nogil=True, error_model="numpy")
def _derive_by_shape(first, last, rows, basis, k, R, row, w):
    """The columns by υ are the whitened A; times R and the movement of the point on the board."""
    to_u, to_v = w[row * LANES : (row + 1) * LANES], w[(row + 1) * LANES : (row + 2) * LANES]
    c = (_COLUMNS + 6) * LANES
    for n in range(LANES):
        p = rows[min(first + n, last - 1)]
        x, y, z = basis[p, 0, k], basis[p, 1, k], basis[p, 2, k]
        dx = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        dy = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        dz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        to_u[n] = w[c + n] * dx + w[c + 2 * LANES + n] * dy + w[c + 4 * LANES + n] * dz
        to_v[n] = w[c + LANES + n] * dx + w[c + 3 * LANES + n] * dy + w[c + 5 * LANES + n] * dz


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _accumulate(width, w, block):
    """Adds the products of all columns, four at a time. The compiler chooses the order of sums, always the same."""
    for i in range(0, width, 2):
        a = w[(_COLUMNS + 2 * i) * LANES : (_COLUMNS + 2 * i + 2) * LANES]
        second = min(i + 1, width - 1)
        b = w[(_COLUMNS + 2 * second) * LANES : (_COLUMNS + 2 * second + 2) * LANES]
        for j in range(0, i + 2, 2):
            beside = min(j + 1, width - 1)
            c = w[(_COLUMNS + 2 * j) * LANES : (_COLUMNS + 2 * j + 2) * LANES]
            d = w[(_COLUMNS + 2 * beside) * LANES : (_COLUMNS + 2 * beside + 2) * LANES]
            s, t, u, v = 0.0, 0.0, 0.0, 0.0
            for n in range(2 * LANES):
                s += a[n] * c[n]
                t += a[n] * d[n]
                u += b[n] * c[n]
                v += b[n] * d[n]
            if j < width and i < width:
                block[i, j] += s
                if beside > j:
                    block[i, beside] += t
                if second > i:
                    block[second, j] += u
                    if beside > j:
                        block[second, beside] += v


@njit(cache=True, nogil=True, error_model="numpy")
def solve_views(blocks, diagonal, shared_diagonal, damping, L, Y, S, by_pose, by_shared):
    """Solves (H + λD) δ = −g with the poses eliminated; False where the matrix is not positive definite.

    `diagonal` (V, 6) and `shared_diagonal` (K,) are D. Fills the steps (V, 6) and (K,), the factors L (V, 6, 6) of the
    poses' blocks, Y = L⁻¹ [W | g] (V, 6, K + 1) and the factor of the reduced matrix in the lower triangle of S
    (K + 1, K + 1).
    """
    shared = len(by_shared)
    S[:] = 0.0
    for view in range(len(blocks)):
        H = blocks[view]
        for j in range(POSE):
            for i in range(j, POSE):
                s = H[i, j] + (damping * diagonal[view, j] if i == j else 0.0)
                for m in range(j):
                    s -= L[view, i, m] * L[view, j, m]
                if i == j:
                    if not s > _PIVOT * H[j, j]:
                        return False
                    L[view, j, j] = math.sqrt(s)
                else:
                    L[view, i, j] = s / L[view, j, j]
        for i in range(POSE):
            for k in range(shared + 1):
                s = H[POSE + k, i]
                for m in range(i):
                    s -= L[view, i, m] * Y[view, m, k]
                Y[view, i, k] = s / L[view, i, i]
        for i in range(shared + 1):
            for j in range(i + 1):
                s = H[POSE + i, POSE + j]
                for m in range(POSE):
                    s -= Y[view, m, i] * Y[view, m, j]
                S[i, j] += s
    for j in range(shared):
        for i in range(j, shared + 1):
            s = S[i, j] + (damping * shared_diagonal[j] if i == j else 0.0)
            before = s
            for m in range(j):
                s -= S[i, m] * S[j, m]
            if i == j:
                if not s > _PIVOT * before:
                    return False
                S[j, j] = math.sqrt(s)
            else:
                S[i, j] = s / S[j, j]
    for j in range(shared - 1, -1, -1):
        s = -S[shared, j]
        for m in range(j + 1, shared):
            s -= S[m, j] * by_shared[m]
        by_shared[j] = s / S[j, j]
    for view in range(len(blocks)):
        for j in range(POSE - 1, -1, -1):
            s = -Y[view, j, shared]
            for k in range(shared):
                s -= Y[view, j, k] * by_shared[k]
            for m in range(j + 1, POSE):
                s -= L[view, m, j] * by_pose[view, m]
            by_pose[view, j] = s / L[view, j, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def move_poses(rotations, translations, steps, new_rotations, new_translations):
    """R ← exp(ω) R, t ← exp(ω) t + υ."""
    E = np.empty((3, 3))
    for view in range(len(steps)):
        x, y, z = steps[view, 0], steps[view, 1], steps[view, 2]
        square = x * x + y * y + z * z
        angle = math.sqrt(square)
        if angle > 1e-4:
            a, half = math.sin(angle) / angle, math.sin(0.5 * angle)
            b = 2.0 * half * half / square
        else:
            a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
        E[0, 0], E[0, 1], E[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
        E[1, 0], E[1, 1], E[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
        E[2, 0], E[2, 1], E[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
        R, t = rotations[view], translations[view]
        for i in range(3):
            for j in range(3):
                new_rotations[view, i, j] = E[i, 0] * R[0, j] + E[i, 1] * R[1, j] + E[i, 2] * R[2, j]
            new_translations[view, i] = E[i, 0] * t[0] + E[i, 1] * t[1] + E[i, 2] * t[2] + steps[view, 3 + i]
