"""Real roots of polynomials of low degree, and of 3 × 3 matrices of them, without eigenvalues.

Sturm's chain of p is p, p' and the negated remainders of the division of each by the next. From x to y > x its sign
changes decrease by the number of roots between them, so that intervals are halved until each holds one root, which
Newton's method guarded by bisection closes. The chain is kept as the quotients of these divisions,

    f_{i−1} = (a_i x + b_i) f_i − c_i f_{i+1},    c_i > 0,

by which it is evaluated from its end in time proportional to the degree.

Where rounding would spoil the chain's signs, roots are bracketed by those of the derivatives instead: between two
neighbouring real roots of p' the polynomial p is monotone, so it has there one root if the signs at the ends differ and
none otherwise. Starting at the highest derivative, which is linear, each derivative's roots bracket those of the next.

Roots within [−1, 1] come from p itself and the others from the reversed polynomial zⁿ p(1/z), whose roots are 1/z:
coefficients of any size and vanishing leading coefficients are harmless. For the polynomials of the five-point solver
chains take a fifth of the time of derivatives, and find the same roots.

Reference:
    Hook & McAree, Using Sturm sequences to bracket real roots of polynomial equations, Graphics Gems 1990.
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
_MAX_QUOTIENT, _MIN_REMAINDER = 1e6, 1e-8
# Roots nearer to each other are not told apart.
_INDISTINCT = 1e-12


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
def _sturm_chain(coefficients, chain):
    """Fills the rows of `chain` with a, b, c, and the last with the linear a x + b and the constant c that end it.

    Returns the number of that row, or −1 where rounding would spoil the signs: near multiple roots, where the chain
    ends early, and where the leading coefficient of the polynomial or of a remainder is small.
    """
    degree, f, g = coefficients.shape[0] - 1, np.empty(MAX_DEGREE + 1), np.empty(MAX_DEGREE + 1)
    for k in range(degree + 1):
        f[k] = coefficients[k]
        if k > 0:
            g[k - 1] = k * coefficients[k]
    row = 0
    for d in range(degree - 1, 0, -1):
        a = f[d + 1] / g[d]
        b = (f[d] - a * g[d - 1]) / g[d]
        largest = 0.0
        for k in range(d):
            f[k] = b * g[k] + (a * g[k - 1] if k > 0 else 0.0) - f[k]
            largest = max(largest, abs(f[k]))
        if not (abs(a) + abs(b) < _MAX_QUOTIENT and largest > _MIN_REMAINDER):
            return -1
        chain[row, 0], chain[row, 1], chain[row, 2] = a, b, largest
        row += 1
        for k in range(d):
            f[k], g[k] = g[k], f[k] / largest
        f[d] = g[d]
    chain[row, 0], chain[row, 1], chain[row, 2] = f[1], f[0], g[0]
    return row


@njit(cache=True, nogil=True, error_model="numpy")
def _sign_changes(chain, last, x):
    """The number of sign changes along Sturm's chain at x."""
    after, value = chain[last, 2], chain[last, 0] * x + chain[last, 1]
    changes = 1 if (after < 0) != (value < 0) else 0
    for i in range(last - 1, -1, -1):
        after, value = value, (chain[i, 0] * x + chain[i, 1]) * value - chain[i, 2] * after
        if (after < 0) != (value < 0):
            changes += 1
    return changes


@njit(cache=True, nogil=True, error_model="numpy")
def _roots_by_chain(c, reverse, chain, last, low, high, ends, found):
    """Fills `found` with the roots of Σ c[k] xᵏ between `low` and `high`; returns how many.

    With `reverse` the chain is that of the reversed polynomial. `ends` (64, 4) is room for the intervals that are left,
    each with the sign changes at its ends.
    """
    degree, count, left = c.shape[0] - 1, 0, 1
    ends[0, 0], ends[0, 1] = low, _sign_changes(chain, last, 1.0 / low if reverse else low)
    ends[0, 2], ends[0, 3] = high, _sign_changes(chain, last, 1.0 / high if reverse else high)
    while left > 0:
        left -= 1
        low, at_low, high, at_high = ends[left, 0], ends[left, 1], ends[left, 2], ends[left, 3]
        inside = abs(at_low - at_high)
        if inside == 1.0 and count <= degree:
            f = c[degree]
            for k in range(degree - 1, -1, -1):
                f = f * low + c[k]
            found[count] = _bracketed_root(c, degree, low, high, f < 0)
            count += 1
        elif inside > 1.0 and high - low > _INDISTINCT:
            middle = 0.5 * (low + high)
            changes = _sign_changes(chain, last, 1.0 / middle if reverse else middle)
            ends[left, 2], ends[left, 3] = middle, changes
            ends[left + 1, 0], ends[left + 1, 1], ends[left + 1, 2], ends[left + 1, 3] = middle, changes, high, at_high
            left += 2
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _roots_by_derivatives(coefficients, found):
    """Fills `found` with the roots in [−1, 1] of Σ coefficients[k] xᵏ; returns how many."""
    degree, count = coefficients.shape[0] - 1, 0
    c = np.empty(MAX_DEGREE + 1)
    for order in range(degree - 1, -1, -1):
        d = degree - order
        for k in range(d + 1):
            power = k + order
            c[k] = coefficients[power] * _BINOMIAL[power, order]
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
def real_roots(coefficients, roots, within=False):
    """Fills `roots` with the real roots of Σ coefficients[k] xᵏ, k = 0 … degree ≤ MAX_DEGREE; returns how many.

    With `within` only those in [−1, 1] are sought. A root of even multiplicity may be missed or found twice; the zero
    polynomial has none.
    """
    degree, largest = coefficients.shape[0] - 1, 0.0
    for k in range(degree + 1):
        if not abs(coefficients[k]) < np.inf:
            return 0
        largest = max(largest, abs(coefficients[k]))
    if largest == 0.0:
        return 0
    c, chain, found, ends = np.empty(degree + 1), np.empty((MAX_DEGREE, 3)), np.empty(MAX_DEGREE + 1), np.empty((64, 4))
    for k in range(degree + 1):
        c[k] = coefficients[k] / largest
    last, total = _sturm_chain(c, chain), 0
    for part in range(1 if within else 3 if last >= 0 else 2):
        if part == 1:
            for k in range((degree + 1) // 2):
                c[k], c[degree - k] = c[degree - k], c[k]
        if last < 0:
            count = _roots_by_derivatives(c, found)
        else:
            low, high = -1.0 if part != 1 else _NEGLIGIBLE, 1.0 if part != 2 else -_NEGLIGIBLE
            count = _roots_by_chain(c, part > 0, chain, last, low, high, ends, found)
        for i in range(count):
            if total < degree and (part == 0 or _NEGLIGIBLE < abs(found[i]) < 1.0):
                roots[total] = 1.0 / found[i] if part > 0 else found[i]
                total += 1
    return total


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
