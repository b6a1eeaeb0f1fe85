"""Enhanced unified camera model: projection on an ellipsoid, then through a shifted centre.

    d = √(β (x² + y²) + z²),   m = α d + (1 − α) z,   (a, b) = (x, y) / m

with α in [0, 1], β > 0. It is one to one where m > 0 and, for α > ½, z > −d (1 − α)/α.

Reference:
    Khomutenko, Garcia, Martinet, An Enhanced Unified Camera Model, RA-L 2016.
"""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def ellipsoidal(alpha, beta, x, y, z):
    """(a, b, the derivatives of a by x, y, z, those of b, ok)."""
    d = math.sqrt(max(beta * (x * x + y * y) + z * z, 0.0))
    m = alpha * d + (1.0 - alpha) * z
    if not (m > 0.0 and d > 0.0 and (alpha <= 0.5 or alpha * z > (alpha - 1.0) * d)):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
    q = 1.0 / m
    a, b = x * q, y * q
    stretch = alpha * beta * q / d  # ∂m/∂x = stretch x m
    forward = (alpha * z / d + 1.0 - alpha) * q
    cross = -a * y * stretch
    return a, b, q - a * x * stretch, cross, -a * forward, cross, q - b * y * stretch, -b * forward, True


@njit(cache=True, nogil=True, error_model="numpy")
def ellipsoidal_by_shape(alpha, beta, x, y, z):
    """(∂m/∂α, ∂m/∂β) / m."""
    rho2 = x * x + y * y
    d = math.sqrt(beta * rho2 + z * z)
    m = alpha * d + (1.0 - alpha) * z
    return (d - z) / m, 0.5 * alpha * rho2 / (d * m)


@njit(cache=True, nogil=True, error_model="numpy")
def ray_from_ellipsoidal(alpha, beta, a, b):
    """(x, y, z, ok): the unit ray; not ok beyond the rim of the model (α > ½)."""
    r2 = a * a + b * b
    inside = 1.0 - (2.0 * alpha - 1.0) * beta * r2
    if not inside > 0.0:
        return 0.0, 0.0, 0.0, False
    z = (1.0 - alpha * alpha * beta * r2) / (alpha * math.sqrt(inside) + 1.0 - alpha)
    q = 1.0 / math.sqrt(r2 + z * z)
    return a * q, b * q, z * q, q > 0.0
