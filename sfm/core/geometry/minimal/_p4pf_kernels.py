"""Poses and the focal length of a camera from four points.

The projection matrix P = diag(f, f, 1) (R | t), with rows (p_k, t_k), fulfils two linear equations for a point X seen
at (u, v) from the principal point,

    u (p_3 · X + t_3) = p_1 · X + t_1,    v (p_3 · X + t_3) = p_2 · X + t_2.

Four points, on a plane or not, leave P = Σ g_k P_k with four unknown factors g, in which

    p_1 · p_2 = p_1 · p_3 = p_2 · p_3 = 0,    p_1 · p_1 = p_2 · p_2

are quadratic. Two of these (p_1 · p_2, p_1 · p_1) and a mixture of the others meet in eight points g at most: of the
choices tried this one is the best for points on a plane, and as good as any for others. With two of the factors as
x, y and the ratio of the others as z they give x², xy and y² as linear forms of x, y and 1 whose coefficients are
polynomials of z. Then x (xy) = y (x²), y (xy) = x (y²) and (xy)² = x² y² are linear in x and y too,
B(z) (x, y, 1)ᵀ = 0, and det B(z) has degree eight. Gauss–Newton steps on all four quadrics share out the error of the
eighth equation.

References:
    Larsson, Kukelova & Zheng, Making minimal solvers for absolute pose estimation compact and robust, ICCV 2017.
    Kukelova, Heller & Fitzgibbon, Efficient intersection of three quadrics and applications in computer vision,
    CVPR 2016.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.core.geometry.minimal._linear_kernels import nullspace, solve
from sfm.core.geometry.minimal._polynomial_kernels import determinant, null_vector, real_roots

MAX_SOLUTIONS = 8
_POLISH_STEPS = 5
# Of the square of a step, after which another would change nothing, with exact data, or little, with noise.
_AT_REST = 1e-9
_ROTATION_STEPS = 4
_SMALLEST_DETERMINANT = 0.1
_MAX_ASPECT = 2.0
# The pairs of factors that may be x and y, and the others.
_CHARTS = np.array([(0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 0, 2), (2, 3, 0, 1)])
# A turn of the basis: at points on a plane the two mirrored solutions could else have the same z.
_TURN = np.eye(4) - np.outer([1, 3, 5, 7], [1, 3, 5, 7]) / 42.0
# A turn of the image, so that no axis of it plays a part of its own in the equations that are solved.
_COS, _SIN = 0.8, 0.6


@njit(cache=True, nogil=True, error_model="numpy")
def _projections(data, sample, basis):
    """Fills `basis` (4, 12), matrices by rows, with what projects four points, centred and scaled; (center, scale)."""
    equations, center = np.zeros((8, 12)), np.zeros(3)
    for p in range(4):
        for j in range(3):
            center[j] += 0.25 * data[2 + j, sample[p]]
    total = 0.0
    for p in range(4):
        for j in range(3):
            total += (data[2 + j, sample[p]] - center[j]) ** 2
    scale = np.sqrt(4.0 / total)
    for p in range(4):
        for n in range(2):
            for j in range(4):
                x = scale * (data[2 + j, sample[p]] - center[j]) if j < 3 else 1.0
                equations[2 * p + n, 4 * n + j] = x
                equations[2 * p + n, 8 + j] = -x * data[n, sample[p]]
    if not (scale < np.inf and nullspace(equations, basis)):
        return center, np.nan
    column = np.empty(4)
    for k in range(12):
        for i in range(4):
            column[i] = basis[i, k]
        for i in range(4):
            basis[i, k] = 0.0
            for j in range(4):
                basis[i, k] += _TURN[i, j] * column[j]
    return center, scale


@njit(cache=True, nogil=True, error_model="numpy")
def _quadrics(basis, q):
    """Fills q (4, 4, 4) with the symmetric forms of the four constraints in the factors of `basis`."""
    q[:] = 0.0
    for k in range(4):
        for m in range(4):
            for j in range(3):
                a, b, c = basis[k, j], basis[k, 4 + j], basis[k, 8 + j]
                d, e, f = basis[m, j], basis[m, 4 + j], basis[m, 8 + j]
                q[0, k, m] += 0.5 * (a * e + b * d)
                q[1, k, m] += 0.5 * (a * d - b * e)
                q[2, k, m] += 0.5 * ((_COS * a + _SIN * b) * f + c * (_COS * d + _SIN * e))
                q[3, k, m] += 0.5 * ((_COS * b - _SIN * a) * f + c * (_COS * e - _SIN * d))


@njit(cache=True, nogil=True, error_model="numpy")
def _add_product(p, a, b, factor):
    """p += factor · a · b for polynomials of ascending powers."""
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            p[i + j] += factor * a[i] * b[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _chart(q):
    """The row of `_CHARTS` in which x², xy and y² are determined best."""
    best, chart = -1.0, 0
    for n in range(6):
        x, y = _CHARTS[n, 0], _CHARTS[n, 1]
        det = 0.0
        for r in range(3):
            s, t = (r + 1) % 3, (r + 2) % 3
            det += q[r, x, x] * (q[s, x, y] * q[t, y, y] - q[s, y, y] * q[t, x, y])
        if abs(det) > best:
            best, chart = abs(det), n
    return chart


@njit(cache=True, nogil=True, error_model="numpy")
def _reduce(q, chart, h):
    """Fills h (3, 3, 3) with the forms in x, y and 1, by powers of z, to which x², xy and y² are equal."""
    x, y, z, w = _CHARTS[chart]
    a, b = np.empty((3, 3)), np.empty(3)
    h[:] = 0.0
    for k in range(7):
        for r in range(3):
            a[r, 0], a[r, 1], a[r, 2] = q[r, x, x], 2.0 * q[r, x, y], q[r, y, y]
            if k < 4:
                b[r] = -2.0 * q[r, x if k < 2 else y, w if k % 2 == 0 else z]
            else:
                b[r] = -q[r, w, w] if k == 4 else -2.0 * q[r, z, w] if k == 5 else -q[r, z, z]
        solve(a, b)
        for r in range(3):
            h[r, min(k // 2, 2), k % 2 if k < 4 else k - 4] = b[r]


@njit(cache=True, nogil=True, error_model="numpy")
def _consistency(h, b):
    """Fills b (3, 3, 5) with the coefficients of x, y and 1 in the three equations between x², xy and y².

    In each, these are replaced by their forms once more, with the factors `by` that they have there.
    """
    b[:] = 0.0
    by, product = np.empty((3, 3)), np.empty(5)
    for m in range(3):
        b[0, 0, m], b[0, 1, m] = h[1, 2, m], -h[0, 2, m]
        b[1, 0, m], b[1, 1, m] = -h[2, 2, m], h[1, 2, m]
    for r in range(2):
        for m in range(3):
            by[0, m] = h[1, 0, m] if r == 0 else -h[2, 0, m]
            by[1, m] = h[1, 1, m] - h[0, 0, m] if r == 0 else h[1, 0, m] - h[2, 1, m]
            by[2, m] = -h[0, 1, m] if r == 0 else h[1, 1, m]
        for n in range(3):
            for k in range(3):
                _add_product(b[r, k], by[n], h[n, k], 1.0)
    for i in range(3):
        for j in range(3):
            product[:] = 0.0
            _add_product(product, h[1, i], h[1, j], 1.0)
            _add_product(product, h[0, i], h[2, j], -1.0)
            if i < 2 and j < 2:
                for k in range(3):
                    _add_product(b[2, k], product[:3], h[i + j, k], 1.0)
            else:
                for m in range(5):
                    b[2, min(i, j), m] += product[m]


@njit(cache=True, nogil=True, error_model="numpy")
def _polish(q, g):
    """Gauss–Newton steps of unit g (4,) on all quadrics; the normal equations hold g itself fixed."""
    a, step, row = np.empty((4, 4)), np.empty(4), np.empty(4)
    for _ in range(_POLISH_STEPS):
        for i in range(4):
            step[i] = 0.0
            for j in range(4):
                a[i, j] = g[i] * g[j]
        for n in range(4):
            residual = 0.0
            for i in range(4):
                row[i] = 0.0
                for j in range(4):
                    row[i] += 2.0 * q[n, i, j] * g[j]
                residual += 0.5 * row[i] * g[i]
            for i in range(4):
                step[i] -= residual * row[i]
                for j in range(4):
                    a[i, j] += row[i] * row[j]
        solve(a, step)
        square = step[0] * step[0] + step[1] * step[1] + step[2] * step[2] + step[3] * step[3]
        if not square < np.inf:
            return
        # The step is orthogonal to g.
        norm = np.sqrt(1.0 + square)
        for i in range(4):
            g[i] = (g[i] + step[i]) / norm
        if square < _AT_REST:
            return


@njit(cache=True, nogil=True, error_model="numpy")
def _combine(basis, g, p):
    """p = Σ g_k P_k."""
    for k in range(12):
        p[k] = g[0] * basis[0, k] + g[1] * basis[1, k] + g[2] * basis[2, k] + g[3] * basis[3, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_rotation(r):
    """Makes the nearly orthonormal r (9,) a rotation by Newton's iteration r ← (r + r⁻ᵀ) / 2; False if it has none."""
    cofactors = np.empty(9)
    for _ in range(_ROTATION_STEPS):
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                c, d = (j + 1) % 3, (j + 2) % 3
                cofactors[3 * i + j] = r[3 * a + c] * r[3 * b + d] - r[3 * a + d] * r[3 * b + c]
        det = r[0] * cofactors[0] + r[1] * cofactors[1] + r[2] * cofactors[2]
        if not det > _SMALLEST_DETERMINANT:
            return False
        for k in range(9):
            r[k] = 0.5 * (r[k] + cofactors[k] / det)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _pose(p, center, scale, model):
    """Fills `model` (12,) from the matrix p (12,) of centred and scaled points in front; False if it is no camera."""
    norms, rotation = np.empty(3), np.empty(9)
    for k in range(3):
        norms[k] = np.sqrt(p[4 * k] ** 2 + p[4 * k + 1] ** 2 + p[4 * k + 2] ** 2)
    ratio, focal = norms[0] / norms[1], np.sqrt(norms[0] * norms[1]) / norms[2]
    if not (1.0 / _MAX_ASPECT < ratio < _MAX_ASPECT and 0.0 < focal < np.inf):
        return False
    for k in range(3):
        for j in range(3):
            rotation[3 * k + j] = p[4 * k + j] / norms[k]
    if not _nearest_rotation(rotation):
        return False
    for k in range(3):
        factor = focal if k < 2 else 1.0
        model[9 + k] = p[4 * k + 3] / (norms[2] * scale)
        for j in range(3):
            model[3 * k + j] = factor * rotation[3 * k + j]
            model[9 + k] -= model[3 * k + j] * center[j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _in_front(data, sample, p, center, scale):
    """Gives the matrix p (12,) the sign under which all four points have positive depths; False if none does."""
    positive = 0
    for i in range(4):
        depth = p[11]
        for j in range(3):
            depth += p[8 + j] * scale * (data[2 + j, sample[i]] - center[j])
        positive += depth > 0.0
    if positive == 0:
        for k in range(12):
            p[k] = -p[k]
    return positive == 0 or positive == 4


@njit(cache=True, nogil=True, error_model="numpy")
def p4pf(data, samples, models):
    """Fills the rows of `models` (8 B, ≥ 12) with K R by rows and K t of samples, K = diag(f, f, 1); returns how many.

    Columns of `data` are u, v from the principal point, in the unit of f and of a size near 1, and the point X (3);
    rows of `samples` (B, 4) name columns. All points lie in front of the camera.
    """
    basis, q = np.empty((4, 12)), np.empty((4, 4, 4))
    h, b, det, roots = np.empty((3, 3, 3)), np.empty((3, 3, 5)), np.empty(11), np.empty(16)
    g, p, count = np.empty(4), np.empty(12), 0
    for s in range(samples.shape[0]):
        center, scale = _projections(data, samples[s], basis)
        if not scale < np.inf:
            continue
        _quadrics(basis, q)
        chart = _chart(q)
        _reduce(q, chart, h)
        _consistency(h, b)
        determinant(b, det)
        for r in range(real_roots(det[:9], roots)):
            x, y = null_vector(b, roots[r])
            norm = np.sqrt(x * x + y * y + roots[r] * roots[r] + 1.0)
            if not norm < np.inf:
                continue
            g[_CHARTS[chart, 0]], g[_CHARTS[chart, 1]] = x / norm, y / norm
            g[_CHARTS[chart, 2]], g[_CHARTS[chart, 3]] = roots[r] / norm, 1.0 / norm
            # Most roots are of no camera in front of which the points lie, which shows before they are polished.
            _combine(basis, g, p)
            if not _in_front(data, samples[s], p, center, scale):
                continue
            _polish(q, g)
            _combine(basis, g, p)
            if _in_front(data, samples[s], p, center, scale) and _pose(p, center, scale, models[count]):
                count += 1
    return count
