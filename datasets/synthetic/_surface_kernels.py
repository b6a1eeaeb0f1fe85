"""From the triangle that a ray meets to the exact point, and from there toward the lights.

Embree answers in single precision. Its triangle is kept and the distance computed anew in double precision from
the plane of the triangle, t = n·(v₀ − o) / n·d, so that depth is exact to rounding.
"""

from __future__ import annotations

import math

from numba import njit

MISS = 0xFFFFFFFF
"""Embree's triangle of a ray that meets nothing."""
SUN, LAMP = 0, 1
"""Kinds of lights: the first column of their table (L, 7), before place or direction toward it, and colour."""


@njit(cache=True, nogil=True)
def resolve(origin, directions, triangle_ids, hits, corners, distances, normals):
    """Fills distances (N,) and unit normals (N, 3) that face the origin; NaN for a miss.

    Args:
        hits: (N,) distances in single precision.
        corners: (T, 3, 3) of the triangles.
    """
    for i in range(len(directions)):
        distances[i] = normals[i, 0] = normals[i, 1] = normals[i, 2] = math.nan
        if triangle_ids[i] == MISS:
            continue
        a = corners[triangle_ids[i]]
        e1x, e1y, e1z = a[1, 0] - a[0, 0], a[1, 1] - a[0, 1], a[1, 2] - a[0, 2]
        e2x, e2y, e2z = a[2, 0] - a[0, 0], a[2, 1] - a[0, 1], a[2, 2] - a[0, 2]
        nx, ny, nz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, e1x * e2y - e1y * e2x
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx / norm, ny / norm, nz / norm
        toward = nx * directions[i, 0] + ny * directions[i, 1] + nz * directions[i, 2]
        if toward > 0.0:
            nx, ny, nz, toward = -nx, -ny, -nz, -toward
        offset = nx * (a[0, 0] - origin[0]) + ny * (a[0, 1] - origin[1]) + nz * (a[0, 2] - origin[2])
        t = offset / toward if toward < -1e-9 else math.inf
        # A ray in the plane of its triangle has no better answer than Embree's.
        distances[i] = t if abs(t - hits[i]) < 1e-3 * hits[i] else hits[i]
        normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, nz


@njit(cache=True, nogil=True)
def shadow_rays(origin, directions, distances, normals, light, lift, bundle, rows):
    """Rays from the points that face a light toward it: fills `bundle` (N, 6) and their `rows` (N,), returns how many.

    They start `lift` times the distance from the camera above the surface. A lamp is at 1 along its ray.
    """
    count = 0
    for i in range(len(directions)):
        d = distances[i]
        if math.isnan(d):
            continue
        px = origin[0] + d * directions[i, 0] + lift * d * normals[i, 0]
        py = origin[1] + d * directions[i, 1] + lift * d * normals[i, 1]
        pz = origin[2] + d * directions[i, 2] + lift * d * normals[i, 2]
        lx, ly, lz = light[1], light[2], light[3]
        if light[0] == LAMP:
            lx, ly, lz = lx - px, ly - py, lz - pz
        if lx * normals[i, 0] + ly * normals[i, 1] + lz * normals[i, 2] <= 0.0:
            continue
        bundle[count, 0], bundle[count, 1], bundle[count, 2] = px, py, pz
        bundle[count, 3], bundle[count, 4], bundle[count, 5] = lx, ly, lz
        rows[count] = i
        count += 1
    return count
