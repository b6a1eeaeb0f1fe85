"""What each view contributes to the normal equations, and their solution with the poses eliminated.

A view's columns are its pose (ω, υ), the free parameters of the camera, the free coefficients of the board's shape,
and last the residual itself. `blocks[v]` is the lower triangle of [J | e]ᵀ [J | e]: normal matrix, gradient in the last
row, sum of squares in the corner. Observations go through in lanes, see `sfm.core.cameras._lane_kernels`; columns are
2 LANES long, all u before all v. Those of the pose come first, those of a camera's parameter lie where the parameter
does among all that the model has, then come the shape's and the residual.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sfm.core.cameras._kernels import MAX_PARAMS, _scale_and_offset
from sfm.core.cameras._lane_kernels import (
    _A,
    _A_DISTORTED,
    _B,
    _B_DISTORTED,
    _D,
    _G,
    _S,
    BY_PARAMS,
    BY_POINT,
    LANES,
    OK,
    U,
    V,
    X,
    Y,
    Z,
    fill_by_param,
    is_perspective,
    project_lanes,
)
from sfm.core.cameras._lane_kernels import ROWS as _CAMERA_ROWS
from sfm.core.optim._loss_kernels import TRIVIAL, loss_and_weight

POSE = 6
_PIVOT = 1e-14
"""Least pivot, over the diagonal before elimination, that is not a rounding error."""
_LEAST_GROWTH = 1e-3
"""Of the gradient along a step, over what the reduced matrix promises, below which a step teaches nothing."""
_ROOT = _CAMERA_ROWS
"""Three rows: the root of the information, upper triangular, times that of the robust weight."""
_COLUMNS = _ROOT + 3
_BY_FX = _COLUMNS + 2 * POSE
_BY_SHAPE = _BY_FX + 2 * MAX_PARAMS
_FX_FY_APART = (1, 4, 6, 10001)
"""Models whose parameters begin with fx, fy, cx, cy, k1, k2, p1, p2, k3 … s4, as far as they go."""


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_views(
    model_id, params, columns, squared_limit, rotations, translations, offsets, rows, board, basis, observed, roots,
    loss, scale, lost_cost, costs, blocks, residuals,
):  # fmt: skip
    """Fills the cost of each view and its block, or instead of blocks the residuals (n, 2) in px where they are wanted.

    Returns the sum of costs.

    Args:
        columns: free parameters; squared_limit: see `project_lanes`.
        board: (P, 3) at the current shape; basis: (P, 3, S) its derivatives by the free coefficients.
        roots: (n, 3) a, b, c of the whitening (a du + b dv, c dv).
        lost_cost: cost of an observation without projection.
        residuals: empty where they are not wanted; NaN where there is no projection.
    """
    shape = basis.shape[2]
    width = POSE + len(columns) + shape + 1
    error = _BY_SHAPE + 2 * shape
    w = np.empty((error + 2) * LANES + 16)
    rows_of = np.empty(width, np.int64)
    for k in range(width):
        rows_of[k] = _COLUMNS + 2 * k if k < POSE else _BY_SHAPE + 2 * (k - POSE - len(columns))
    for k in range(len(columns)):
        rows_of[POSE + k] = _BY_FX + 2 * columns[k]
    total = 0.0
    for view in range(len(offsets) - 1):
        R, t = rotations[view], translations[view]
        if not len(residuals):
            blocks[view] = 0.0
        cost = 0.0
        for first in range(offsets[view], offsets[view + 1], LANES):
            last = min(first + LANES, offsets[view + 1])
            _fetch(first, last, rows, board, roots, R, t, w)
            project_lanes(model_id, params, squared_limit, w)
            cost += _weigh(first, last, observed, loss, scale, lost_cost, error, w)
            if len(residuals):
                for n in range(first, last):
                    seen = w[OK * LANES + n - first] > 0.0
                    residuals[n, 0] = w[U * LANES + n - first] - observed[n, 0] if seen else math.nan
                    residuals[n, 1] = w[V * LANES + n - first] - observed[n, 1] if seen else math.nan
                continue
            _derive_by_pose(w)
            _derive_by_camera(model_id, params, columns, w)
            for k in range(shape):
                _derive_by_shape(first, last, rows, basis, k, R, _BY_SHAPE + 2 * k, w)
            _accumulate(rows_of, w, blocks[view])
        costs[view] = 0.5 * cost
        total += 0.5 * cost
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _weigh(first, last, observed, loss, scale, lost_cost, row, w):
    """The residual's column and Σ ρ; roots of lanes without projection become zero."""
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


