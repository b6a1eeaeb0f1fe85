"""The colour of a surface point: procedural reflectance, band-limited to the footprint of a pixel, under the lights.

A texture is a sum of octaves of lattice noise with wavelength s = λ₀ / 2^k. The pixel's filter, a Gaussian of
variance w² / 6 (w the pixel's footprint on the surface), passes a wave of frequency 1 / 2s with the factor

    g(w / s) = exp(−2π² (w² / 6) / (2s)²) = exp(−0.8225 (w / s)²)

so each octave is attenuated by g and the sum ends where g is nothing: no aliasing from afar, and new detail as
the camera comes closer. Edges of patterns are ramps as wide as the footprint; patterns finer than it fade to
their mean by the same g. Everything is a function of position and integer seeds only, hence equal in all views.

Radiance is Lambert's, the same in all directions: L = ρ (A(n) + Σ E_l visible_l max(n·l, 0)), with reflectance ρ,
light A(n) from sky above and ground below, and lights that are suns (E constant) or lamps (E / r²).

Hashes are products of integers below 2³² masked to 32 bits: equal in machine words and in Python's integers.
All that `shade` calls is in this file: numba's cache would not notice a change elsewhere.
"""

from __future__ import annotations

import math

from numba import njit

from datasets.synthetic._surface_kernels import LAMP, MISS

SPECKLED, BRICKS, PLANKS, PRINT, GROUND, FOLIAGE = range(6)
"""Patterns; the first column of the table of materials (see `materials.py`)."""

_MASK = 0xFFFFFFFF
_DECAY = 0.8225
_MAX_OCTAVES = 24


@njit(cache=True, nogil=True)
def _mix(h):
    """Scrambles a 32-bit integer."""
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & _MASK
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & _MASK
    return h ^ (h >> 16)


@njit(cache=True, nogil=True)
def _hash3(ix, iy, iz, seed):
    """A 32-bit hash of a lattice cell."""
    return _mix(((ix * 0x0DA66343) ^ (iy * 0x58163841) ^ (iz * 0x4B1AB31F) ^ (seed * 0x165667B1)) & _MASK)


@njit(cache=True, nogil=True)
def _unit(h, byte):
    """A number in [0, 1) from 16 bits of a hash, starting at bit 8 * `byte` (0, 1 or 2)."""
    return ((h >> (8 * byte)) & 0xFFFF) / 65536.0


@njit(cache=True, nogil=True)
def _fade(t):
    return t * t * t * (t * (t * 6.0 - 15.0) + 10.0)


