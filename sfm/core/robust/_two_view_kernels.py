"""Squared errors, their normal equations and scores for the matrices of two views.

Errors are first-order geometric (Sampson) distances, in the units of the data, summed over both images. With e the
algebraic error of a correspondence and ∇e its gradient by the coordinates of both keypoints:

    epipolar      e = r2ᵀ M r1                       r² = e² / |∇e|²
    homography    e = x2 − π(H x1),  A = ∂π(H x1)/∂x1     r² = eᵀ (I + A Aᵀ)⁻¹ e

ESSENTIAL holds rays and their derivatives J by the pixel, so that ∇e = (J1ᵀ Eᵀ r2, J2ᵀ E r1): the tangent Sampson
error, in px for any camera model. FUNDAMENTAL and HOMOGRAPHY hold points, r = (x, y, 1) and J = (1 0; 0 1; 0 0).

Data are columns (rows of an array, one column per correspondence):
    ESSENTIAL 18: r1 (3), r2 (3), J1 (3 × 2 by rows), J2 (3 × 2 by rows). Others 4: x1, y1, x2, y2.

References:
    Terekhov & Larsson, Tangent Sampson error, CVPR 2023. Luong & Faugeras, IJCV 1996.
    Chum, Pajdla & Sturm, The geometric error for homographies, CVIU 2005.
"""

from __future__ import annotations

import numpy as np
from numba import njit

ESSENTIAL, FUNDAMENTAL, HOMOGRAPHY = 0, 1, 2
TRUNCATED, CAUCHY = 0, 1
_BLOCK = 64


@njit(cache=True, nogil=True, error_model="numpy")
def squared_errors(problem, data, m, start, stop, out):
    """Fills out[start:stop] with the squared errors of the model m (9,), a matrix by rows."""
    if problem == ESSENTIAL:
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
    elif problem == FUNDAMENTAL:
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
            w = 1.0 / w if w != 0.0 else 1e150
            u, v = (m[0] * x1 + m[1] * y1 + m[2]) * w, (m[3] * x1 + m[4] * y1 + m[5]) * w
            e0, e1 = data[2, i] - u, data[3, i] - v
            a, b = (m[0] - u * m[6]) * w, (m[1] - u * m[7]) * w
            c, d = (m[3] - v * m[6]) * w, (m[4] - v * m[7]) * w
            p, q, s = 1.0 + a * a + b * b, a * c + b * d, 1.0 + c * c + d * d
            out[i] = (s * e0 * e0 - 2.0 * q * e0 * e1 + p * e1 * e1) / (p * s - q * q)


@njit(cache=True, nogil=True, error_model="numpy")
def best_model(problem, data, models, max_square, best_score, squares):
    """The model of the lowest truncated score Σ min(r², max_square) below `best_score`, its score and its inliers.

    The index is −1 if none is better. A model is abandoned as soon as its partial sum is too high.
    """
    n = data.shape[1]
    index, best_inliers = -1, 0
    for k in range(models.shape[0]):
        total, inliers = 0.0, 0
        for start in range(0, n, _BLOCK):
            if not total < best_score:
                break
            stop = min(start + _BLOCK, n)
            squared_errors(problem, data, models[k], start, stop, squares)
            for i in range(start, stop):
                if squares[i] < max_square:
                    total += squares[i]
                    inliers += 1
                else:
                    total += max_square
        if total < best_score:
            index, best_score, best_inliers = k, total, inliers
    return index, best_score, best_inliers


@njit(cache=True, nogil=True, error_model="numpy")
def robust_weight(square, loss, square_scale):
    """ρ and dρ/d(r²) at r² = square: truncated at `square_scale`, or Cauchy's."""
    if loss == TRUNCATED:
        return (square, 1.0) if square < square_scale else (square_scale, 0.0)
    ratio = 1.0 + square / square_scale
    return square_scale * np.log(ratio), 1.0 / ratio