@njit(cache=True, nogil=True, error_model="numpy")
def _derive_by_camera(model_id, params, columns, w):
    """Fills the whitened columns of the free parameters, and maybe others."""
    if model_id in _FX_FY_APART:
        fx, fy, _, _, _ = _scale_and_offset(model_id, params)
        if len(columns):
            _derive_by_first(fx, fy, w)
        if len(columns) and columns[-1] >= 8:
            _derive_by_further(fx, fy, w)
        return
    for k in columns:
        if is_perspective(model_id):
            fill_by_param(model_id, params, k, w)
        _whiten(BY_PARAMS + 2 * k, _BY_FX + 2 * k, w)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _derive_by_first(fx, fy, w):
    """fx, fy, cx, cy, k1, k2, p1, p2 in one loop: a loop for each takes three times as long."""
    c = _BY_FX * LANES
    for n in range(LANES):
        a, b, s = w[_A * LANES + n], w[_B * LANES + n], w[_S * LANES + n]
        ra, rb, rc = w[_ROOT * LANES + n], w[(_ROOT + 1) * LANES + n], w[(_ROOT + 2) * LANES + n]
        far_a, far_b = w[_A_DISTORTED * LANES + n], w[_B_DISTORTED * LANES + n]
        w[c + n], w[c + LANES + n] = ra * far_a, 0.0
        w[c + 2 * LANES + n], w[c + 3 * LANES + n] = rb * far_b, rc * far_b
        w[c + 4 * LANES + n], w[c + 5 * LANES + n] = ra, 0.0
        w[c + 6 * LANES + n], w[c + 7 * LANES + n] = rb, rc
        fa, fb, fc = fx * ra, fy * rb, fy * rc
        factor = s * w[_D * LANES + n]
        u, v = factor * (fa * a + fb * b), factor * fc * b
        w[c + 8 * LANES + n], w[c + 9 * LANES + n] = u, v
        w[c + 10 * LANES + n], w[c + 11 * LANES + n] = s * u, s * v
        product, along_a, along_b = 2.0 * a * b, s + 2.0 * a * a, s + 2.0 * b * b
        w[c + 12 * LANES + n], w[c + 13 * LANES + n] = fa * product + fb * along_b, fc * along_b
        w[c + 14 * LANES + n], w[c + 15 * LANES + n] = fa * along_a + fb * product, fc * product


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _derive_by_further(fx, fy, w):
    """k3, k4, k5, k6, s1, s2, s3, s4."""
    c = (_BY_FX + 16) * LANES
    for n in range(LANES):
        a, b, s, g = w[_A * LANES + n], w[_B * LANES + n], w[_S * LANES + n], w[_G * LANES + n]
        ra, rb, rc = w[_ROOT * LANES + n], w[(_ROOT + 1) * LANES + n], w[(_ROOT + 2) * LANES + n]
        fa, fb, fc = fx * ra, fy * rb, fy * rc
        factor, square = s * w[_D * LANES + n], s * s
        u, v = factor * (fa * a + fb * b), factor * fc * b
        w[c + n], w[c + LANES + n] = square * u, square * v
        u, v = -g * u, -g * v
        w[c + 2 * LANES + n], w[c + 3 * LANES + n] = u, v
        w[c + 4 * LANES + n], w[c + 5 * LANES + n] = s * u, s * v
        w[c + 6 * LANES + n], w[c + 7 * LANES + n] = square * u, square * v
        w[c + 8 * LANES + n], w[c + 9 * LANES + n] = fa * s, 0.0
        w[c + 10 * LANES + n], w[c + 11 * LANES + n] = fa * square, 0.0
        w[c + 12 * LANES + n], w[c + 13 * LANES + n] = fb * s, fc * s
        w[c + 14 * LANES + n], w[c + 15 * LANES + n] = fb * square, fc * square


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
def _accumulate(rows_of, w, block):
    """Adds the products of all columns, four by four, so that each number that is loaded serves four times.

    The compiler chooses the order of sums, always the same. The last 16 numbers of `w` take them. With 32 vector
    registers this takes half of the time of two by two; with 16 of them two by four would take 0.6 of it.
    """
    width, sums = len(rows_of), len(w) - 16
    for i in range(0, width, 4):
        a0, a1 = _column(rows_of, i, w), _column(rows_of, i + 1, w)
        a2, a3 = _column(rows_of, i + 2, w), _column(rows_of, i + 3, w)
        for j in range(0, i + 4, 4):
            b0, b1 = _column(rows_of, j, w), _column(rows_of, j + 1, w)
            b2, b3 = _column(rows_of, j + 2, w), _column(rows_of, j + 3, w)
            s00, s01, s02, s03, s10, s11, s12, s13 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            s20, s21, s22, s23, s30, s31, s32, s33 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for n in range(2 * LANES):
                x0, x1, x2, x3 = b0[n], b1[n], b2[n], b3[n]
                s00, s01, s02, s03 = s00 + a0[n] * x0, s01 + a0[n] * x1, s02 + a0[n] * x2, s03 + a0[n] * x3
                s10, s11, s12, s13 = s10 + a1[n] * x0, s11 + a1[n] * x1, s12 + a1[n] * x2, s13 + a1[n] * x3
                s20, s21, s22, s23 = s20 + a2[n] * x0, s21 + a2[n] * x1, s22 + a2[n] * x2, s23 + a2[n] * x3
                s30, s31, s32, s33 = s30 + a3[n] * x0, s31 + a3[n] * x1, s32 + a3[n] * x2, s33 + a3[n] * x3
            w[sums], w[sums + 1], w[sums + 2], w[sums + 3] = s00, s01, s02, s03
            w[sums + 4], w[sums + 5], w[sums + 6], w[sums + 7] = s10, s11, s12, s13
            w[sums + 8], w[sums + 9], w[sums + 10], w[sums + 11] = s20, s21, s22, s23
            w[sums + 12], w[sums + 13], w[sums + 14], w[sums + 15] = s30, s31, s32, s33
            for p in range(i, min(i + 4, width)):
                for q in range(j, min(j + 4, p + 1)):
                    block[p, q] += w[sums + 4 * (p - i) + q - j]


