"""Pairs that follow from the order of the images alone, or from where they were taken.

Images are numbers 0 … in the order of their names; pairs i < j are sorted.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

Pair = tuple[int, int]

_EQUATOR_M, _FLATTENING = 6_378_137.0, 1 / 298.257223563
"""The ellipsoid of WGS84."""


def exhaustive_pairs(image_ids: Iterable[int]) -> list[Pair]:
    """All pairs i < j, sorted."""
    return list(itertools.combinations(sorted(set(image_ids)), 2))


def nearby_pairs(images: int, reach: int) -> list[Pair]:
    """Images at most `reach` apart in the order."""
    return [(i, j) for i in range(images) for j in range(i + 1, min(i + reach + 1, images))]


def sequential_pairs(images: int, overlap: int) -> list[Pair]:
    """Images of a sequence at most `overlap` apart, and those 2ᵏ apart for k up to `overlap`.

    The far ones cost little, and hold where some frames are blurred or show a passer-by.
    """
    doublings = [2**k for k in range(min(overlap, images.bit_length()) + 1)]
    far = {(i, i + step) for step in doublings for i in range(images - step)}
    return sorted(far.union(nearby_pairs(images, overlap)))


def spatial_pairs(positions_m: Float64[np.ndarray, "N 3"], partners: int, max_distance_m: float = 0.0) -> list[Pair]:
    """Each image with the nearest `partners` others; of equally near ones with those of the lowest numbers.

    Args:
        positions_m: NaN where a position is not known; such an image has no pairs.
        max_distance_m: of a pair at most; 0 for any.
    """
    known = np.flatnonzero(np.isfinite(positions_m).all(axis=1))
    if len(known) < 2:
        return []
    places = positions_m[known]
    tree = KDTree(places)
    wanted = min(partners + 1, len(known))
    farthest = tree.query(places, wanted)[0][:, -1]
    if max_distance_m > 0:
        farthest = np.minimum(farthest, max_distance_m)
    found: set[Pair] = set()
    for k, near in enumerate(tree.query_ball_point(places, farthest * (1 + 1e-12))):
        others = np.array(sorted(set(near) - {k}), np.int64)
        distance = np.linalg.norm(places[others] - places[k], axis=1)
        for other in others[np.argsort(distance, kind="stable")[:partners]]:
            i, j = sorted((int(known[k]), int(known[other])))
            found.add((i, j))
    return sorted(found)


def earth_centered_m(
    latitude_deg: Float64[np.ndarray, " N"],
    longitude_deg: Float64[np.ndarray, " N"],
    altitude_m: Float64[np.ndarray, " N"],
) -> Float64[np.ndarray, "N 3"]:
    """Positions on or above the ellipsoid of WGS84 in the Earth's frame, in which distances are straight lines."""
    latitude, longitude = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    squared_eccentricity = _FLATTENING * (2 - _FLATTENING)
    across = _EQUATOR_M / np.sqrt(1 - squared_eccentricity * np.sin(latitude) ** 2)
    level = (across + altitude_m) * np.cos(latitude)
    up = (across * (1 - squared_eccentricity) + altitude_m) * np.sin(latitude)
    return np.stack([level * np.cos(longitude), level * np.sin(longitude), up], axis=1)
