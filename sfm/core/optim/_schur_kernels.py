"""Kernels of the elimination; the mathematics and the layout are in `schur`.

`contract` lets the compiler fuse a product with the sum after it; it reorders nothing and keeps NaN.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from sfm.core.optim._block_kernels import subtract_product

_RELATIVE_FLOOR = 1e-8
_PIVOT_FLOOR = 1e-15


@nb.njit(cache=True, nogil=True, error_model="numpy")
def damped_diagonal(v, damping):
    """λ times the diagonal of a 3×3 block (xx, xy, xz, yy, yz, zz), each entry at least a part of the trace."""
    floor = _RELATIVE_FLOOR * (v[0] + v[3] + v[5])
    return damping * max(v[0], floor), damping * max(v[3], floor), damping * max(v[5], floor)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def invert_blocks(first, last, V, damping, M):
    """M = (V + λ D)⁻¹ for blocks `first:last`, through Cholesky factors; zero where V is zero."""
    for p in range(first, last):
        v = V[p]
        trace = v[0] + v[3] + v[5]
        if not trace > 0.0:
            M[p, :] = 0.0
            continue
        dx, dy, dz = damped_diagonal(v, damping)
        floor = _PIVOT_FLOOR * trace
        a = 1.0 / math.sqrt(max(v[0] + dx, floor))
        l10, l20 = v[1] * a, v[2] * a
        c = 1.0 / math.sqrt(max(v[3] + dy - l10 * l10, floor))
        l21 = (v[4] - l20 * l10) * c
        f = 1.0 / math.sqrt(max(v[5] + dz - l20 * l20 - l21 * l21, floor))
        # The inverse factor, row by row: (a), (b, c), (d, e, f).
        b = -l10 * a * c
        e = -l21 * c * f
        d = -(l20 * a + l21 * b) * f
        M[p, 0], M[p, 1], M[p, 2] = a * a + b * b + d * d, b * c + d * e, d * f
        M[p, 3], M[p, 4], M[p, 5] = c * c + e * e, e * f, f * f


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def eliminate_poses(order, starts, point, slot, W, M, g, border_offsets, border_slot, B, S, border, b):
    """Subtracts W M Wᵀ from the rows of S and the border, and adds W M g to b, for the couplings in `order`.

    Args:
        order: couplings whose rows this call owns. Within a row points must not fall: the order of summation.
        starts: (P,) first coupling of a point that has a slot; from there on slots do not fall.
        point, slot, W: point (n,), block row (n,) and block (n, 3, 6), transposed, of the couplings.
        M, g: inverse blocks (P, 6) and gradients (P, 3) of the points.
        border_offsets, border_slot, B: couplings of the border, (P + 1,), (E,), (E, 3, K), transposed.
        S: (I (I + 1) / 2, 6, 6) the blocks of the lower triangle, row by row.
        border: (I, C K, 6); b: (I, 6).
    """
    Y = np.empty((6, 3))
    size = B.shape[2]
    for index in range(len(order)):
        o = order[index]
        p, i = point[o], slot[o]
        m0, m1, m2, m3, m4, m5 = M[p, 0], M[p, 1], M[p, 2], M[p, 3], M[p, 4], M[p, 5]
        g0, g1, g2 = g[p, 0], g[p, 1], g[p, 2]
        w = W[o]
        for r in range(6):
            Y[r, 0] = w[0, r] * m0 + w[1, r] * m1 + w[2, r] * m2
            Y[r, 1] = w[0, r] * m1 + w[1, r] * m3 + w[2, r] * m4
            Y[r, 2] = w[0, r] * m2 + w[1, r] * m4 + w[2, r] * m5
            b[i, r] += Y[r, 0] * g0 + Y[r, 1] * g1 + Y[r, 2] * g2
        row = S[i * (i + 1) // 2 : (i + 1) * (i + 2) // 2]
        for j in range(starts[p], o + 1):
            subtract_product(row[slot[j]], Y, W[j])
            if slot[j] == i and j != o:
                # An image that sees the point twice: the mirrored product falls on the same block.
                for r in range(6):
                    for c in range(6):
                        row[i, c, r] -= Y[r, 0] * W[j, 0, c] + Y[r, 1] * W[j, 1, c] + Y[r, 2] * W[j, 2, c]
        for e in range(border_offsets[p], border_offsets[p + 1]):
            below = border_slot[e] * size
            for c in range(size):
                x, y, z = B[e, 0, c], B[e, 1, c], B[e, 2, c]
                for r in range(6):
                    border[i, below + c, r] -= Y[r, 0] * x + Y[r, 1] * y + Y[r, 2] * z


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def eliminate_border(order, starts, point, slot, B, M, g, S, b):
    """The same for the border itself: B M Bᵀ off the rows of S (C K, C K), and B M g onto b (C K)."""
    size = B.shape[2]
    for index in range(len(order)):
        o = order[index]
        p = point[o]
        row = slot[o] * size
        m0, m1, m2, m3, m4, m5 = M[p, 0], M[p, 1], M[p, 2], M[p, 3], M[p, 4], M[p, 5]
        for r in range(size):
            y0 = B[o, 0, r] * m0 + B[o, 1, r] * m1 + B[o, 2, r] * m2
            y1 = B[o, 0, r] * m1 + B[o, 1, r] * m3 + B[o, 2, r] * m4
            y2 = B[o, 0, r] * m2 + B[o, 1, r] * m4 + B[o, 2, r] * m5
            b[row + r] += y0 * g[p, 0] + y1 * g[p, 1] + y2 * g[p, 2]
            for j in range(starts[p], o + 1):
                column = slot[j] * size
                for c in range(size):
                    S[row + r, column + c] -= y0 * B[j, 0, c] + y1 * B[j, 1, c] + y2 * B[j, 2, c]