@njit(cache=True, nogil=True, error_model="numpy")
def _column(rows_of, k, w):
    row = rows_of[min(k, len(rows_of) - 1)]
    return w[row * LANES : (row + 2) * LANES]


@njit(cache=True, nogil=True, error_model="numpy")
def scale_views(blocks, floor, factor, diagonal, shared_diagonal):
    """Fills D, `factor` times the diagonal of H but never zero; returns the largest entry of the gradient.

    A pose's part is at least `floor` of the largest of all poses.
    """
    shared, largest, steepest = len(shared_diagonal), 0.0, 0.0
    shared_diagonal[:] = 0.0
    gradient = np.zeros(shared)
    for view in range(len(blocks)):
        H = blocks[view]
        for j in range(POSE):
            diagonal[view, j] = factor * H[j, j]
            largest = max(largest, factor * H[j, j])
            steepest = max(steepest, abs(H[POSE + shared, j]))
        for k in range(shared):
            shared_diagonal[k] += factor * H[POSE + k, POSE + k]
            gradient[k] += H[POSE + shared, POSE + k]
    for view in range(len(blocks)):
        for j in range(POSE):
            diagonal[view, j] = max(diagonal[view, j], floor * largest)
    for k in range(shared):
        if not shared_diagonal[k] > 0.0:
            shared_diagonal[k] = factor
        steepest = max(steepest, abs(gradient[k]))
    return steepest


@njit(cache=True, nogil=True, error_model="numpy")
def eliminate_views(blocks, diagonal, damping, L, Y, S):
    """Takes the poses out of (H + λD) δ = −g; False where a pose's block is not positive definite.

    `diagonal` (V, 6) are the poses' part of D. Fills the factors L (V, 6, 6) of the blocks, Y = L⁻¹ [W | g]
    (V, 6, K + 1) and the lower triangle of S (K + 1, K + 1): the reduced matrix, not yet damped, its gradient last.
    """
    S[:] = 0.0
    definite = True
    for view in range(len(blocks)):
        definite = _eliminate(blocks[view], diagonal[view], damping, L[view], Y[view], S) and definite
    return definite


