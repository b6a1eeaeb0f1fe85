"""Robust losses ρ of squared errors.

    truncated       min(r², s²)
    Cauchy          s² log(1 + r² / s²)
    marginalised    s² (2 x − x²), x = min(r / s, 1): the mean of min(r² / ε², 1) s² over all bounds ε from 0 to s

The last is that of an unknown noise level: a model gains by every datum that comes nearer, however near it is already.

Reference:
    Barath, Noskova, Ivashechkin & Matas, MAGSAC++, CVPR 2020, for scores that are marginalised over the noise.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Of a type that numba has no literals of: functions would be compiled once for each of these numbers.
TRUNCATED, CAUCHY, MARGINALIZED = np.int64(0), np.int64(1), np.int64(2)
# Below this r / s the weight of the marginalised loss, which is infinite at 0, stays what it is here.
_SMALLEST = 0.05


@njit(cache=True, nogil=True, error_model="numpy")
def robust_weight(square, loss, square_scale, max_square):
    """ρ and dρ/d(r²) at r² = square, for the scale s² = square_scale; ρ stays what it is at `max_square` from there on.

    The truncated and the marginalised loss have no scale but `max_square`.
    """
    inside = square < max_square
    square = square if inside else max_square
    if loss == CAUCHY:
        ratio = 1.0 + square / square_scale
        return square_scale * np.log(ratio), 1.0 / ratio if inside else 0.0
    if not inside:
        return max_square, 0.0
    if loss == TRUNCATED:
        return square, 1.0
    x = np.sqrt(square / max_square)
    return max_square * x * (2.0 - x), 1.0 / max(x, _SMALLEST) - 1.0
