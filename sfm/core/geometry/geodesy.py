"""Places on the Earth: WGS84, its Earth-centred frame, and a flat frame at a place.

On the ellipsoid with half axes a and b = a (1 − f), e² = f (2 − f), a point of latitude φ, longitude λ and height h has

    N = a / √(1 − e² sin² φ)
    x = (N + h) cos φ cos λ        y = (N + h) cos φ sin λ        z = (N (1 − e²) + h) sin φ

in the frame with the equator's plane, x towards Greenwich, z towards the north pole. A scene is adjusted in the frame
(east, north, up) at one of its places, where numbers are small and up is up.

Reference:
    Bowring, Transformation from spatial to geographical coordinates, Survey Review 23(181), 1976.
"""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

_EQUATOR_M = 6_378_137.0
_FLATTENING = 1 / 298.257_223_563
_POLE_M = _EQUATOR_M * (1 - _FLATTENING)
_E2 = _FLATTENING * (2 - _FLATTENING)


def earth_from_geodetic(places: FloatArray) -> FloatArray:
    """Positions (..., 3) in m in the Earth's frame, of (latitude in degrees, longitude in degrees, height in m)."""
    latitude, longitude = np.deg2rad(places[..., 0]), np.deg2rad(places[..., 1])
    height = places[..., 2]
    across = _EQUATOR_M / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    level = (across + height) * np.cos(latitude)
    z = (across * (1 - _E2) + height) * np.sin(latitude)
    return np.stack([level * np.cos(longitude), level * np.sin(longitude), z], -1)


def geodetic_from_earth(positions: FloatArray) -> FloatArray:
    """(latitude in degrees, longitude in degrees, height in m) (..., 3) of positions in metres in the Earth's frame.

    To 1e-8 degrees and micrometres for heights up to 1,000 km. The centre of the Earth is at latitude 0.
    """
    x, y, z = np.moveaxis(positions, -1, 0)
    level = np.hypot(x, y)
    # Bowring's parametric latitude; two rounds are exact to rounding near the surface.
    beta = np.arctan2(_EQUATOR_M * z, _POLE_M * level)
    latitude = beta
    for _ in range(3):
        rise = z + _E2 / (1 - _E2) * _POLE_M * np.sin(beta) ** 3
        latitude = np.arctan2(rise, level - _E2 * _EQUATOR_M * np.cos(beta) ** 3)
        beta = np.arctan2((1 - _FLATTENING) * np.sin(latitude), np.cos(latitude))
    across = _EQUATOR_M / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    height = level * np.cos(latitude) + z * np.sin(latitude) - _EQUATOR_M**2 / across
    return np.stack([np.rad2deg(latitude), np.rad2deg(np.arctan2(y, x)), height], -1)


def local_from_earth(place: FloatArray) -> Rigid3:
    """The frame (east, north, up) at a place (latitude in degrees, longitude in degrees, height in m).

    Raises:
        ValueError: the latitude is beyond 90 degrees, or something is not finite.
    """
    if not np.all(np.isfinite(place)) or abs(place[0]) > 90:
        raise ValueError(f"expected latitude, longitude and height, got {place}")
    latitude, longitude = np.deg2rad(place[0]), np.deg2rad(place[1])
    (sp, cp), (sl, cl) = (np.sin(latitude), np.cos(latitude)), (np.sin(longitude), np.cos(longitude))
    rotation = Rotation3.from_matrix(np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]]))
    return Rigid3(rotation, -(rotation @ earth_from_geodetic(place)))
