"""Robust losses as scalar kernels; the mathematics is in `losses`."""

from __future__ import annotations

import math

import numba as nb

TRIVIAL, HUBER, SOFT_L1, CAUCHY, TUKEY, TRUNCATED = 0, 1, 2, 3, 4, 5


@nb.njit(cache=True, nogil=True, error_model="numpy")
def loss_and_weight(kind, scale, s):
    """(ρ(s), ρ'(s)) of a squared residual."""
    a2 = scale * scale
    if kind == HUBER:
        if s <= a2:
            return s, 1.0
        r = math.sqrt(s)
        return 2.0 * scale * r - a2, scale / r
    if kind == SOFT_L1:
        root = math.sqrt(1.0 + s / a2)
        # The plain form cancels far below the scale; the other is not a number where s is infinite.
        rho = 2.0 * s / (1.0 + root) if s < a2 else 2.0 * a2 * (root - 1.0)
        return rho, 1.0 / root
    if kind == CAUCHY:
        return a2 * math.log1p(s / a2), 1.0 / (1.0 + s / a2)
    if kind == TUKEY:
        x = min(s / a2, 1.0)
        return a2 * x * (1.0 - x * (1.0 - x / 3.0)), (1.0 - x) * (1.0 - x)
    if kind == TRUNCATED and s > a2:
        return a2, 0.0
    return s, 1.0
