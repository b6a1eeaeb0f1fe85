"""Homographies of many views and the poses that follow from them; the mathematics is in `zhang`.

Flat columns: the observations of view v are rows `offsets[v]:offsets[v + 1]`, and `rows` names their board points.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_FLOOR = 1e-3
"""Least error, over the spread of a view's points, that a weight of the least absolute errors is taken from."""


@njit(cache=True, nogil=True, error_model="numpy")
def fit_homographies(offsets, rows, board, points, used, passes, homographies, errors, spreads):
    """Fills the homographies (V, 3, 3), board (x, y, 1) → points, and their rms errors (V,); NaN where there is none.

    `spreads` (V,) become the root mean squared distances of points from their centroids. Only observations that are
    `used` count. Beyond the first pass points have the weights of least absolute errors.
    """
    weights = np.ones(len(points))
    for view in range(len(offsets) - 1):
        first, last = offsets[view], offsets[view + 1]
        weights[first:last] = 1.0
        for _ in range(passes):
            errors[view], spreads[view] = _fit_one(first, last, rows, board, points, used, weights, homographies[view])


@njit(cache=True, nogil=True, error_model="numpy")
def poses_from_rays(offsets, rows, board, rays, used, passes, rotations, translations, errors):
    """Fills the poses `cam_from_board` of the homographies of rays, and the rms of their errors as tangents of angles.

    Each view is looked at along the mean of its rays, so that rays beyond 90° from the axis do no harm.
    """
    seen, weights, frame, h = np.empty((len(rays), 2)), np.ones(len(rays)), np.empty((3, 3)), np.empty((3, 3))
    ahead = used.copy()
    for view in range(len(offsets) - 1):
        first, last = offsets[view], offsets[view + 1]
        _look_at_mean(first, last, rays, used, frame)
        for n in range(first, last):
            z = frame[2, 0] * rays[n, 0] + frame[2, 1] * rays[n, 1] + frame[2, 2] * rays[n, 2]
            ahead[n] = used[n] and z > 0.05
            for k in range(2):
                along = frame[k, 0] * rays[n, 0] + frame[k, 1] * rays[n, 1] + frame[k, 2] * rays[n, 2]
                seen[n, k] = along / z if ahead[n] else 0.0
        weights[first:last] = 1.0
        for _ in range(passes):
            errors[view], _ = _fit_one(first, last, rows, board, seen, ahead, weights, h)
        _pose(h, frame, rotations[view], translations[view])


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_one(first, last, rows, board, points, used, weights, h):
    """Normalised linear fit with h33 = 1 about the centroids: (rms error, spread of the points); renews the weights."""
    count, cx, cy, cu, cv = 0, 0.0, 0.0, 0.0, 0.0
    for n in range(first, last):
        if used[n]:
            p = rows[n]
            count += 1
            cx, cy, cu, cv = cx + board[p, 0], cy + board[p, 1], cu + points[n, 0], cv + points[n, 1]
    h[:] = math.nan
    if count < 4:
        return math.nan, math.nan
    cx, cy, cu, cv = cx / count, cy / count, cu / count, cv / count
    board_spread, image_spread = 0.0, 0.0
    for n in range(first, last):
        if used[n]:
            p = rows[n]
            board_spread += (board[p, 0] - cx) ** 2 + (board[p, 1] - cy) ** 2
            image_spread += (points[n, 0] - cu) ** 2 + (points[n, 1] - cv) ** 2
    a, b = math.sqrt(2.0 * count / board_spread), math.sqrt(2.0 * count / image_spread)
    # Sums of (1, u, v, u² + v²) times the products xx, xy, x, yy, y, 1.
    sums = np.zeros((4, 6))
    for n in range(first, last):
        if not used[n]:
            continue
        p, w = rows[n], weights[n]
        x, y, u, v = a * (board[p, 0] - cx), a * (board[p, 1] - cy), b * (points[n, 0] - cu), b * (points[n, 1] - cv)
        for k, factor in enumerate((w, w * u, w * v, w * (u * u + v * v))):
            sums[k, 0] += factor * x * x
            sums[k, 1] += factor * x * y
            sums[k, 2] += factor * x
            sums[k, 3] += factor * y * y
            sums[k, 4] += factor * y
            sums[k, 5] += factor
    normal = np.zeros((9, 9))
    _fill_normal(sums, normal)
    spread = math.sqrt(image_spread / count)
    if not _solve8(normal):
        return math.nan, spread
    g = normal[8]
    error = _errors(first, last, rows, board, points, used, a, b, cx, cy, cu, cv, g, weights)
    # h = T_image⁻¹ G T_board
    g0, g1, g2 = a * g[0], a * g[1], g[2] - a * (g[0] * cx + g[1] * cy)
    g3, g4, g5 = a * g[3], a * g[4], g[5] - a * (g[3] * cx + g[4] * cy)
    g6, g7, g8 = a * g[6], a * g[7], 1.0 - a * (g[6] * cx + g[7] * cy)
    h[0, 0], h[0, 1], h[0, 2] = g0 / b + cu * g6, g1 / b + cu * g7, g2 / b + cu * g8
    h[1, 0], h[1, 1], h[1, 2] = g3 / b + cv * g6, g4 / b + cv * g7, g5 / b + cv * g8
    h[2, 0], h[2, 1], h[2, 2] = g6, g7, g8
    return math.sqrt(error / count) / b, spread


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_normal(sums, normal):
    """The lower triangle for the rows (x, y, 1, 0, 0, 0, −ux, −uy | u) and (0, 0, 0, x, y, 1, −vx, −vy | v)."""
    at = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
    for i in range(3):
        for j in range(3):
            k = at[i][j]
            if j <= i:
                normal[i, j] = normal[3 + i, 3 + j] = sums[0, k]
            # The right-hand side has the sign of u itself.
            sign = 1.0 if i == 2 else -1.0
            normal[6 + i, j], normal[6 + i, 3 + j] = sign * sums[1, k], sign * sums[2, k]
            if j <= i:
                normal[6 + i, 6 + j] = sums[3, k] * (-1.0 if i == 2 and j < 2 else 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _errors(first, last, rows, board, points, used, a, b, cx, cy, cu, cv, g, weights):
    """Sum of squared errors in normalised coordinates; weights become those of least absolute errors of the next."""
    total = 0.0
    for n in range(first, last):
        if used[n]:
            p = rows[n]
            x, y = a * (board[p, 0] - cx), a * (board[p, 1] - cy)
            q = 1.0 / (g[6] * x + g[7] * y + 1.0)
            du = (g[0] * x + g[1] * y + g[2]) * q - b * (points[n, 0] - cu)
            dv = (g[3] * x + g[4] * y + g[5]) * q - b * (points[n, 1] - cv)
            error = du * du + dv * dv
            total += error
            weights[n] = q * q / max(math.sqrt(error), _FLOOR)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _solve8(normal):
    """Cholesky of the leading 8 × 8 block in place; row 8 becomes the solution. False where it is not definite."""
    for j in range(9):
        for k in range(j):
            s = normal[j, k]
            for m in range(k):
                s -= normal[j, m] * normal[k, m]
            normal[j, k] = s / normal[k, k]
        if j < 8:
            pivot = normal[j, j]
            s = pivot
            for m in range(j):
                s -= normal[j, m] * normal[j, m]
            if not s > 1e-12 * pivot:
                return False
            normal[j, j] = math.sqrt(s)
    for j in range(7, -1, -1):
        s = normal[8, j]
        for m in range(j + 1, 8):
            s -= normal[m, j] * normal[8, m]
        normal[8, j] = s / normal[j, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _look_at_mean(first, last, rays, used, frame):
    """Rows of a rotation whose third is along the sum of the rays."""
    x, y, z = 0.0, 0.0, 0.0
    for n in range(first, last):
        if used[n]:
            x, y, z = x + rays[n, 0], y + rays[n, 1], z + rays[n, 2]
    norm = math.sqrt(x * x + y * y + z * z)
    if not norm > 0.0:
        x, y, z, norm = 0.0, 0.0, 1.0, 1.0
    x, y, z = x / norm, y / norm, z / norm
    # The shortest turn from the third axis; opposite to it any half turn will do.
    if z > -0.9:
        q = 1.0 / (1.0 + z)
        frame[0, 0], frame[0, 1], frame[0, 2] = 1.0 - x * x * q, -x * y * q, -x
        frame[1, 0], frame[1, 1], frame[1, 2] = -x * y * q, 1.0 - y * y * q, -y
    else:
        q = 1.0 / (1.0 - z)
        frame[0, 0], frame[0, 1], frame[0, 2] = 1.0 - x * x * q, -x * y * q, x
        frame[1, 0], frame[1, 1], frame[1, 2] = x * y * q, y * y * q - 1.0, -y
    frame[2, 0], frame[2, 1], frame[2, 2] = x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def _pose(h, frame, R, t):
    """R = [r1 r2 r1 × r2] and t of a calibrated homography seen in `frame`; it is positive at the board's centre."""
    n1 = math.sqrt(h[0, 0] ** 2 + h[1, 0] ** 2 + h[2, 0] ** 2)
    n2 = math.sqrt(h[0, 1] ** 2 + h[1, 1] ** 2 + h[2, 1] ** 2)
    scale = 2.0 / (n1 + n2)
    # Of the orthonormal pairs the nearest to two unit vectors has the same bisectors.
    r1, r2 = np.empty(3), np.empty(3)
    plus, minus = 0.0, 0.0
    for k in range(3):
        r1[k], r2[k] = h[k, 0] / n1 + h[k, 1] / n2, h[k, 0] / n1 - h[k, 1] / n2
        plus, minus = plus + r1[k] ** 2, minus + r2[k] ** 2
    plus, minus = 1.0 / math.sqrt(2.0 * plus), 1.0 / math.sqrt(2.0 * minus)
    for k in range(3):
        p, m = r1[k] * plus, r2[k] * minus
        r1[k], r2[k] = p + m, p - m
    r3 = (r1[1] * r2[2] - r1[2] * r2[1], r1[2] * r2[0] - r1[0] * r2[2], r1[0] * r2[1] - r1[1] * r2[0])
    for k in range(3):
        R[k, 0] = frame[0, k] * r1[0] + frame[1, k] * r1[1] + frame[2, k] * r1[2]
        R[k, 1] = frame[0, k] * r2[0] + frame[1, k] * r2[1] + frame[2, k] * r2[2]
        R[k, 2] = frame[0, k] * r3[0] + frame[1, k] * r3[1] + frame[2, k] * r3[2]
        t[k] = scale * (frame[0, k] * h[0, 2] + frame[1, k] * h[1, 2] + frame[2, k] * h[2, 2])
