"""Essential matrices from five pairs of rays.

The five equations r2ᵀ E r1 = 0 leave E = x X + y Y + z Z + W. Inserted into

    E Eᵀ E − ½ tr(E Eᵀ) E = 0,    det E = 0

they give ten cubics in x, y, z. Elimination of the monomials of the columns 0 … 9 below leaves six rows

    e: x²z + …    f: x² + …    g: y²z + …    h: y² + …    i: xyz + …    j: xy + …

whose combinations e − z f, g − z h, i − z j are linear in x and y with coefficients that are polynomials of z:
B(z) (x, y, 1)ᵀ = 0. The real roots of det B(z), of degree 10, are the solutions.

Reference:
    Nistér, An efficient solution to the five-point relative pose problem, PAMI 2004.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.core.geometry.minimal._linear_kernels import nullspace
from sfm.core.geometry.minimal._polynomial_kernels import determinant, null_vector, real_roots

MAX_SOLUTIONS = 10

_LINEAR = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))
_QUADRATIC = (
    (2, 0, 0),
    (1, 1, 0),
    (1, 0, 1),
    (1, 0, 0),
    (0, 2, 0),
    (0, 1, 1),
    (0, 1, 0),
    (0, 0, 2),
    (0, 0, 1),
    (0, 0, 0),
)
_CUBIC = (
    *((3, 0, 0), (0, 3, 0), (2, 1, 0), (1, 2, 0), (2, 0, 1), (2, 0, 0), (0, 2, 1), (0, 2, 0), (1, 1, 1), (1, 1, 0)),
    *((1, 0, 2), (1, 0, 1), (1, 0, 0), (0, 1, 2), (0, 1, 1), (0, 1, 0), (0, 0, 3), (0, 0, 2), (0, 0, 1), (0, 0, 0)),
)  # fmt: skip


def _product_table(left, right, products):
    return np.array([[products.index(tuple(np.add(a, b).tolist())) for b in right] for a in left])


_SQUARE = _product_table(_LINEAR, _LINEAR, _QUADRATIC)
_CUBE = _product_table(_QUADRATIC, _LINEAR, _CUBIC)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_square(p, a, b, factor):
    """p += factor · a · b for linear forms a, b."""
    for i in range(4):
        for j in range(4):
            p[_SQUARE[i, j]] += factor * a[i] * b[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_cube(p, a, b):
    """p += a · b for a quadratic form a and a linear form b."""
    for i in range(10):
        for j in range(4):
            p[_CUBE[i, j]] += a[i] * b[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _constraints(e, rows):
    """The ten cubics (10, 20) of E, whose nine entries are the linear forms e (3, 3, 4)."""
    symmetric = np.empty((3, 3, 10))
    for i in range(10):
        for k in range(20):
            rows[i, k] = 0.0
    for i in range(3):
        for j in range(3):
            for m in range(10):
                symmetric[i, j, m] = 0.0
    for i in range(3):
        for j in range(i + 1):
            for k in range(3):
                _add_square(symmetric[i, j], e[i, k], e[j, k], 1.0)
    for m in range(10):
        half_trace = 0.5 * (symmetric[0, 0, m] + symmetric[1, 1, m] + symmetric[2, 2, m])
        for i in range(3):
            symmetric[i, i, m] -= half_trace
            for j in range(i):
                symmetric[j, i, m] = symmetric[i, j, m]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                _add_cube(rows[3 * i + j], symmetric[i, k], e[k, j])
    minor = np.empty(10)
    for j in range(3):
        a, b = (j + 1) % 3, (j + 2) % 3
        for m in range(10):
            minor[m] = 0.0
        _add_square(minor, e[1, a], e[2, b], 1.0)
        _add_square(minor, e[1, b], e[2, a], -1.0)
        _add_cube(rows[9], minor, e[0, j])


@njit(cache=True, nogil=True, error_model="numpy")
def _eliminate(a):
    """Makes the first ten columns of `a` (10, 20) the identity in the rows 4 … 9; False where it is singular."""
    for k in range(10):
        largest, row = 0.0, k
        for i in range(k, 10):
            if abs(a[i, k]) > largest:
                largest, row = abs(a[i, k]), i
        if not 1e-14 < largest < np.inf:
            return False
        if row != k:
            for j in range(k, 20):
                a[k, j], a[row, j] = a[row, j], a[k, j]
        inverse = 1.0 / a[k, k]
        for j in range(k + 1, 20):
            a[k, j] *= inverse
        for i in range(k + 1, 10):
            factor = a[i, k]
            for j in range(k + 1, 20):
                a[i, j] -= factor * a[k, j]
    for k in range(9, 4, -1):
        for i in range(4, k):
            factor = a[i, k]
            for j in range(10, 20):
                a[i, j] -= factor * a[k, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _action(a, b):
    """B (3, 3, 5): coefficients, of ascending powers of z, of x, y and 1 in e − z f, g − z h, i − z j."""
    for r in range(3):
        upper, lower = 4 + 2 * r, 5 + 2 * r
        for v in range(3):
            start, size = 10 + 3 * v, 3 if v < 2 else 4
            for k in range(5):
                b[r, v, k] = 0.0
            for k in range(size):
                b[r, v, size - 1 - k] += a[upper, start + k]
                b[r, v, size - k] -= a[lower, start + k]


@njit(cache=True, nogil=True, error_model="numpy")
def five_point(data, samples, essentials):
    """Fills the rows of `essentials` (10 B, 9) with the E of ‖E‖ = √2 that fit samples of five; returns how many.

    Columns of `data` are pairs of rays, r1 (3), r2 (3), …; rows of `samples` (B, 5) name columns.
    """
    a, basis, forms, rows = np.empty((5, 9)), np.empty((4, 9)), np.empty((3, 3, 4)), np.empty((10, 20))
    b, det, roots = np.empty((3, 3, 5)), np.empty(11), np.empty(10)
    count = 0
    for s in range(samples.shape[0]):
        for p in range(5):
            for i in range(3):
                for j in range(3):
                    a[p, 3 * i + j] = data[3 + i, samples[s, p]] * data[j, samples[s, p]]
        if not nullspace(a, basis):
            continue
        for i in range(3):
            for j in range(3):
                for k in range(4):
                    forms[i, j, k] = basis[k, 3 * i + j]
        _constraints(forms, rows)
        if not _eliminate(rows):
            continue
        _action(rows, b)
        determinant(b, det)
        for r in range(real_roots(det, roots)):
            z = roots[r]
            x, y = null_vector(b, z)
            norm = np.sqrt(0.5 * (x * x + y * y + z * z + 1.0))
            if norm < np.inf:
                for i in range(9):
                    essentials[count, i] = (x * basis[0, i] + y * basis[1, i] + z * basis[2, i] + basis[3, i]) / norm
                count += 1
    return count
