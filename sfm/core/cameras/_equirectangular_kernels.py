"""Equirectangular panorama: (a, b) = (longitude, latitude) = (atan2(x, z), atan2(y, √(x² + z²))), y being down.

The optical axis is in the middle of the image. The seam, straight behind, is both the left and the right border;
the rays straight up and down have no longitude and hence no pixel of their own.
"""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def longitude_latitude(x, y, z):
    """(a, b, the derivatives of a by x, y, z, those of b, ok)."""
    level2 = x * x + z * z
    if not level2 > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
    level = math.sqrt(level2)
    n2 = level2 + y * y
    tilt = -y / (level * n2)
    return math.atan2(x, z), math.atan2(y, level), z / level2, 0.0, -x / level2, x * tilt, level / n2, z * tilt, True


@njit(cache=True, nogil=True, error_model="numpy")
def ray_from_longitude_latitude(longitude, latitude):
    """(x, y, z, ok): the unit ray; not ok above the zenith or below the nadir."""
    if not (abs(latitude) <= 0.5 * math.pi and math.isfinite(longitude)):
        return 0.0, 0.0, 0.0, False
    level = math.cos(latitude)
    return level * math.sin(longitude), math.sin(latitude), level * math.cos(longitude), True