@njit(cache=True, nogil=True)
def value_noise(x, y, z, seed):
    """Smooth noise in [-1, 1] with lattice spacing 1: quintic blend of hashed values at the 8 corners."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    u, v, w = _fade(x - fx), _fade(y - fy), _fade(z - fz)
    total = 0.0
    for dz in range(2):
        wz = w if dz else 1.0 - w
        for dy in range(2):
            wyz = (v if dy else 1.0 - v) * wz
            low = _hash3(ix, iy + dy, iz + dz, seed) / 2147483647.5 - 1.0
            high = _hash3(ix + 1, iy + dy, iz + dz, seed) / 2147483647.5 - 1.0
            total += wyz * (low + u * (high - low))
    return total


@njit(cache=True, nogil=True)
def fbm(x, y, z, wavelength, footprint, octaves, gain, seed):
    """Sum of octaves of noise, each attenuated by the pixel's filter; of order 1, not bounded by it.

    Each octave is turned against the last, so that no axis of the lattice stands out.
    """
    total, amplitude, spacing = 0.0, 1.0, wavelength
    for k in range(octaves):
        ratio = footprint / spacing
        if ratio > 2.0:
            break
        total += (
            amplitude
            * math.exp(-_DECAY * ratio * ratio)
            * value_noise(x / spacing, y / spacing, z / spacing, seed + 101 * k)
        )
        amplitude *= gain
        spacing *= 0.5
        x, y, z = 0.8 * x + 0.6 * y, 0.8 * (0.8 * y - 0.6 * x) + 0.6 * z, 0.8 * z - 0.6 * (0.8 * y - 0.6 * x)
    return total


@njit(cache=True, nogil=True)
def _ramp(distance, width):
    """0 below, 1 above zero, with a linear ramp of the given width around it."""
    return min(1.0, max(0.0, 0.5 + distance / width))


@njit(cache=True, nogil=True)
def _spots(x, y, z, spacing, footprint, density, seed):
    """Signed strength in [-1, 1] of a ball in each cell of a lattice, cut by the surface; 0 between balls."""
    ratio = footprint / spacing
    x, y, z = x / spacing, y / spacing, z / spacing
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    h = _hash3(int(fx), int(fy), int(fz), seed)
    g = _mix(h ^ 0x5BD1E995)
    if _unit(g, 0) > density:
        return 0.0
    radius = 0.2 + 0.25 * _unit(g, 1)
    free = 1.0 - 2.0 * radius
    dx = x - fx - radius - free * _unit(h, 0)
    dy = y - fy - radius - free * _unit(h, 1)
    dz = z - fz - radius - free * _unit(h, 2)
    inside = _ramp(radius - math.sqrt(dx * dx + dy * dy + dz * dz), max(ratio, 0.06))
    # A ball is about two thirds of its cell wide.
    return math.exp(-2.25 * _DECAY * ratio * ratio) * inside * (2.0 * _unit(g, 2) - 1.0)


@njit(cache=True, nogil=True)
def _all_spots(x, y, z, wavelength, footprint, density, seed):
    """Spots at every fourth of a scale, until they are finer than the footprint."""
    total, spacing = 0.0, wavelength
    for k in range(_MAX_OCTAVES):
        if footprint > 1.3 * spacing:
            break
        total += _spots(x, y, z, spacing, footprint, density, seed + 57 * k)
        spacing *= 0.37
        x, z = 0.6 * x + 0.8 * z, 0.6 * z - 0.8 * x
    return total


@njit(cache=True, nogil=True)
def _joint(inside, joint, footprint):
    """Share of a line of width `joint` in a pixel, where `inside` is the distance from its edge into the field.

    Where the line is thinner than the pixel, its middle has the share joint / footprint.
    """
    ramp = max(footprint, 0.3 * joint)
    return (1.0 - _ramp(inside, ramp)) * min(1.0, 2.0 * joint / (ramp + joint))


@njit(cache=True, nogil=True)
def _bricks(u, v, width, height, joint, footprint, seed):
    """Courses of bricks: (share of the joint, two random numbers of the brick, which fade to ½ from afar)."""
    row = math.floor(v / height)
    shifted = u / width + 0.5 * (row - 2.0 * math.floor(row / 2.0))
    column = math.floor(shifted)
    du = (0.5 - abs(shifted - column - 0.5)) * width - 0.5 * joint
    dv = (0.5 - abs(v / height - row - 0.5)) * height - 0.5 * joint
    fade = math.exp(-_DECAY * (footprint / height) ** 2)
    h = _hash3(int(column), int(row), 7, seed)
    return (
        fade * _joint(min(du, dv), joint, footprint),
        0.5 + fade * (_unit(h, 0) - 0.5),
        0.5 + fade * (_unit(h, 1) - 0.5),
    )


@njit(cache=True, nogil=True)
def _patch(u, v, size, footprint, seed):
    """One square of the patchwork at (u, v).

    Returns (mix of the colours 1 and 2, share of colour 3), each in [0, 1], and the square's middle and side.
    """
    h, level = 0, 0
    for k in range(6):
        level = k
        h = _hash3(math.floor(u / size), math.floor(v / size), k, seed)
        if _unit(h, 2) > 0.72 or k == 5:
            break
        size *= 0.5
    cu, cv = (math.floor(u / size) + 0.5) * size, (math.floor(v / size) + 0.5) * size
    x, y = (u - cu) / size, (v - cv) / size
    ramp = max(1.5 * footprint / size, 0.02)
    g = _mix(h ^ (((level + 1) * 0x2C1B3C6D) & _MASK))
    figure, r = g & 7, 0.16 + 0.3 * _unit(g, 1)
    if figure < 2:
        inside = _ramp(r - math.sqrt(x * x + y * y), ramp)
    elif figure < 4:
        inside = _ramp(r - abs(x) - abs(y), ramp)
    elif figure == 4:
        inside = _ramp(x + (2.0 * r - 0.6) * y, ramp)
    elif figure == 5:
        inside = _ramp(0.07 - abs(math.sqrt(x * x + y * y) - r), ramp)
    elif figure == 6:
        inside = _ramp(0.12 - abs(x + (r - 0.3) * y), ramp)
    else:
        inside = 0.0
    # The figures are about half as wide as the square; a quarter of all squares is covered by them.
    fade = math.exp(-_DECAY * (2.0 * footprint / size) ** 2)
    return 0.5 + fade * (_unit(h, 0) - 0.5), 0.26 + fade * (inside - 0.26), cu, cv, size


@njit(cache=True, nogil=True)
def _print(u, v, size, footprint, seed):
    """A printed patchwork: squares that split at random into quarters, each with a figure of its own.

    Within a footprint of its border a square is blended with its image mirrored at the border, that is with the
    neighbour, so that borders are filtered, too. Returns (mix of the colours 1 and 2, share of colour 3).
    """
    tone, figure, cu, cv, side = _patch(u, v, size, footprint, seed)
    du, dv = 0.5 * side - abs(u - cu), 0.5 * side - abs(v - cv)
    if min(du, dv) < footprint:
        if du < dv:
            u += 2.0 * du if u > cu else -2.0 * du
        else:
            v += 2.0 * dv if v > cv else -2.0 * dv
        other_tone, other_figure, cu, cv, side = _patch(u, v, size, footprint, seed)
        own = 0.5 + 0.5 * min(du, dv) / footprint
        tone, figure = other_tone + own * (tone - other_tone), other_figure + own * (figure - other_figure)
    return tone, figure


@njit(cache=True, nogil=True)
def _blend(out, row, a, b, t):
    """out = a + t (b − a) over the three channels; a and b start at columns of the material's row."""
    for c in range(3):
        out[c] = row[a + c] + t * (row[b + c] - row[a + c])


