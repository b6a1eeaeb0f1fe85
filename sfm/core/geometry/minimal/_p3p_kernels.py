"""Poses of a camera from three rays to known points.

With depths d along unit rays f, the law of cosines gives for each pair of points opposite to k (indices modulo 3)

    d_i² + d_j² − 2 c_k d_i d_j = a_k,    i = k + 1, j = k + 2,    c_k = f_i · f_j,    a_k = |X_i − X_j|²,

or dᵀ M_k d = a_k. The combinations C1 = a0 M2 − a2 M0 and C2 = a0 M1 − a1 M0, free of the constant term, are conics
in (d0 : d1 : d2) that meet in the solutions. A root s of the cubic det(C1 + s C2) = 0 makes D = C1 + s C2 a pair of
lines. With p pᵀ = −adj D, the matrix D + [p]× has rank one: one of its rows and one of its columns are the lines.
Each meets a conic in at most two points. The depths are polished by Newton steps on the three quadratics.

Reference:
    Ding, Yang, Larsson, Olsson & Åström, Revisiting the P3P problem, CVPR 2023, for the line pair;
    Persson & Nordberg, Lambda Twist, ECCV 2018, for the polish.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.core.geometry.minimal._cubic_kernels import cubic_roots

MAX_SOLUTIONS = 4
_POLISH_STEPS = 3


@njit(cache=True, nogil=True, error_model="numpy")
def _adjugate(m, out):
    """Fills `out` with the adjugate of a 3 × 3 matrix and returns the determinant."""
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            out[j, i] = m[a, c] * m[b, d] - m[a, d] * m[b, c]
    return m[0, 0] * out[0, 0] + m[0, 1] * out[1, 0] + m[0, 2] * out[2, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _conics(cosines, squares, conics):
    """Fills `conics` (2, 3, 3) with C1 and C2, divided by the largest square."""
    for n in range(2):
        for i in range(3):
            for j in range(3):
                conics[n, i, j] = 0.0
    unit = max(squares[0], squares[1], squares[2])
    for n in range(2):
        other = 2 - n
        for k in (0, other):
            i, j = (k + 1) % 3, (k + 2) % 3
            factor = (squares[0] if k == other else -squares[other]) / unit
            conics[n, i, i] += factor
            conics[n, j, j] += factor
            conics[n, i, j] -= factor * cosines[k]
            conics[n, j, i] -= factor * cosines[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _line_pair(conics, d, lines, adjugate, cubic, roots):
    """Fills `lines` with the best conditioned real line pair of the pencil; returns its parameter s, or NaN.

    `d` and what comes after `lines` is scratch, here and below: taking memory for it costs as much as the solution.
    """
    cubic[1] = cubic[2] = 0.0
    for n in range(2):
        cubic[3 * n] = _adjugate(conics[n], adjugate)
        for i in range(3):
            for j in range(3):
                cubic[1 + n] += adjugate[i, j] * conics[1 - n, j, i]
    best, s, axis = 0.0, np.nan, 0
    count = cubic_roots(cubic, roots)
    for n in range(count + 1):
        root = roots[n] if n < count else s
        for i in range(3):
            for j in range(3):
                d[i, j] = conics[0, i, j] + root * conics[1, i, j]
        _adjugate(d, adjugate)
        if n < count:
            for i in range(3):
                quality = -adjugate[i, i] / (1.0 + root * root)
                if quality > best:
                    best, s, axis = quality, root, i
    if best == 0.0:
        return np.nan
    scale = -1.0 / np.sqrt(-adjugate[axis, axis])
    row, column = 0, 0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        p = scale * adjugate[i, axis]
        d[j, k] -= p
        d[k, j] += p
    for i in range(3):
        for j in range(3):
            if abs(d[i, j]) > abs(d[row, column]):
                row, column = i, j
    for i in range(3):
        lines[0, i], lines[1, i] = d[row, i], d[i, column]
    return s


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(line, conic, out):
    """Fills the rows of `out` with the points, up to scale, of a line on a conic; returns how many."""
    k = 0
    for i in range(1, 3):
        if abs(line[i]) > abs(line[k]):
            k = i
    if line[k] == 0:
        return 0
    i, j = (k + 1) % 3, (k + 2) % 3
    # d_k = p d_i + q d_j on the line; on it the conic is a τ² + 2 b τ + c with τ = d_i / d_j.
    p, q = -line[i] / line[k], -line[j] / line[k]
    square, cross_i, cross_j = conic[k, k], conic[i, k], conic[j, k]
    a = conic[i, i] + p * (2 * cross_i + p * square)
    b = conic[i, j] + q * cross_i + p * cross_j + p * q * square
    c = conic[j, j] + q * (2 * cross_j + q * square)
    discriminant = b * b - a * c
    if not discriminant >= 0:
        return 0
    root = np.sqrt(discriminant)
    t = -b - root if b > 0 else -b + root
    # The roots are (t : a) and (c : t), both free of cancellation.
    out[0, i], out[0, j], out[0, k] = t, a, p * t + q * a
    out[1, i], out[1, j], out[1, k] = c, t, p * c + q * t
    return 2


@njit(cache=True, nogil=True, error_model="numpy")
def _scale_and_polish(d, cosines, squares, residual, by_i, by_j):
    """Scales depths to the size of the triangle, then Newton steps on the laws of cosines; False if one is not > 0."""
    size = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        size += d[i] * d[i] + d[j] * d[j] - 2 * cosines[k] * d[i] * d[j]
    scale = np.sqrt((squares[0] + squares[1] + squares[2]) / size) if size > 0 else np.nan
    if d[0] + d[1] + d[2] < 0:
        scale = -scale
    for k in range(3):
        d[k] *= scale
    for _ in range(_POLISH_STEPS):
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            by_i[k], by_j[k] = d[i] - cosines[k] * d[j], d[j] - cosines[k] * d[i]
            residual[k] = 0.5 * (by_i[k] * d[i] + by_j[k] * d[j] - squares[k])
        # Row k of the Jacobian has entries in the columns k + 1 and k + 2 only: Cramer's rule is short.
        det = by_i[0] * by_i[1] * by_i[2] + by_j[0] * by_j[1] * by_j[2]
        if det == 0:
            return False
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            step = by_i[i] * by_i[k] * residual[j] + by_j[k] * by_j[j] * residual[i] - by_i[i] * by_j[j] * residual[k]
            d[k] -= step / det
    return d[0] > 0 and d[1] > 0 and d[2] > 0


@njit(cache=True, nogil=True, error_model="numpy")
def _frame(x, axes):
    """Fills the rows of `axes` with a right-handed frame of the triangle x (rows); False for a degenerate one."""
    for i in range(3):
        axes[0, i], axes[1, i] = x[1, i] - x[0, i], x[2, i] - x[0, i]
    u, v, w = 0.0, 0.0, 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        axes[2, i] = axes[0, j] * axes[1, k] - axes[0, k] * axes[1, j]
        u += axes[0, i] * axes[0, i]
        v += axes[1, i] * axes[1, i]
        w += axes[2, i] * axes[2, i]
    if not w > 1e-20 * u * v:
        return False
    for i in range(3):
        axes[0, i] /= np.sqrt(u)
        axes[2, i] /= np.sqrt(w)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        axes[1, i] = axes[2, j] * axes[0, k] - axes[2, k] * axes[0, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def p3p(data, samples, poses):
    """Fills the rows of `poses` (4 B, 12), R by rows then t, with the `cam_from_world` of samples; returns how many.

    Columns of `data` hold a unit ray in the rows 0 … 2 and its point in the rows 9 … 11; rows of `samples` (B, 3) name
    columns. All depths along the rays are positive. Collinear points have no solution.
    """
    rays, points, seen = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    world, cam = np.empty((3, 3)), np.empty((3, 3))
    d, lines, depths = np.empty((3, 3)), np.empty((2, 3)), np.empty((2, 3))
    cosines, squares, conics = np.empty(3), np.empty(3), np.empty((2, 3, 3))
    adjugate, cubic, roots = np.empty((3, 3)), np.empty(4), np.empty(10)
    residual, by_i, by_j = np.empty(3), np.empty(3), np.empty(3)
    count = 0
    for sample in range(samples.shape[0]):
        for i in range(3):
            for m in range(3):
                rays[i, m], points[i, m] = data[m, samples[sample, i]], data[9 + m, samples[sample, i]]
        if not _frame(points, world):
            continue
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            cosines[k] = squares[k] = 0.0
            for m in range(3):
                cosines[k] += rays[i, m] * rays[j, m]
                squares[k] += (points[i, m] - points[j, m]) * (points[i, m] - points[j, m])
        _conics(cosines, squares, conics)
        s = _line_pair(conics, d, lines, adjugate, cubic, roots)
        if not abs(s) < np.inf:
            continue
        for line in range(2):
            for n in range(_meet(lines[line], conics[1 if abs(s) < 1 else 0], depths)):
                if not _scale_and_polish(depths[n], cosines, squares, residual, by_i, by_j):
                    continue
                for i in range(3):
                    for j in range(3):
                        seen[i, j] = depths[n, i] * rays[i, j]
                if not _frame(seen, cam):
                    continue
                for i in range(3):
                    moved = 0.0
                    for j in range(3):
                        r = cam[0, i] * world[0, j] + cam[1, i] * world[1, j] + cam[2, i] * world[2, j]
                        poses[count, 3 * i + j] = r
                        moved += r * points[0, j]
                    poses[count, 9 + i] = seen[0, i] - moved
                count += 1
    return count
