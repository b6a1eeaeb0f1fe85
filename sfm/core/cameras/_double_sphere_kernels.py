"""Double sphere model: projection on a unit sphere, then on a second one ξ behind it, then through a shifted centre.

    d₁ = √(x² + y² + z²),   w = ξ d₁ + z,   d₂ = √(x² + y² + w²),   m = α d₂ + (1 − α) w,   (a, b) = (x, y) / m

with α in [0, 1]; ξ = 0 is the unified model. The angle on the second sphere grows with that on the first where
d₁ + ξ z > 0, always so for |ξ| < 1, and the image is one to one in it where m > 0 and, for α > ½, w > −d₂ (1 − α)/α.

Reference:
    Usenko, Demmel, Cremers, The Double Sphere Camera Model, 3DV 2018.
"""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def double_spherical(xi, alpha, x, y, z):
    """(a, b, the derivatives of a by x, y, z, those of b, ok)."""
    d1 = math.sqrt(x * x + y * y + z * z)
    w = xi * d1 + z
    d2 = math.sqrt(x * x + y * y + w * w)
    m = alpha * d2 + (1.0 - alpha) * w
    unfolded = d1 + xi * z > 0.0 and (alpha <= 0.5 or alpha * w > (alpha - 1.0) * d2)
    if not (m > 0.0 and d2 > 0.0 and unfolded):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
    q = 1.0 / m
    a, b = x * q, y * q
    by_w = alpha * w / d2 + 1.0 - alpha
    stretch = (alpha / d2 + by_w * xi / d1) * q  # ∂m/∂x = stretch x m
    forward = by_w * (xi * z / d1 + 1.0) * q
    cross = -a * y * stretch
    return a, b, q - a * x * stretch, cross, -a * forward, cross, q - b * y * stretch, -b * forward, True


@njit(cache=True, nogil=True, error_model="numpy")
def double_spherical_by_shape(xi, alpha, x, y, z):
    """(∂m/∂ξ, ∂m/∂α) / m."""
    d1 = math.sqrt(x * x + y * y + z * z)
    w = xi * d1 + z
    d2 = math.sqrt(x * x + y * y + w * w)
    q = 1.0 / (alpha * d2 + (1.0 - alpha) * w)
    return d1 * (alpha * w / d2 + 1.0 - alpha) * q, (d2 - w) * q


@njit(cache=True, nogil=True, error_model="numpy")
def ray_from_double_sphere(xi, alpha, a, b):
    """(x, y, z, ok): the unit ray; not ok beyond the rim of either sphere."""
    r2 = a * a + b * b
    inside = 1.0 - (2.0 * alpha - 1.0) * r2
    if not inside > 0.0:
        return 0.0, 0.0, 0.0, False
    w = (1.0 - alpha * alpha * r2) / (alpha * math.sqrt(inside) + 1.0 - alpha)
    reach = w * w + (1.0 - xi * xi) * r2
    if not reach > 0.0:
        return 0.0, 0.0, 0.0, False
    scale = (w * xi + math.sqrt(reach)) / (w * w + r2)
    x, y, z = scale * a, scale * b, scale * w - xi
    q = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * q, y * q, z * q, scale > 0.0