@njit(cache=True, nogil=True)
def _toward(out, row, b, t):
    """out moves by the share t toward the colour at column b."""
    for c in range(3):
        out[c] += t * (row[b + c] - out[c])


@njit(cache=True, nogil=True)
def albedo(out, row, point, normal, footprint):
    """Fills `out` with the linear RGB reflectance of a material at a texture point.

    Args:
        row: a row of the table of materials: pattern, seed, wavelength, contrast, colours 1 to 3, three sizes.
        point, normal: in the coordinates of the texture, metres.
        footprint: width of the pixel on the surface, metres.
    """
    pattern, seed, wavelength, contrast = int(row[0]), int(row[1]), row[2], row[3]
    x, y, z = point[0], point[1], point[2]
    # The plane of a flat pattern is the one that the face is closest to.
    ax, ay, az = abs(normal[0]), abs(normal[1]), abs(normal[2])
    if az >= ax and az >= ay:
        u, v = x, y
    elif ax >= ay:
        u, v = y, z
    else:
        u, v = x, z
    broad = fbm(x, y, z, 2.0 * wavelength, footprint, 3, 0.7, seed + 11)
    detail = fbm(x, y, z, wavelength, footprint, _MAX_OCTAVES, 0.88, seed)
    spots = _all_spots(x, y, z, 0.5 * wavelength, footprint, 0.75, seed + 23)
    mix = min(1.0, max(0.0, 0.5 + 0.6 * broad))
    if pattern == BRICKS:
        joint, tone, level = _bricks(u, v, row[13], row[14], row[15], footprint, seed)
        _blend(out, row, 4, 7, min(1.0, max(0.0, 0.25 * broad + tone)))
        for c in range(3):
            out[c] *= 0.75 + 0.5 * level
        _toward(out, row, 10, joint)
    elif pattern == PLANKS:
        board = math.floor(v / row[13])
        h = _hash3(int(board), 3, 5, seed)
        grain = fbm(u * 0.12 + 17.0 * _unit(h, 1), v, z, 0.25 * row[13], footprint, _MAX_OCTAVES, 0.9, seed + 31)
        gap = (0.5 - abs(v / row[13] - board - 0.5)) * row[13] - 0.5 * row[15]
        fade = math.exp(-_DECAY * (footprint / row[13]) ** 2)
        _blend(out, row, 4, 7, min(1.0, max(0.0, 0.5 + 0.4 * fade * (_unit(h, 0) - 0.5) + 0.35 * grain)))
        _toward(out, row, 10, fade * _joint(gap, row[15], footprint))
    elif pattern == PRINT:
        tone, figure = _print(u, v, row[13], footprint, seed)
        _blend(out, row, 4, 7, tone)
        _toward(out, row, 10, figure)
    elif pattern == GROUND:
        # Steep faces show rock (colour 3); level ones grass and soil (1 and 2).
        _blend(out, row, 4, 7, min(1.0, max(0.0, 0.5 + 1.5 * broad)))
        _toward(out, row, 10, _ramp(row[13] - az + 0.1 * detail, 0.08))
    elif pattern == FOLIAGE:
        _blend(out, row, 4, 7, mix)
        _toward(out, row, 10, min(1.0, max(0.0, 0.5 * detail)))
        contrast *= 1.5
    else:
        _blend(out, row, 4, 7, mix)
        _toward(out, row, 10, min(0.8, max(0.0, 0.5 * broad - 0.3 + 0.4 * spots)))
    gain = math.exp(contrast * detail + 1.2 * contrast * spots)
    for c in range(3):
        out[c] = min(0.95, out[c] * gain)


@njit(cache=True, nogil=True)
def fbm_at(points, wavelength, octaves, gain, seed, out):
    """Fills `out` (N,) with noise at points (N, 3), unfiltered: relief for the shapes."""
    for i in range(points.shape[0]):
        out[i] = fbm(points[i, 0], points[i, 1], points[i, 2], wavelength, 0.0, octaves, gain, seed)


