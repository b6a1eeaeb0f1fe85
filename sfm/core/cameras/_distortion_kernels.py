"""Polynomial lens distortion: evaluation, range of validity and inverse.

One family serves all models with a distortion polynomial. With s = a² + b² it maps an ideal point (a, b) to

    a' = a g(s) + 2 p1 a b + p2 (s + 2 a²) + s1 s + s2 s²        g = N / D
    b' = b g(s) + 2 p2 a b + p1 (s + 2 b²) + s3 s + s4 s²        N = 1 + k1 s + k2 s² + k3 s³ + k4 s⁴
                                                                 D = 1 + d1 s + d2 s² + d3 s³

where (a, b) is (x/z, y/z) for a perspective lens and θ (x, y)/ρ for a fisheye lens. The tuple `coefficients` is
(k1, k2, k3, k4, d1, d2, d3, p1, p2, s1, s2, s3, s4); a model without some of them passes zeros.

The radial part r ↦ r g(r²) can be inverted from the axis up to the first radius where D vanishes or where

    d(r g)/dr · D² = Σₖ cₖ sᵏ,      cₖ = Σ_{i+j=k} nᵢ dⱼ (1 + 2i − 2j),      n₀ = d₀ = 1

does. A positive slope at the point alone would not tell: a polynomial may fall and rise again. Positivity on all
of [0, s] is first tried by a bound (drop the positive terms), and only where that fails by the first root. The
tangential and thin-prism terms are judged at the point, by the sign of the determinant.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_FAR = 1e12
"""Squared radius beyond which a limit counts as none (89.9999° for a perspective lens)."""


@njit(cache=True, nogil=True, error_model="numpy")
def distort(coefficients, a, b):
    """(a', b', ∂a'/∂a, ∂a'/∂b, ∂b'/∂a, ∂b'/∂b, ok); not ok beyond the range in which the map can be inverted."""
    k1, k2, k3, k4, d1, d2, d3, p1, p2, s1, s2, s3, s4 = coefficients
    s = a * a + b * b
    denominator = 1.0 + s * (d1 + s * (d2 + s * d3))
    g = (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))) / denominator
    slope = k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * 4.0 * k4)) - g * (d1 + s * (2.0 * d2 + s * 3.0 * d3))
    twice = 2.0 * slope / denominator
    cross = twice * a * b + 2.0 * (p1 * a + p2 * b)
    prism_a, prism_b = 2.0 * s1 + 4.0 * s2 * s, 2.0 * s3 + 4.0 * s4 * s
    aa = g + twice * a * a + 2.0 * p1 * b + prism_a * a + 6.0 * p2 * a
    ab = cross + prism_a * b
    ba = cross + prism_b * a
    bb = g + twice * b * b + 2.0 * p2 * a + prism_b * b + 6.0 * p1 * b
    a_distorted = a * g + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a) + (s1 + s2 * s) * s
    b_distorted = b * g + 2.0 * p2 * a * b + p1 * (s + 2.0 * b * b) + (s3 + s4 * s) * s
    ok = aa * bb - ab * ba > 0.0 and _is_monotone(coefficients, s)
    return a_distorted, b_distorted, aa, ab, ba, bb, ok


@njit(cache=True, nogil=True, error_model="numpy")
def undistort(coefficients, a_target, b_target):
    """(a, b, ok): the ideal point that is mapped to the given one, by damped Newton steps from the axis.

    Steps are bounded (near the rim the slope vanishes), and halved where they leave the range of validity or do not
    reduce the error in proportion to their length. A target beyond that range drives the iteration to its rim, where
    no step is short enough: not ok.
    """
    a, b, ad, bd, aa, ab, ba, bb = 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0
    a_new, b_new = a, b
    error = new_error = math.hypot(a_target, b_target)
    tolerance = 1e-13 * (1.0 + error)
    for _ in range(60):
        determinant = aa * bb - ab * ba
        da = (bb * (a_target - ad) - ab * (b_target - bd)) / determinant
        db = (aa * (b_target - bd) - ba * (a_target - ad)) / determinant
        longest = 1.0 + math.hypot(a, b)
        step = math.hypot(da, db)
        start = 1.0 if step <= longest else longest / step
        length, improved = start, False
        while length > 0.01 * start and not improved:
            a_new, b_new = a + length * da, b + length * db
            ad, bd, aa, ab, ba, bb, ok = distort(coefficients, a_new, b_new)
            new_error = math.hypot(ad - a_target, bd - b_target)
            improved = ok and new_error < (1.0 - 0.25 * length) * error
            length = 0.5 * length if error > tolerance else 0.0
        if not improved:
            break
        a, b, error = a_new, b_new, new_error
    return a, b, error <= tolerance < math.inf


@njit(cache=True, nogil=True, error_model="numpy")
def radial_limit(coefficients):
    """The radius up to which the radial part increases; inf where there is no end."""
    return math.sqrt(_squared_limit(coefficients, _FAR))


@njit(cache=True, nogil=True, error_model="numpy")
def _is_monotone(coefficients, s):
    """Whether the radial part increases all the way from the axis to the squared radius `s`."""
    k1, k2, k3, k4, d1, d2, d3, _, _, _, _, _, _ = coefficients
    if d1 == 0.0 and d2 == 0.0 and d3 == 0.0:
        falling = 3.0 * min(k1, 0.0) + s * (5.0 * min(k2, 0.0) + s * (7.0 * min(k3, 0.0) + s * 9.0 * min(k4, 0.0)))
        if 1.0 + s * falling > 0.0:
            return True
    return s < _squared_limit(coefficients, s)


@njit(cache=True, nogil=True, error_model="numpy")
def _squared_limit(coefficients, until):
    """The squared radius at which the radial part stops increasing; inf where that is beyond `until`."""
    k1, k2, k3, k4, d1, d2, d3, _, _, _, _, _, _ = coefficients
    polynomials = np.zeros((2, 8))
    for i, n in enumerate((1.0, k1, k2, k3, k4)):
        for j, d in enumerate((1.0, d1, d2, d3)):
            polynomials[0, i + j] += n * d * (1 + 2 * i - 2 * j)
            if i == 0:
                polynomials[1, j] = d
    return min(_first_root(polynomials[0], until), _first_root(polynomials[1], until))


@njit(cache=True, nogil=True, error_model="numpy")
def _first_root(polynomial, until):
    """The smallest positive root of a polynomial that is 1 at 0 (coefficients by rising degree); inf beyond `until`.

    Marches from 0; `polynomial` is overwritten by its Taylor shifts a₀ + a₁ h + … to the current place. For
    0 ≤ h ≤ reach the polynomial is at least a₀ − h f with f = Σ max(−aᵢ, 0) reachⁱ⁻¹, so it has no root before
    min(reach, a₀ / f). Stepping there ends as Newton's step at a simple root, halves the distance to a double
    one, and jumps over none.
    """
    place, reach = 0.0, 1.0
    for _ in range(500):
        fall = 0.0
        for i in range(7, 0, -1):
            fall = fall * reach + max(-polynomial[i], 0.0)
        if fall == 0.0 or place > until:
            return math.inf
        step = reach if reach * fall <= polynomial[0] else polynomial[0] / fall
        place += step
        reach = 4.0 * step
        for i in range(7):  # Taylor shift by Horner's scheme
            for j in range(6, i - 1, -1):
                polynomial[j] += step * polynomial[j + 1]
        if polynomial[0] <= 0.0 or step <= 1e-16 * place:
            break
    return place
