"""Fundamental matrices with an unknown focal length from six pairs of points.

Points are counted from the principal points. Six equations p2ᵀ F p1 = 0 leave F = x X + y Y + Z. With
K = diag(f, f, 1), w = 1 / f² and Q = diag(1, 1, w), the essential matrix is

    E = K F K   (both focal lengths are f)        E = F K   (that of camera 2 is 1)

and 2 E Eᵀ E − tr(E Eᵀ) E = 0, multiplied by the inverse of K from its sides, becomes

    2 F Q Fᵀ Q₂ F − tr(F Q Fᵀ Q₂) F = 0,    Q₂ = Q or 1.

With det F = 0 these are ten cubics in x, y, so C(w) (x³, x² y, …, 1)ᵀ = 0 with a matrix C of degree two or one in w.
Its determinant has degree 15 or 9. It is taken at Chebyshev's nodes of s in w = (1 + s) / (1 − s), which maps
−1 … 1 to all w > 0, and its roots are sought there only. The null vector at a root gives x, y, and Gauss–Newton steps
on the ten cubics polish x, y and w.

References:
    Kukelova, Bujnak & Pajdla, Polynomial eigenvalue solutions to the 5-pt and 6-pt relative pose problems, BMVC 2008.
    Hartley & Li, An efficient hidden variable approach to minimal-case camera motion estimation, PAMI 2012.
    Bujnak, Kukelova & Pajdla, 3D reconstruction from image collections with a single known focal length, ICCV 2009.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.core.geometry.minimal._linear_kernels import nullspace, solve
from sfm.core.geometry.minimal._polynomial_kernels import real_roots

MAX_SHARED_SOLUTIONS, MAX_ONE_SIDED_SOLUTIONS = 15, 9
_POLISH_STEPS = 4
# Roots of the rounded determinant that solve nothing do not come to rest.
_AT_REST = 1e-6

_LINEAR = ((1, 0), (0, 1), (0, 0))
_QUADRATIC = ((2, 0), (1, 1), (0, 2), (1, 0), (0, 1), (0, 0))
_CUBIC = ((3, 0), (2, 1), (1, 2), (0, 3), (2, 0), (1, 1), (0, 2), (1, 0), (0, 1), (0, 0))


def _product_table(left, right, products):
    return np.array([[products.index((a[0] + b[0], a[1] + b[1])) for b in right] for a in left])


def _interpolation(degree):
    """Chebyshev's nodes, and the matrix that takes values there to coefficients of ascending powers."""
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    series = np.polynomial.chebyshev
    to_series = np.linalg.inv(series.chebvander(nodes, degree))
    to_powers = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        powers = series.cheb2poly(np.eye(degree + 1)[k])
        to_powers[: len(powers), k] = powers
    return nodes, to_powers @ to_series