@njit(cache=True, nogil=True)
def shade(
    origin, directions, angles, triangle_ids, distances, normals, lit, surface, materials, lights, ambient, out
):  # fmt: skip
    """Fills `out` (N, 3) with linear RGB radiance.

    Args:
        angles: (N,) radians between neighbouring samples.
        lit: (N, L) 1 where a light sees the point.
        surface: corners, texture corners, shading normals (T, 3, 3), texture normals (T, 3), material rows (T,).
        materials: see `albedo`.
        lights: (L, 7) kind, place or direction toward it, colour.
        ambient: (4, 3) light from above and from below, sky at the zenith and at the horizon.
    """
    corners, texture_corners, shading_normals, texture_normals, material_rows = surface
    for i in range(len(directions)):
        if triangle_ids[i] == MISS:
            high = math.sqrt(max(0.0, directions[i, 2]))
            for c in range(3):
                out[i, c] = ambient[3, c] + high * (ambient[2, c] - ambient[3, c])
            continue
        k = triangle_ids[i]
        d = distances[i]
        px, py, pz = (
            origin[0] + d * directions[i, 0],
            origin[1] + d * directions[i, 1],
            origin[2] + d * directions[i, 2],
        )
        a = corners[k]
        b1, b2 = _barycentric(a, px, py, pz)
        b0 = 1.0 - b1 - b2
        t, s = texture_corners[k], shading_normals[k]
        point = (
            b0 * t[0, 0] + b1 * t[1, 0] + b2 * t[2, 0],
            b0 * t[0, 1] + b1 * t[1, 1] + b2 * t[2, 1],
            b0 * t[0, 2] + b1 * t[1, 2] + b2 * t[2, 2],
        )
        nx = b0 * s[0, 0] + b1 * s[1, 0] + b2 * s[2, 0]
        ny = b0 * s[0, 1] + b1 * s[1, 1] + b2 * s[2, 1]
        nz = b0 * s[0, 2] + b1 * s[1, 2] + b2 * s[2, 2]
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        if nx * normals[i, 0] + ny * normals[i, 1] + nz * normals[i, 2] < 0.0:
            norm = -norm
        nx, ny, nz = nx / norm, ny / norm, nz / norm
        cosine = -(
            normals[i, 0] * directions[i, 0] + normals[i, 1] * directions[i, 1] + normals[i, 2] * directions[i, 2]
        )
        # Between the pixel's short and its long side: less blur than the long one, little aliasing.
        footprint = d * angles[i] / max(cosine, 0.15) ** 0.75
        albedo(out[i], materials[material_rows[k]], point, texture_normals[k], footprint)
        r = g = b = 0.0
        for m in range(lights.shape[0]):
            if lit[i, m]:
                lx, ly, lz, power = lights[m, 1], lights[m, 2], lights[m, 3], 1.0
                if lights[m, 0] == LAMP:
                    lx, ly, lz = lx - px, ly - py, lz - pz
                    square = lx * lx + ly * ly + lz * lz
                    power = 1.0 / (square * math.sqrt(square))
                power *= max(0.0, nx * lx + ny * ly + nz * lz)
                r, g, b = r + power * lights[m, 4], g + power * lights[m, 5], b + power * lights[m, 6]
        up = 0.5 + 0.5 * nz
        out[i, 0] *= r + ambient[1, 0] + up * (ambient[0, 0] - ambient[1, 0])
        out[i, 1] *= g + ambient[1, 1] + up * (ambient[0, 1] - ambient[1, 1])
        out[i, 2] *= b + ambient[1, 2] + up * (ambient[0, 2] - ambient[1, 2])


@njit(cache=True, nogil=True)
def _barycentric(a, px, py, pz):
    """Weights of corners 1 and 2 of the triangle `a` for a point of its plane."""
    e1x, e1y, e1z = a[1, 0] - a[0, 0], a[1, 1] - a[0, 1], a[1, 2] - a[0, 2]
    e2x, e2y, e2z = a[2, 0] - a[0, 0], a[2, 1] - a[0, 1], a[2, 2] - a[0, 2]
    qx, qy, qz = px - a[0, 0], py - a[0, 1], pz - a[0, 2]
    d11 = e1x * e1x + e1y * e1y + e1z * e1z
    d12 = e1x * e2x + e1y * e2y + e1z * e2z
    d22 = e2x * e2x + e2y * e2y + e2z * e2z
    q1 = qx * e1x + qy * e1y + qz * e1z
    q2 = qx * e2x + qy * e2y + qz * e2z
    det = d11 * d22 - d12 * d12
    return (d22 * q1 - d12 * q2) / det, (d11 * q2 - d12 * q1) / det
