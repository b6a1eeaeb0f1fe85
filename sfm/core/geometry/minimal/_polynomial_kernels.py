"""Real roots of polynomials of low degree, without eigenvalues.

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

MAX_DEGREE = 10
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
def real_roots(coefficients, roots):
    """Fills `roots` with the real roots of Σ coefficients[k] xᵏ, k = 0 … degree ≤ 10; returns how many.

    A root of even multiplicity may be missed or found twice; the zero polynomial has none.
    """
    degree = coefficients.shape[0] - 1
    largest = 0.0
    for k in range(degree + 1):
        if not abs(coefficients[k]) < np.inf:
            return 0
        largest = max(largest, abs(coefficients[k]))
    if largest == 0.0:
        return 0
    c, found, total = np.empty(MAX_DEGREE + 1), np.empty(MAX_DEGREE + 1), 0
    for reverse in range(2):
        count = 0
        for order in range(degree - 1, -1, -1):
            d = degree - order
            for k in range(d + 1):
                power = k + order
                c[k] = coefficients[degree - power if reverse else power] / largest * _BINOMIAL[power, order]
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
        for i in range(count):
            if reverse == 0 or _NEGLIGIBLE < abs(found[i]) < 1.0:
                roots[total] = 1.0 / found[i] if reverse else found[i]
                total += 1
    return min(total, degree)