_SQUARE = _product_table(_LINEAR, _LINEAR, _QUADRATIC)
_CUBE = _product_table(_QUADRATIC, _LINEAR, _CUBIC)
_SHARED_NODES, _SHARED_POWERS = _interpolation(MAX_SHARED_SOLUTIONS)
_ONE_SIDED_NODES, _ONE_SIDED_POWERS = _interpolation(MAX_ONE_SIDED_SOLUTIONS)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_square(p, a, b, factor):
    """p += factor · a · b for linear forms a, b."""
    for i in range(3):
        for j in range(3):
            p[_SQUARE[i, j]] += factor * a[i] * b[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_cube(p, a, b, factor):
    """p += factor · a · b for a quadratic form a and a linear form b."""
    for i in range(6):
        for j in range(3):
            p[_CUBE[i, j]] += factor * a[i] * b[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _constraints(f, shared, c):
    """Fills c (3, 10, 10), by the power of w, the equation and the monomial, for F of linear forms f (3, 3, 3)."""
    c[:] = 0.0
    product, trace = np.zeros((3, 3, 2, 6)), np.zeros((3, 6))
    for i in range(3):
        for k in range(3):
            for m in range(3):
                _add_square(product[i, k, m // 2], f[i, m], f[k, m], 1.0)
    for i in range(3):
        shift = 1 if shared and i == 2 else 0
        for n in range(2):
            for m in range(6):
                trace[n + shift, m] += product[i, i, n, m]
    for i in range(3):
        for j in range(3):
            row = 3 * i + j
            for k in range(3):
                shift = 1 if shared and k == 2 else 0
                for n in range(2):
                    _add_cube(c[n + shift, row], product[i, k, n], f[k, j], 2.0)
            for n in range(3):
                _add_cube(c[n, row], trace[n], f[i, j], -1.0)
    minor = np.empty(6)
    for j in range(3):
        a, b = (j + 1) % 3, (j + 2) % 3
        minor[:] = 0.0
        _add_square(minor, f[1, a], f[2, b], 1.0)
        _add_square(minor, f[1, b], f[2, a], -1.0)
        _add_cube(c[0, 9], minor, f[0, j], 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _determinant(a):
    """Of a (10, 10), which it destroys."""
    det = 1.0
    for k in range(10):
        row = k
        for i in range(k + 1, 10):
            if abs(a[i, k]) > abs(a[row, k]):
                row = i
        pivot = a[row, k]
        if pivot == 0.0:
            return 0.0
        if row != k:
            det = -det
            for j in range(k, 10):
                a[k, j], a[row, j] = a[row, j], a[k, j]
        det *= pivot
        for i in range(k + 1, 10):
            factor = a[i, k] / pivot
            for j in range(k + 1, 10):
                a[i, j] -= factor * a[k, j]
    return det


@njit(cache=True, nogil=True, error_model="numpy")
def _null_vector(a, v):
    """Fills `v` with the vector that a (10, 10) of rank nine maps to zero; destroys `a`."""
    order = np.arange(10)
    for k in range(9):
        row, column = k, k
        for i in range(k, 10):
            for j in range(k, 10):
                if abs(a[i, j]) > abs(a[row, column]):
                    row, column = i, j
        if a[row, column] == 0.0:
            return False
        for j in range(10):
            a[k, j], a[row, j] = a[row, j], a[k, j]
        for i in range(10):
            a[i, k], a[i, column] = a[i, column], a[i, k]
        order[k], order[column] = order[column], order[k]
        for i in range(k + 1, 10):
            factor = a[i, k] / a[k, k]
            for j in range(k + 1, 10):
                a[i, j] -= factor * a[k, j]
    v[order[9]] = 1.0
    for k in range(8, -1, -1):
        total = -a[k, 9]
        for j in range(k + 1, 9):
            total -= a[k, j] * v[order[j]]
        v[order[k]] = total / a[k, k]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _polish(c, z):
    """Gauss–Newton steps of z = (x, y, w) on the ten cubics; False where they do not come to rest."""
    v, by_x, by_y = np.empty(10), np.empty(10), np.empty(10)
    square, product, row = np.empty((3, 3)), np.empty(3), np.empty(3)
    for _ in range(_POLISH_STEPS):
        x, y, w = z[0], z[1], z[2]
        v[0], v[1], v[2], v[3] = x * x * x, x * x * y, x * y * y, y * y * y
        v[4], v[5], v[6], v[7], v[8], v[9] = x * x, x * y, y * y, x, y, 1.0
        by_x[0], by_x[1], by_x[2], by_x[3], by_x[4] = 3.0 * x * x, 2.0 * x * y, y * y, 0.0, 2.0 * x
        by_x[5], by_x[6], by_x[7], by_x[8], by_x[9] = y, 0.0, 1.0, 0.0, 0.0
        by_y[0], by_y[1], by_y[2], by_y[3], by_y[4] = 0.0, x * x, 2.0 * x * y, 3.0 * y * y, 0.0
        by_y[5], by_y[6], by_y[7], by_y[8], by_y[9] = x, 2.0 * y, 0.0, 1.0, 0.0
        square[:] = 0.0
        product[:] = 0.0
        for i in range(10):
            residual = 0.0
            row[:] = 0.0
            for k in range(10):
                value = c[0, i, k] + w * (c[1, i, k] + w * c[2, i, k])
                residual += value * v[k]
                row[0] += value * by_x[k]
                row[1] += value * by_y[k]
                row[2] += (c[1, i, k] + 2.0 * w * c[2, i, k]) * v[k]
            for j in range(3):
                product[j] += row[j] * residual
                for k in range(3):
                    square[j, k] += row[j] * row[k]
        solve(square, product)
        for j in range(3):
            z[j] -= product[j]
    moved = (abs(product[0]) + abs(product[1])) / (1.0 + abs(z[0]) + abs(z[1])) + abs(product[2] / z[2])
    return z[2] > 0.0 and moved < _AT_REST


@njit(cache=True, nogil=True, error_model="numpy")
def _pencil_determinant(c, shared, nodes, powers, coefficients):
    """Fills `coefficients` with those of the determinant by s, of degree len(nodes) − 1."""
    matrix = np.empty((10, 10))
    coefficients[:] = 0.0
    for n in range(nodes.shape[0]):
        up, down = 1.0 + nodes[n], 1.0 - nodes[n]
        for i in range(10):
            for k in range(10):
                if shared:
                    matrix[i, k] = down * (down * c[0, i, k] + up * c[1, i, k]) + up * up * c[2, i, k]
                else:
                    matrix[i, k] = down * c[0, i, k] + up * c[1, i, k]
        # The row of det F, free of w, came out too large by (1 − s)² or 1 − s; three roots lie at infinity if shared.
        value = _determinant(matrix) / (down**5 if shared else down)
        for k in range(nodes.shape[0]):
            coefficients[k] += powers[k, n] * value


@njit(cache=True, nogil=True, error_model="numpy")
def _six_point(data, sample, shared, nodes, powers, models):
    """Fills the rows of `models` with F (9) and log f of one sample of six; returns how many."""
    equations, basis, forms = np.empty((6, 9)), np.empty((3, 9)), np.empty((3, 3, 3))
    c, matrix, v, z = np.empty((3, 10, 10)), np.empty((10, 10)), np.empty(10), np.empty(3)
    coefficients, roots = np.empty(nodes.shape[0]), np.empty(16)
    for p in range(6):
        for i in range(3):
            for j in range(3):
                left = data[2 + i, sample[p]] if i < 2 else 1.0
                equations[p, 3 * i + j] = left * data[j, sample[p]] if j < 2 else left
    if not nullspace(equations, basis):
        return 0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                forms[i, j, k] = basis[k, 3 * i + j]
    _constraints(forms, shared, c)
    _pencil_determinant(c, shared, nodes, powers, coefficients)
    count = 0
    for r in range(real_roots(coefficients, roots, True)):
        w = (1.0 + roots[r]) / (1.0 - roots[r])
        for i in range(10):
            for k in range(10):
                matrix[i, k] = c[0, i, k] + w * (c[1, i, k] + w * c[2, i, k])
        if not _null_vector(matrix, v):
            continue
        z[0], z[1], z[2] = v[7] / v[9], v[8] / v[9], w
        if not _polish(c, z):
            continue
        norm = np.sqrt(z[0] * z[0] + z[1] * z[1] + 1.0)
        for i in range(9):
            models[count, i] = (z[0] * basis[0, i] + z[1] * basis[1, i] + basis[2, i]) / norm
        models[count, 9] = -0.5 * np.log(z[2])
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def six_point(data, samples, shared, models):
    """Fills the rows of `models` (15 or 9 B, ≥ 10) with F (9) of unit norm and log f of samples; returns how many.

    Columns of `data` are pairs of points from the principal points, x1, y1, x2, y2; rows of `samples` (B, 6) name
    columns. The unit is that of f and such that most coordinates lie within −1 … 1 and f is between 0.3 and 10: far
    from there the determinant spans too many orders of magnitude. If f is not shared, that of camera 2 is the unit.
    """
    nodes, powers, count = _SHARED_NODES, _SHARED_POWERS, 0
    if not shared:
        nodes, powers = _ONE_SIDED_NODES, _ONE_SIDED_POWERS
    for s in range(samples.shape[0]):
        count += _six_point(data, samples[s], shared, nodes, powers, models[count:])
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def six_point_shared_focal(data, samples, models):
    """`six_point` for the focal length of both cameras."""
    return six_point(data, samples, True, models)


@njit(cache=True, nogil=True, error_model="numpy")
def six_point_one_sided_focal(data, samples, models):
    """`six_point` for the focal length of camera 1."""
    return six_point(data, samples, False, models)
