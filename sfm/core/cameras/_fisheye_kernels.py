"""The equidistant map: a ray at angle θ from the axis goes to (a, b) = θ (x, y) / ρ, ρ = √(x² + y²).

θ = atan2(ρ, z) reaches to π, so rays from behind the image plane have a place; only the ray straight back has none.
"""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def equidistant(x, y, z):
    """(a, b, the derivatives of a by x, y, z, those of b, ok)."""
    rho = math.hypot(x, y)
    if rho <= 1e-10 * z:  # θ/ρ = (1 − (ρ/z)²/3 …)/z is 1/z to the last bit, and 0/0 is avoided on the axis
        q = 1.0 / z if z > 0.0 else math.nan
        return x * q, y * q, q, 0.0, -x * q * q, 0.0, q, -y * q * q, z > 0.0
    if not rho > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
    n2 = rho * rho + z * z
    q = math.atan2(rho, z) / rho
    x_unit, y_unit = x / rho, y / rho
    bend = z / n2 - q
    cross = x_unit * y_unit * bend
    return x * q, y * q, q + x_unit * x_unit * bend, cross, -x / n2, cross, q + y_unit * y_unit * bend, -y / n2, True


@njit(cache=True, nogil=True, error_model="numpy")
def ray_from_equidistant(a, b):
    """(x, y, z, ok): the unit ray; not ok at or beyond θ = π."""
    theta = math.hypot(a, b)
    if not theta < math.pi:
        return 0.0, 0.0, 0.0, False
    sinc = math.sin(theta) / theta if theta > 0.0 else 1.0
    return a * sinc, b * sinc, math.cos(theta), True