@njit(cache=True, nogil=True, error_model="numpy")
def epipolar_normal_equations(problem, data, m, tangent, loss, square_scale, hessian, gradient):
    """Adds JᵀWJ and JᵀWr of the epipolar errors of m (9,) to `hessian`, `gradient`; returns Σ ρ(r²).

    `tangent` (dof, 9) holds the derivatives of m by the parameters. With a = J1 ∇1, b = J2 ∇2 and κ = e / |∇|²,
        dr/dM = (r2 (r1 − κ a)ᵀ − κ b r1ᵀ) / |∇|.
    """
    dof = tangent.shape[0]
    row = np.empty(dof)
    r, a = np.empty((2, 3)), np.empty((2, 3))
    jacobians = np.zeros((2, 3, 2))
    jacobians[0, 0, 0] = jacobians[0, 1, 1] = jacobians[1, 0, 0] = jacobians[1, 1, 1] = 1.0
    cost = 0.0
    for i in range(data.shape[1]):
        for v in range(2):
            if problem == ESSENTIAL:
                for k in range(3):
                    r[v, k] = data[3 * v + k, i]
                    jacobians[v, k, 0] = data[6 * v + 2 * k + 6, i]
                    jacobians[v, k, 1] = data[6 * v + 2 * k + 7, i]
            else:
                r[v, 0], r[v, 1], r[v, 2] = data[2 * v, i], data[2 * v + 1, i], 1.0
        e, norm = 0.0, 1e-300
        for v in range(2):
            # The line of the other view's ray in this view, its gradient by the pixel, and back to ray space.
            g0, g1 = 0.0, 0.0
            for k in range(3):
                line = 0.0
                for j in range(3):
                    line += (m[3 * j + k] if v == 0 else m[3 * k + j]) * r[1 - v, j]
                if v == 0:
                    e += line * r[0, k]
                g0 += line * jacobians[v, k, 0]
                g1 += line * jacobians[v, k, 1]
            norm += g0 * g0 + g1 * g1
            for k in range(3):
                a[v, k] = jacobians[v, k, 0] * g0 + jacobians[v, k, 1] * g1
        rho, weight = robust_weight(e * e / norm, loss, square_scale)
        cost += rho
        if weight == 0.0:
            continue
        kappa, inverse = e / norm, 1.0 / np.sqrt(norm)
        for p in range(dof):
            row[p] = 0.0
        for j in range(3):
            for k in range(3):
                d = r[1, j] * (r[0, k] - kappa * a[0, k]) - kappa * a[1, j] * r[0, k]
                for p in range(dof):
                    row[p] += d * tangent[p, 3 * j + k]
        for p in range(dof):
            jacobian = weight * inverse * row[p]
            gradient[p] += jacobian * e * inverse
            for q in range(p + 1):
                hessian[p, q] += jacobian * inverse * row[q]
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def homography_normal_equations(data, m, loss, square_scale, hessian, gradient):
    """The same for a homography with m[8] fixed; (I + A Aᵀ)⁻¹ is taken as constant in the derivative."""
    row0, row1 = np.zeros(8), np.zeros(8)
    cost = 0.0
    for i in range(data.shape[1]):
        x1, y1 = data[0, i], data[1, i]
        w = m[6] * x1 + m[7] * y1 + m[8]
        w = 1.0 / w if w != 0.0 else 1e150
        u, v = (m[0] * x1 + m[1] * y1 + m[2]) * w, (m[3] * x1 + m[4] * y1 + m[5]) * w
        e0, e1 = u - data[2, i], v - data[3, i]
        a, b = (m[0] - u * m[6]) * w, (m[1] - u * m[7]) * w
        c, d = (m[3] - v * m[6]) * w, (m[4] - v * m[7]) * w
        p, q, s = 1.0 + a * a + b * b, a * c + b * d, 1.0 + c * c + d * d
        det = p * s - q * q
        rho, weight = robust_weight((s * e0 * e0 - 2.0 * q * e0 * e1 + p * e1 * e1) / det, loss, square_scale)
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
