"""Real roots of polynomials of low degree, and of 3 × 3 matrices of them, without eigenvalues.

Between two neighbouring real roots of p' the polynomial p is monotone, so it has there one root if the signs at the
ends differ and none otherwise. Starting at the highest derivative, which is linear, each derivative's roots bracket
those of the next, and every bracket is closed by Newton's method guarded by bisection.

Roots within [−1, 1] come from p itself and the others from the reversed polynomial zⁿ p(1/z), whose roots are 1/z:
coefficients of any size and vanishing leading coefficients are harmless.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

MAX_DEGREE = 15
_BINOMIAL = np.array([[float(math.comb(n, k)) for k in range(MAX_DEGREE + 1)] for n in range(MAX_DEGREE + 1)])
_STEPS = 60
# Roots beyond 1e12 are the roots at infinity of a vanishing leading coefficient.
_NEGLIGIBLE = 1e-12


@njit(cache=True, nogil=True, error_model="numpy")
def _bracketed_root(c, degree, low, high, negative_at_low):
    """The root of Σ c[k] xᵏ between `low` and `high`, where the signs differ."""
    x = 0.5 * (low + high)
    for _ in range(_STEPS):
        f, df = c[degree], 0.0
        for k in range(degree - 1, -1, -1):
            df = df * x + f
            f = f * x + c[k]
        if (f < 0) == negative_at_low:
            low = x
        else:
            high = x
        new = x - f / df if df != 0 else low
        if not low < new < high:
            new = 0.5 * (low + high)
        step = abs(new - x)
        x = new
        if step < 1e-12:
            break
    return x


@njit(cache=True, nogil=True, error_model="numpy")
def _unit_roots(coefficients, factor, reverse, found):
    """Fills `found` with the roots in [−1, 1] of factor · Σ coefficients[k] xᵏ or its reverse; returns how many."""
    degree, count = coefficients.shape[0] - 1, 0
    c = np.empty(MAX_DEGREE + 1)
    for order in range(degree - 1, -1, -1):
        d = degree - order
        for k in range(d + 1):
            power = k + order
            c[k] = coefficients[degree - power if reverse else power] * factor * _BINOMIAL[power, order]
        # `found` holds the roots of the next higher derivative; each is read before its place is written.
        brackets, count, low, negative = count + 1, 0, -1.0, False
        for i in range(-1, brackets):
            high = -1.0 if i < 0 else 1.0 if i == brackets - 1 else found[i]
            f = c[d]
            for k in range(d - 1, -1, -1):
                f = f * high + c[k]
            if i >= 0 and (f < 0) != negative:
                found[count] = _bracketed_root(c, d, low, high, not f < 0)
                count += 1
            low, negative = high, f < 0
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _largest(coefficients):
    """The largest magnitude; 0 where one is not finite."""
    largest = 0.0
    for k in range(coefficients.shape[0]):
        if not abs(coefficients[k]) < np.inf:
            return 0.0
        largest = max(largest, abs(coefficients[k]))
    return largest


@njit(cache=True, nogil=True, error_model="numpy")
def real_roots(coefficients, roots):
    """Fills `roots` with the real roots of Σ coefficients[k] xᵏ, k = 0 … degree ≤ MAX_DEGREE; returns how many.

    A root of even multiplicity may be missed or found twice; the zero polynomial has none.
    """
    degree, largest = coefficients.shape[0] - 1, _largest(coefficients)
    if largest == 0.0:
        return 0
    found, total = np.empty(MAX_DEGREE + 1), 0
    for reverse in range(2):
        for i in range(_unit_roots(coefficients, 1.0 / largest, reverse, found)):
            if reverse == 0 or _NEGLIGIBLE < abs(found[i]) < 1.0:
                roots[total] = 1.0 / found[i] if reverse else found[i]
                total += 1
    return min(total, degree)


@njit(cache=True, nogil=True, error_model="numpy")
def roots_within(coefficients, roots):
    """As `real_roots`, for the roots in [−1, 1] only; `roots` has room for MAX_DEGREE + 1."""
    largest = _largest(coefficients)
    return 0 if largest == 0.0 else _unit_roots(coefficients, 1.0 / largest, 0, roots)


@njit(cache=True, nogil=True, error_model="numpy")
def determinant(b, det):
    """Fills `det` (11,) with det B(z); b (3, 3, 5) has degrees 3, 3 and 4 in its columns."""
    minor = np.empty(7)
    for k in range(11):
        det[k] = 0.0
    for r in range(3):
        p, q = (r + 1) % 3, (r + 2) % 3
        for k in range(7):
            minor[k] = 0.0
        for i in range(4):
            for j in range(4):
                minor[i + j] += b[p, 0, i] * b[q, 1, j] - b[p, 1, i] * b[q, 0, j]
        for i in range(7):
            for j in range(5):
                det[i + j] += minor[i] * b[r, 2, j]


@njit(cache=True, nogil=True, error_model="numpy")
def null_vector(b, z):
    """(x, y) with B(z) (x, y, 1)ᵀ = 0, from the pair of rows that determines it best."""
    m = np.empty((3, 3))
    for r in range(3):
        for v in range(3):
            f = b[r, v, 4]
            for k in range(3, -1, -1):
                f = f * z + b[r, v, k]
            m[r, v] = f
    best, x, y = 0.0, np.nan, np.nan
    for r in range(3):
        p, q = (r + 1) % 3, (r + 2) % 3
        w = m[p, 0] * m[q, 1] - m[p, 1] * m[q, 0]
        if abs(w) > best:
            best = abs(w)
            x = (m[p, 1] * m[q, 2] - m[p, 2] * m[q, 1]) / w
            y = (m[p, 2] * m[q, 0] - m[p, 0] * m[q, 2]) / w
    return x, y
