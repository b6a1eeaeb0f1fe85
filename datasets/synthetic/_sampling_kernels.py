"""Which pixels need more than one ray, and the sum over those rays (see `render.py`)."""

from __future__ import annotations

import math

from numba import njit

from datasets.synthetic._surface_kernels import MISS


@njit(cache=True, nogil=True)
def find_mixed(shapes, triangle_ids, lit, origin, directions, distances, normals, crease, gap, grazing, out):
    """Sets `out` (H, W) where a pixel and one of its 8 neighbours are not one surface in one light, or at grazing.

    Args:
        shapes: (T,) the shape of each triangle; the other arrays have a row for each pixel.
        crease: cosine between normals below which there is an edge.
        gap: distance of the neighbour from the tangent plane, as a share of the distance, above which there is one.
        grazing: cosine of incidence below which a pixel is set for itself.
    """
    height, width = out.shape
    for y in range(height):
        for x in range(width):
            i = y * width + x
            hit = triangle_ids[i] != MISS
            if hit:
                cosine = 0.0
                for c in range(3):
                    cosine -= normals[i, c] * directions[i, c]
                if cosine < grazing:
                    out[y, x] = True
            # Each pair of neighbours once: right, and the three below.
            for step in range(4):
                v, u = (y, x + 1) if step == 0 else (y + 1, x + step - 2)
                if v >= height or u < 0 or u >= width:
                    continue
                j = v * width + u
                mixed = hit != (triangle_ids[j] != MISS)
                if hit and not mixed and triangle_ids[i] != triangle_ids[j]:
                    cosine, away = 0.0, 0.0
                    for c in range(3):
                        cosine += normals[i, c] * normals[j, c]
                        away += normals[i, c] * (distances[j] * directions[j, c] - distances[i] * directions[i, c])
                    mixed = (
                        shapes[triangle_ids[i]] != shapes[triangle_ids[j]]
                        or cosine < crease
                        or abs(away) > gap * distances[i]
                    )
                if hit and not mixed:
                    for m in range(lit.shape[1]):
                        mixed = mixed or lit[i, m] != lit[j, m]
                if mixed:
                    out[y, x] = out[v, u] = True


@njit(cache=True, nogil=True)
def place_nodes(refine, samples, nodes, pixels):
    """Numbers the lattice nodes that the pixels of `refine` need, row by row; returns how many.

    Args:
        nodes: ((H + 1) s − 1, (W + 1) s − 1) filled with −1; becomes the number of the node.
        pixels: (at least the number of nodes, 2) receives their places in px.
    """
    height, width = refine.shape
    for y in range(height):
        for x in range(width):
            if refine[y, x]:
                for r in range(y * samples, y * samples + 2 * samples - 1):
                    for c in range(x * samples, x * samples + 2 * samples - 1):
                        nodes[r, c] = -2
    count = 0
    for r in range(nodes.shape[0]):
        for c in range(nodes.shape[1]):
            if nodes[r, c] == -2:
                nodes[r, c] = count
                pixels[count, 0] = (c - samples + 1) / samples + 0.5
                pixels[count, 1] = (r - samples + 1) / samples + 0.5
                count += 1
    return count


@njit(cache=True, nogil=True)
def sum_tent(refine, samples, nodes, radiance, image):
    """Sets the pixels of `refine` in `image` (H, W, 3) to the tent-weighted sum of their nodes' radiance (M, 3)."""
    height, width = refine.shape
    for y in range(height):
        for x in range(width):
            if not refine[y, x]:
                continue
            for c in range(3):
                total = 0.0
                for b in range(1 - samples, samples):
                    for a in range(1 - samples, samples):
                        node = nodes[(y + 1) * samples - 1 + b, (x + 1) * samples - 1 + a]
                        total += (samples - abs(a)) * (samples - abs(b)) * radiance[node, c]
                image[y, x, c] = total / math.pow(samples, 4)
