"""The problems of two views: essential, fundamental and homography matrices.

Errors are first-order geometric (Sampson) distances, in the units of the data, summed over both images. With e the
algebraic error of a correspondence and ∇e its gradient by the coordinates of both keypoints:

    epipolar      e = r2ᵀ M r1                       r² = e² / |∇e|²
    homography    e = x2 − π(H x1),  A = ∂π(H x1)/∂x1     r² = eᵀ (I + A Aᵀ)⁻¹ e, infinite where w ≤ 0

ESSENTIAL holds rays and their derivatives J by the pixel, so that ∇e = (J1ᵀ Eᵀ r2, J2ᵀ E r1): the tangent Sampson
error, in px for any camera model. FUNDAMENTAL and HOMOGRAPHY hold points, r = (x, y, 1) and J = (1 0; 0 1; 0 0).

Data are columns (rows of an array, one column per correspondence):
    ESSENTIAL 18: r1 (3), r2 (3), J1 (3 × 2 by rows), J2 (3 × 2 by rows). Others 4: x1, y1, x2, y2.

References:
    Terekhov & Larsson, Tangent Sampson error, CVPR 2023. Luong & Faugeras, IJCV 1996.
    Chum, Pajdla & Sturm, The geometric error for homographies, CVIU 2005.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sfm.core.geometry.minimal._five_point_kernels import five_point
from sfm.core.geometry.minimal._seven_point_kernels import four_point, seven_point
from sfm.core.robust import _manifold_kernels as manifold
from sfm.core.robust._loss_kernels import robust_weight

ESSENTIAL, FUNDAMENTAL, HOMOGRAPHY = 0, 1, 2
_BLOCK = 64


class TwoViews(NamedTuple):
    """A problem of two views: which, and its columns (rows, N), contiguous."""

    kind: int
    data: np.ndarray


def solve(problem, samples, models):
    if problem.kind == ESSENTIAL:
        return five_point(problem.data, samples, models)
    if problem.kind == FUNDAMENTAL:
        return seven_point(problem.data, samples, models)
    return four_point(problem.data, samples, models)


def plausible(problem, model, sample):
    """Whether both cameras can see the whole sample in front of them; turns the sign of a homography so that w > 0."""
    if problem.kind == HOMOGRAPHY:
        return visible_plane(problem.data, model, sample)
    return visible_points(problem, model, sample)


@njit(cache=True, nogil=True, error_model="numpy")
def visible_plane(data, m, sample):
    """Whether w has one sign on the sample, which m is given, and then det H > 0: both cameras see the same side."""
    positive = 0
    for i in sample:
        positive += m[6] * data[0, i] + m[7] * data[1, i] + m[8] > 0.0
    if 0 < positive < sample.shape[0]:
        return False
    if positive == 0:
        for k in range(9):
            m[k] = -m[k]
    return (
        m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6]) + m[2] * (m[3] * m[7] - m[4] * m[6])
        > 0.0
    )


@njit(cache=True, nogil=True, error_model="numpy")
def visible_points(problem, m, sample):
    """Whether F r1 and t × r2, which are parallel, agree in direction for all of the sample or for none of it.

    With depths d along the rays, d1 F r1 = d2 t × r2 up to one sign for all points.
    """
    data, first = problem.data, 0.0
    # The left null vector t: the longest cross product of two columns of m.
    t0 = t1 = t2 = longest = 0.0
    for j in range(3):
        k = (j + 1) % 3
        a, b = m[3 + j] * m[6 + k] - m[6 + j] * m[3 + k], m[6 + j] * m[k] - m[j] * m[6 + k]
        c = m[j] * m[3 + k] - m[3 + j] * m[k]
        square = a * a + b * b + c * c
        if square > longest:
            t0, t1, t2, longest = a, b, c, square
    for i in sample:
        if problem.kind == ESSENTIAL:
            x1, y1, z1, x2, y2, z2 = data[0, i], data[1, i], data[2, i], data[3, i], data[4, i], data[5, i]
        else:
            x1, y1, z1, x2, y2, z2 = data[0, i], data[1, i], 1.0, data[2, i], data[3, i], 1.0
        side = (
            (m[0] * x1 + m[1] * y1 + m[2] * z1) * (t1 * z2 - t2 * y2)
            + (m[3] * x1 + m[4] * y1 + m[5] * z1) * (t2 * x2 - t0 * z2)
            + (m[6] * x1 + m[7] * y1 + m[8] * z1) * (t0 * y2 - t1 * x2)
        )
        if side * first < 0.0:
            return False
        first = side
    return True


def squared_errors(problem, model, start, stop, out):
    """Fills out[start:stop] with the squared errors of the model m, a matrix by rows."""
    kind, data, m = problem.kind, problem.data, model
    if kind == ESSENTIAL:
        for i in range(start, stop):
            x1, y1, z1 = data[0, i], data[1, i], data[2, i]
            x2, y2, z2 = data[3, i], data[4, i], data[5, i]
            a0 = m[0] * x1 + m[1] * y1 + m[2] * z1
            a1 = m[3] * x1 + m[4] * y1 + m[5] * z1
            a2 = m[6] * x1 + m[7] * y1 + m[8] * z1
            b0 = m[0] * x2 + m[3] * y2 + m[6] * z2
            b1 = m[1] * x2 + m[4] * y2 + m[7] * z2
            b2 = m[2] * x2 + m[5] * y2 + m[8] * z2
            e = a0 * x2 + a1 * y2 + a2 * z2
            g0 = b0 * data[6, i] + b1 * data[8, i] + b2 * data[10, i]
            g1 = b0 * data[7, i] + b1 * data[9, i] + b2 * data[11, i]
            g2 = a0 * data[12, i] + a1 * data[14, i] + a2 * data[16, i]
            g3 = a0 * data[13, i] + a1 * data[15, i] + a2 * data[17, i]
            out[i] = e * e / (g0 * g0 + g1 * g1 + g2 * g2 + g3 * g3 + 1e-300)
    elif kind == FUNDAMENTAL:
        for i in range(start, stop):
            x1, y1, x2, y2 = data[0, i], data[1, i], data[2, i], data[3, i]
            a0 = m[0] * x1 + m[1] * y1 + m[2]
            a1 = m[3] * x1 + m[4] * y1 + m[5]
            b0 = m[0] * x2 + m[3] * y2 + m[6]
            b1 = m[1] * x2 + m[4] * y2 + m[7]
            e = a0 * x2 + a1 * y2 + m[6] * x1 + m[7] * y1 + m[8]
            out[i] = e * e / (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1 + 1e-300)
    else:
        for i in range(start, stop):
            x1, y1 = data[0, i], data[1, i]
            w = m[6] * x1 + m[7] * y1 + m[8]
            if not w > 0.0:
                out[i] = np.inf
                continue
            w = 1.0 / w
            u, v = (m[0] * x1 + m[1] * y1 + m[2]) * w, (m[3] * x1 + m[4] * y1 + m[5]) * w
            e0, e1 = data[2, i] - u, data[3, i] - v
            a, b = (m[0] - u * m[6]) * w, (m[1] - u * m[7]) * w
            c, d = (m[3] - v * m[6]) * w, (m[4] - v * m[7]) * w
            p, q, s = 1.0 + a * a + b * b, a * c + b * d, 1.0 + c * c + d * d
            out[i] = (s * e0 * e0 - 2.0 * q * e0 * e1 + p * e1 * e1) / (p * s - q * q)


def parameters(problem):
    return 5 if problem.kind == ESSENTIAL else 8


def start(problem, model, state):
    """Any of the four decompositions of E serves, since all have the same E up to sign."""
    if problem.kind != HOMOGRAPHY:
        return manifold.matrix_state(model, problem.kind == ESSENTIAL, state)
    # H[2, 2] vanishes only if the centre of the data is mapped to infinity.
    unit = max(abs(model[8]), 1e-9)
    for k in range(9):
        state[k] = model[k] / unit
    return True


def model_of(problem, state, model):
    if problem.kind == HOMOGRAPHY:
        for k in range(9):
            model[k] = state[k]
    else:
        manifold.matrix_of(state, model)


def moved(problem, state, step):
    if problem.kind != HOMOGRAPHY:
        return manifold.moved_matrix(state, step)
    new = state.copy()
    for k in range(8):
        new[k] += step[k]
    return new


def equations(problem, state, loss, square_scale, max_square, hessian, gradient):
    if problem.kind == HOMOGRAPHY:
        return _homography_equations(problem.data, state, loss, square_scale, max_square, hessian, gradient)
    model, tangent = np.empty(9), np.empty((hessian.shape[0], 9))
    manifold.matrix_of(state, model)
    manifold.matrix_tangent(state, tangent)
    return epipolar_equations(problem, model, tangent, loss, square_scale, max_square, hessian, gradient)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _add_products(d, weighted, count, square):
    """Adds W d (dᵀ, e) of `count` data, without the part right of the diagonal but for the last column, that of e.

    The rows of `d` (10, count) are those of d and e. Sums in any order are three times as fast.
    """
    for j in range(9):
        for m in range(j + 2):
            k, total = m if m <= j else 9, 0.0
            for i in range(count):
                total += weighted[j, i] * d[k, i]
            square[j, k] += total


@njit(cache=True, nogil=True, error_model="numpy")
def epipolar_equations(problem, m, tangent, loss, square_scale, max_square, hessian, gradient):
    """Adds JᵀWJ and JᵀWr of the epipolar errors of m (9,) to `hessian`, `gradient`; returns Σ ρ(r²).

    `tangent` (dof, 9) holds the derivatives of m by the parameters. With a = J1 ∇1, b = J2 ∇2 and κ = e / |∇|²,
        dr/dM = (r2 (r1 − κ a)ᵀ − κ b r1ᵀ) / |∇|.
    The sums are taken over M, of nine numbers for either matrix, and brought to the parameters at the end.
    """
    data, calibrated = problem.data, problem.kind == ESSENTIAL
    square = np.zeros((9, 10))
    # Derivatives and errors of a block of data, one datum a column, and the derivatives times their weights. The type
    # of the counter has no literals, for which a function would be compiled once more.
    d, weighted, filled = np.empty((10, _BLOCK)), np.empty((9, _BLOCK)), np.int64(0)
    cost = 0.0
    for i in range(data.shape[1] + 1):
        if filled == _BLOCK or i == data.shape[1]:
            _add_products(d, weighted, filled, square)
            filled = np.int64(0)
            if i == data.shape[1]:
                break
        if calibrated:
            x1, y1, z1, x2, y2, z2 = data[0, i], data[1, i], data[2, i], data[3, i], data[4, i], data[5, i]
        else:
            x1, y1, z1, x2, y2, z2 = data[0, i], data[1, i], 1.0, data[2, i], data[3, i], 1.0
        a0 = m[0] * x1 + m[1] * y1 + m[2] * z1
        a1 = m[3] * x1 + m[4] * y1 + m[5] * z1
        a2 = m[6] * x1 + m[7] * y1 + m[8] * z1
        b0 = m[0] * x2 + m[3] * y2 + m[6] * z2
        b1 = m[1] * x2 + m[4] * y2 + m[7] * z2
        b2 = m[2] * x2 + m[5] * y2 + m[8] * z2
        e = a0 * x2 + a1 * y2 + a2 * z2
        if calibrated:
            g0 = b0 * data[6, i] + b1 * data[8, i] + b2 * data[10, i]
            g1 = b0 * data[7, i] + b1 * data[9, i] + b2 * data[11, i]
            g2 = a0 * data[12, i] + a1 * data[14, i] + a2 * data[16, i]
            g3 = a0 * data[13, i] + a1 * data[15, i] + a2 * data[17, i]
        else:
            g0, g1, g2, g3 = b0, b1, a0, a1
        norm = g0 * g0 + g1 * g1 + g2 * g2 + g3 * g3 + 1e-300
        rho, weight = robust_weight(e * e / norm, loss, square_scale, max_square)
        cost += rho
        if weight == 0.0:
            continue
        kappa = e / norm
        weight /= norm
        if calibrated:
            # Back to ray space: κ J1 ∇1 and κ J2 ∇2.
            p0 = kappa * (data[6, i] * g0 + data[7, i] * g1)
            p1 = kappa * (data[8, i] * g0 + data[9, i] * g1)
            p2 = kappa * (data[10, i] * g0 + data[11, i] * g1)
            q0 = kappa * (data[12, i] * g2 + data[13, i] * g3)
            q1 = kappa * (data[14, i] * g2 + data[15, i] * g3)
            q2 = kappa * (data[16, i] * g2 + data[17, i] * g3)
        else:
            p0, p1, p2, q0, q1, q2 = kappa * g0, kappa * g1, 0.0, kappa * g2, kappa * g3, 0.0
        p0, p1, p2 = x1 - p0, y1 - p1, z1 - p2
        for k in range(3):
            left, right = (x2, q0) if k == 0 else (y2, q1) if k == 1 else (z2, q2)
            d[3 * k, filled], d[3 * k + 1, filled] = left * p0 - right * x1, left * p1 - right * y1
            d[3 * k + 2, filled] = left * p2 - right * z1
        for k in range(9):
            weighted[k, filled] = weight * d[k, filled]
        d[9, filled] = e
        filled += 1
    for j in range(9):
        for k in range(j):
            square[k, j] = square[j, k]
    for p in range(tangent.shape[0]):
        for k in range(9):
            gradient[p] += tangent[p, k] * square[k, 9]
            row = 0.0
            for j in range(9):
                row += tangent[p, j] * square[j, k]
            for q in range(p + 1):
                hessian[p, q] += row * tangent[q, k]
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def _homography_equations(data, m, loss, square_scale, max_square, hessian, gradient):
    """The same for a homography with m[8] fixed; (I + A Aᵀ)⁻¹ is taken as constant in the derivative."""
    row0, row1 = np.zeros(8), np.zeros(8)
    cost = 0.0
    for i in range(data.shape[1]):
        x1, y1 = data[0, i], data[1, i]
        w = m[6] * x1 + m[7] * y1 + m[8]
        if not w > 0.0:
            cost += robust_weight(np.inf, loss, square_scale, max_square)[0]
            continue
        w = 1.0 / w
        u, v = (m[0] * x1 + m[1] * y1 + m[2]) * w, (m[3] * x1 + m[4] * y1 + m[5]) * w
        e0, e1 = u - data[2, i], v - data[3, i]
        a, b = (m[0] - u * m[6]) * w, (m[1] - u * m[7]) * w
        c, d = (m[3] - v * m[6]) * w, (m[4] - v * m[7]) * w
        p, q, s = 1.0 + a * a + b * b, a * c + b * d, 1.0 + c * c + d * d
        det = p * s - q * q
        rho, weight = robust_weight(
            (s * e0 * e0 - 2.0 * q * e0 * e1 + p * e1 * e1) / det, loss, square_scale, max_square
        )
        cost += rho
        if weight == 0.0:
            continue
        weight /= det
        row0[0], row0[1], row0[2], row0[6], row0[7] = x1 * w, y1 * w, w, -u * x1 * w, -u * y1 * w
        row1[3], row1[4], row1[5], row1[6], row1[7] = x1 * w, y1 * w, w, -v * x1 * w, -v * y1 * w
        for j in range(8):
            left0 = weight * (s * row0[j] - q * row1[j])
            left1 = weight * (p * row1[j] - q * row0[j])
            gradient[j] += left0 * e0 + left1 * e1
            for k in range(j + 1):
                hessian[j, k] += left0 * row0[k] + left1 * row1[k]
    return cost