@njit(cache=True, nogil=True, error_model="numpy")
def bend_by_secant(S, step, gradient, bend):
    """Corrects `bend` (K, K), what the reduced matrix lacks of the second derivative, by a step of what is shared.

    The step (K,) led here from where the reduced gradient was `gradient` (K,). The symmetric update of Dennis, Gay and
    Welsch, with their sizing; it is left out where the gradient did not grow along the step.
    """
    count = len(step)
    grown, lacking, known = np.empty(count), np.empty(count), np.empty(count)
    along, curved, expected, promised = 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        grown[i] = S[count, i] - gradient[i]
        linear, known[i] = 0.0, 0.0
        for j in range(count):
            linear += (S[i, j] if j <= i else S[j, i]) * step[j]
            known[i] += bend[i, j] * step[j]
        lacking[i] = grown[i] - linear
        along += grown[i] * step[i]
        curved += lacking[i] * step[i]
        expected += known[i] * step[i]
        promised += linear * step[i]
    size = min(1.0, abs(curved) / abs(expected)) if expected != 0.0 else 1.0
    inner = curved - size * expected
    for i in range(count):
        for j in range(count):
            bend[i, j] *= size
            if along > _LEAST_GROWTH * promised:
                first, second = lacking[i] - size * known[i], lacking[j] - size * known[j]
                bend[i, j] += (first * grown[j] + grown[i] * second - inner / along * grown[i] * grown[j]) / along


@njit(cache=True, nogil=True, error_model="numpy")
def step_views(blocks, diagonal, shared_diagonal, damping, L, Y, S, bend, F, by_pose, by_shared):
    """Solves what `eliminate_views` left, with `bend` (K, K) added; returns δᵀδ, gᵀδ and δᵀDδ.

    They are NaN where the matrix is not positive definite. Fills the steps (V, 6) and (K,) and the factor of the damped
    reduced matrix in the lower triangle of F (K + 1, K + 1).
    """
    shared = len(by_shared)
    for j in range(shared):
        least = _PIVOT * (S[j, j] + damping * shared_diagonal[j])
        for i in range(j, shared + 1):
            s = S[i, j] + (damping * shared_diagonal[j] if i == j else 0.0) + (bend[i, j] if i < shared else 0.0)
            for m in range(j):
                s -= F[i, m] * F[j, m]
            if i == j:
                if not s > least:
                    return math.nan, math.nan, math.nan
                F[j, j] = math.sqrt(s)
            else:
                F[i, j] = s / F[j, j]
    square, slope, damped = 0.0, 0.0, 0.0
    for j in range(shared - 1, -1, -1):
        s = -F[shared, j]
        for m in range(j + 1, shared):
            s -= F[m, j] * by_shared[m]
        by_shared[j] = s / F[j, j]
        square += by_shared[j] ** 2
        damped += shared_diagonal[j] * by_shared[j] ** 2
    for view in range(len(blocks)):
        H = blocks[view]
        for j in range(POSE - 1, -1, -1):
            s = -Y[view, j, shared]
            for k in range(shared):
                s -= Y[view, j, k] * by_shared[k]
            for m in range(j + 1, POSE):
                s -= L[view, m, j] * by_pose[view, m]
            s /= L[view, j, j]
            by_pose[view, j] = s
            square += s * s
            slope += H[POSE + shared, j] * s
            damped += diagonal[view, j] * s * s
        for k in range(shared):
            slope += H[POSE + shared, POSE + k] * by_shared[k]
    return square, slope, damped


@njit(cache=True, nogil=True, error_model="numpy")
def _eliminate(H, diagonal, damping, L, Y, S):
    """Factor and couplings of a pose; S gains what the view tells of what is shared. False: not definite."""
    columns = len(S)
    for j in range(POSE):
        for i in range(j, POSE):
            s = H[i, j] + (damping * diagonal[j] if i == j else 0.0)
            for m in range(j):
                s -= L[i, m] * L[j, m]
            if i == j:
                if not s > _PIVOT * H[j, j]:
                    return False
                L[j, j] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for k in range(columns):
        for i in range(POSE):
            s = H[POSE + k, i]
            for m in range(i):
                s -= L[i, m] * Y[m, k]
            Y[i, k] = s / L[i, i]
    for i in range(columns):
        y0, y1, y2, y3, y4, y5 = Y[0, i], Y[1, i], Y[2, i], Y[3, i], Y[4, i], Y[5, i]
        for j in range(i + 1):
            taken = y0 * Y[0, j] + y1 * Y[1, j] + y2 * Y[2, j] + y3 * Y[3, j] + y4 * Y[4, j] + y5 * Y[5, j]
            S[i, j] += H[POSE + i, POSE + j] - taken
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def move_poses(rotations, translations, steps, new_rotations, new_translations):
    """R ← exp(ω) R, t ← exp(ω) t + υ. Returns the sum of squares of the translations before."""
    E, square_sum = np.empty((3, 3)), 0.0
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
            square_sum += t[i] * t[i]
    return square_sum
