"""The image of a crossing of two edges, fitted to pixels.

Two straight edges of a board cross at c; seen through a lens of Gaussian blur s they are

    I(x) = μ + g·d + α erf(u1 / √2 s) erf(u2 / √2 s),      d = x − c,   u_k = n_k·d + ½ κ_k ((t_k·d)² + s²),

n_k the unit normal of edge k at angle θ_k, t_k its direction, κ_k its curvature in the image (what distortion makes of
a straight line: without it, the crossing would be drawn inwards by κ r² / 6). Blur moves a bent edge inwards by ½ κ s²:
on its outer side there is less to be spread. The eleven parameters are
(cx, cy, θ1, θ2, s, μ, α, gx, gy, κ1, κ2).

Seen from the crossing, what g and κ do to the image is odd, as is what a shift of c does; the rest is even. In a small
window these four are therefore nearly all that makes c uncertain, while the neighbours of a crossing know them well. So
they may be given expected values e_k with weights w_k, and Σ w_k (p_k − e_k)² is added to the squared residuals.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

PARAMETERS = 11
EXPECTED = 7
"""The first of the four parameters that may be expected to have some value."""
_DAMPING_START = 1e-3
_DAMPING_LIMIT = 1e8
_SHARPEST_PX = 0.2
"""Blur below which the pixels, themselves a blur of 0.29, cannot tell."""
_SETTLED_PX = 1e-4
_ROOT_2 = math.sqrt(2.0)
_SLOPE_AT_EDGE = math.sqrt(2.0 / math.pi)


@njit(cache=True, nogil=True)
def _edge(nx, ny, curvature, blur, dx, dy):
    """erf(u / √2 s) of one edge, its derivative by u, and that by blur, x, y, angle and curvature over it."""
    across, along = nx * dx + ny * dy, nx * dy - ny * dx
    square = along * along + blur * blur
    reach = across + 0.5 * curvature * square
    z = reach / (_ROOT_2 * blur)
    slope = _SLOPE_AT_EDGE / blur * math.exp(-z * z)
    by_x, by_y = nx - curvature * along * ny, ny + curvature * along * nx
    by_blur = curvature * blur - reach / blur
    return math.erf(z), slope, by_blur, by_x, by_y, along - curvature * along * across, 0.5 * square


@njit(cache=True, nogil=True)
def crossing_model(p, nx1, ny1, nx2, ny2, dx, dy, jacobian):
    """Intensity at an offset (dx, dy) from the crossing, and its derivative by the parameters.

    n1 and n2 are the normals, (cos θ, sin θ) of p[2] and p[3].
    """
    value1, slope1, by_blur1, by_x1, by_y1, by_angle1, by_bow1 = _edge(nx1, ny1, p[9], p[4], dx, dy)
    value2, slope2, by_blur2, by_x2, by_y2, by_angle2, by_bow2 = _edge(nx2, ny2, p[10], p[4], dx, dy)
    left, right = p[6] * slope1 * value2, p[6] * slope2 * value1
    jacobian[0] = -(left * by_x1 + right * by_x2) - p[7]
    jacobian[1] = -(left * by_y1 + right * by_y2) - p[8]
    jacobian[2] = left * by_angle1
    jacobian[3] = right * by_angle2
    jacobian[4] = left * by_blur1 + right * by_blur2
    jacobian[5] = 1.0
    jacobian[6] = value1 * value2
    jacobian[7] = dx
    jacobian[8] = dy
    jacobian[9] = left * by_bow1
    jacobian[10] = right * by_bow2
    return p[5] + p[7] * dx + p[8] * dy + p[6] * value1 * value2


@njit(cache=True, nogil=True)
def _normal_equations(xs, ys, grey, count, expected, weights, p, matrix, vector):
    """JᵀJ (its lower triangle), Jᵀr and the sum of squared residuals, of the pixels and of what was expected."""
    jacobian = np.empty(PARAMETERS)
    matrix[:] = 0.0
    vector[:] = 0.0
    cost = 0.0
    nx1, ny1, nx2, ny2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    for i in range(count):
        residual = crossing_model(p, nx1, ny1, nx2, ny2, xs[i] - p[0], ys[i] - p[1], jacobian) - grey[i]
        cost += residual * residual
        for a in range(PARAMETERS):
            vector[a] += jacobian[a] * residual
            for b in range(a + 1):
                matrix[a, b] += jacobian[a] * jacobian[b]
    for k in range(len(weights)):
        a = EXPECTED + k
        off = p[a] - expected[k]
        matrix[a, a] += weights[k]
        vector[a] += weights[k] * off
        cost += weights[k] * off * off
    return cost


@njit(cache=True, nogil=True)
def _factor(matrix, damping, low):
    """Cholesky factor of the lower triangle of `matrix` with its diagonal raised; False where it has none."""
    size = len(matrix)
    for a in range(size):
        for b in range(a + 1):
            total = matrix[a, b] * (1.0 + damping) if a == b else matrix[a, b]
            for c in range(b):
                total -= low[a, c] * low[b, c]
            if a == b:
                if not total > 1e-14 * matrix[a, a]:
                    return False
                low[a, a] = math.sqrt(total)
            else:
                low[a, b] = total / low[b, b]
    return True


@njit(cache=True, nogil=True)
def _solve(low, vector, out):
    size = len(vector)
    for a in range(size):
        total = vector[a]
        for c in range(a):
            total -= low[a, c] * out[c]
        out[a] = total / low[a, a]
    for a in range(size - 1, -1, -1):
        total = out[a]
        for c in range(a + 1, size):
            total -= low[c, a] * out[c]
        out[a] = total / low[a, a]


@njit(cache=True, nogil=True)
def _gather(image, x, y, window, xs, ys, grey):
    """The pixels whose centres d = (px, py) − (x, y) have |window d| ≤ 1; their number, −1 if they are cut off."""
    height, width = image.shape
    det = window[0, 0] * window[1, 1] - window[0, 1] * window[1, 0]
    half_x = math.sqrt(window[0, 1] ** 2 + window[1, 1] ** 2) / abs(det)
    half_y = math.sqrt(window[0, 0] ** 2 + window[1, 0] ** 2) / abs(det)
    left, right = math.floor(x - half_x), math.ceil(x + half_x)
    top, bottom = math.floor(y - half_y), math.ceil(y + half_y)
    if not (x >= 0.0 and y >= 0.0 and x <= width and y <= height):
        return -1
    count = missing = 0
    for row in range(top, bottom):
        for column in range(left, right):
            dx, dy = column + 0.5 - x, row + 0.5 - y
            u = window[0, 0] * dx + window[0, 1] * dy
            v = window[1, 0] * dx + window[1, 1] * dy
            if u * u + v * v > 1.0:
                continue
            if row < 0 or column < 0 or row >= height or column >= width:
                missing += 1
            elif count < len(xs):
                xs[count], ys[count], grey[count] = column + 0.5, row + 0.5, image[row, column]
                count += 1
    return -1 if missing > count // 4 else count


@njit(cache=True, nogil=True)
def _descend(xs, ys, grey, count, expected, weights, p, iterations):
    """Levenberg–Marquardt from `p`, in place; the final cost, NaN where the pixels do not determine the parameters."""
    matrix, low = np.zeros((PARAMETERS, PARAMETERS)), np.zeros((PARAMETERS, PARAMETERS))
    vector, step, trial = np.zeros(PARAMETERS), np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    trial_matrix, trial_vector = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    damping = _DAMPING_START
    cost = _normal_equations(xs, ys, grey, count, expected, weights, p, matrix, vector)
    for _ in range(iterations):
        if not _factor(matrix, damping, low):
            damping *= 10.0
            if damping > _DAMPING_LIMIT:
                return math.nan
            continue
        _solve(low, vector, step)
        for a in range(PARAMETERS):
            trial[a] = p[a] - step[a]
        trial[4] = max(min(max(trial[4], 0.5 * p[4]), 2.0 * p[4]), _SHARPEST_PX)
        new = _normal_equations(xs, ys, grey, count, expected, weights, trial, trial_matrix, trial_vector)
        if new < cost:
            settled = math.hypot(trial[0] - p[0], trial[1] - p[1]) < _SETTLED_PX and cost - new < 1e-4 * cost
            # Copies by whole slices would compile numba's message for shapes that differ: three seconds.
            for a in range(PARAMETERS):
                p[a], vector[a] = trial[a], trial_vector[a]
                for b in range(PARAMETERS):
                    matrix[a, b] = trial_matrix[a, b]
            cost = new
            damping = max(damping * 0.1, 1e-9)
            if settled:
                break
        else:
            damping *= 10.0
            if damping > _DAMPING_LIMIT:
                break
    return cost


@njit(cache=True, nogil=True)
def _covariance(xs, ys, grey, count, expected, weights, p, square, out):
    """Rows of the parameters' covariance that belong to the crossing, by the sum of squares; False where there is none.

    A parameter takes away a degree of freedom as far as it is told by the pixels and not by what was expected of it.
    """
    matrix, low = np.zeros((PARAMETERS, PARAMETERS)), np.zeros((PARAMETERS, PARAMETERS))
    vector, column = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    _normal_equations(xs, ys, grey, count, expected, weights, p, matrix, vector)
    if not _factor(matrix, 0.0, low):
        return False
    freedom = float(count - PARAMETERS)
    for k in range(len(weights)):
        vector[:] = 0.0
        vector[EXPECTED + k] = 1.0
        _solve(low, vector, column)
        freedom += weights[k] * column[EXPECTED + k]
    variance = square / max(freedom, 1.0)
    for k in range(2):
        vector[:] = 0.0
        vector[k] = 1.0
        _solve(low, vector, column)
        out[k, 0], out[k, 1] = variance * column[0], variance * column[1]
    return True


@njit(cache=True, nogil=True)
def fit_crossings(image, windows, capacity, expected, weights, starts, shapes, covariances, fitted):
    """Fits every crossing; NaN where the pixels are cut off by the border or do not show one.

    `starts` holds cx, cy, θ1, θ2 and either s > 0 and the rest, or nothing more; `fitted` receives the root mean square
    of the pixels' residuals.
    """
    xs, ys, grey = np.empty(capacity), np.empty(capacity), np.empty(capacity)
    for i in range(len(starts)):
        shapes[i] = math.nan
        covariances[i] = math.nan
        fitted[i] = math.nan
        p = starts[i].copy()
        cost = math.nan
        count = 0
        for attempt in range(3):
            count = _gather(image, p[0], p[1], windows[i], xs, ys, grey)
            if count < 2 * PARAMETERS:
                cost = math.nan
                break
            if attempt == 0 and not p[4] > 0.0:
                _start(xs, ys, grey, count, p)
            before_x, before_y = p[0], p[1]
            cost = _descend(xs, ys, grey, count, expected[i], weights[i], p, 40)
            if not cost >= 0.0 or math.hypot(p[0] - before_x, p[1] - before_y) < 0.25:
                break
        for k in range(len(weights[i])):
            cost -= weights[i, k] * (p[EXPECTED + k] - expected[i, k]) ** 2
        if cost >= 0.0 and _covariance(xs, ys, grey, count, expected[i], weights[i], p, cost, covariances[i]):
            shapes[i] = p
            fitted[i] = math.sqrt(cost / count)


@njit(cache=True, nogil=True)
def _start(xs, ys, grey, count, p):
    """Blur of a third of the window, so that the descent sees the edges from afar; mean and contrast of the pixels."""
    jacobian = np.empty(PARAMETERS)
    mean = 0.0
    reach = 0.0
    for i in range(count):
        mean += grey[i]
        reach = max(reach, abs(xs[i] - p[0]), abs(ys[i] - p[1]))
    mean /= count
    p[4], p[5], p[6] = max(0.3 * reach, 0.7), 0.0, 1.0
    p[7] = p[8] = p[9] = p[10] = 0.0
    shape = energy = 0.0
    nx1, ny1, nx2, ny2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    for i in range(count):
        crossing_model(p, nx1, ny1, nx2, ny2, xs[i] - p[0], ys[i] - p[1], jacobian)
        shape += jacobian[6] * (grey[i] - mean)
        energy += jacobian[6] * jacobian[6]
    p[5] = mean
    p[6] = shape / max(energy, 1e-12)
