"""Kernels of the elimination of points; the mathematics and the layout are in `schur`.

`contract` lets the compiler fuse a product with the sum after it; it reorders nothing and keeps NaN.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from sfm.core.optim._block_kernels import (
    WIDTH,
    copy_coupling,
    couple_pose,
    couple_shared,
    set_coupling,
    subtract_product,
    subtract_upper,
)

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


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _by_columns(y):
    """The first six columns of a 3×8 matrix, one after the other."""
    return (
        y[0, 0], y[1, 0], y[2, 0], y[0, 1], y[1, 1], y[2, 1], y[0, 2], y[1, 2], y[2, 2],
        y[0, 3], y[1, 3], y[2, 3], y[0, 4], y[1, 4], y[2, 4], y[0, 5], y[1, 5], y[2, 5],
    )  # fmt: skip


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def eliminate(
    first_row, last_row, narrow, starts, slot, N, shared_starts, shared_slot, B, centers, X, M, g, offsets, columns,
    blocks, side, diagonal,
):  # fmt: skip
    """Adds the poses' own blocks to the rows `first_row:last_row` of S and takes off what goes with the points.

    Blocks that the pattern lacks are left out. `diagonal` gets what the poses' own blocks have there.

    Args:
        narrow: whether no shared row has more than three unknowns.
        starts, slot, N: by point (P + 1,), the row of each coupling with a pose (E,), ascending, and its (E, 6).
        shared_starts, shared_slot, B: the same for shared rows, which lie behind those of poses; (G, 3, 6).
        centers: (S, 3) of the poses by row; X: (P, 3).
        M, g: inverse blocks (P, 6), zero for points that do not move, and gradients (P, 3).
        offsets, columns: the pattern of `blocks` (·, 6, 8), rows padded; side, diagonal: (rows, 8).
    """
    longest = 1
    for p in range(len(X)):
        longest = max(longest, starts[p + 1] - starts[p] + shared_starts[p + 1] - shared_starts[p])
    W, rows = np.zeros((longest, 3, WIDTH)), np.empty(longest, np.int64)
    Y, Z = np.zeros((3, WIDTH)), np.zeros((3, WIDTH))
    for p in range(len(X)):
        poses, shared = starts[p + 1] - starts[p], shared_starts[p + 1] - shared_starts[p]
        first, last = starts[p], shared_starts[p]
        count = poses + shared
        if count == 0 or (shared_slot[last + shared - 1] if shared > 0 else slot[first + poses - 1]) < first_row:
            continue
        information = (M[p, 0], M[p, 1], M[p, 2], M[p, 3], M[p, 4], M[p, 5])
        gradient = (g[p, 0], g[p, 1], g[p, 2])
        moves = M[p, 0] + M[p, 3] + M[p, 5] > 0.0
        for k in range(count):
            is_pose = k < poses
            i = slot[first + k] if is_pose else shared_slot[last + k - poses]
            if i >= last_row:
                break
            rows[k] = i
            mine = i >= first_row
            if is_pose:
                u = (X[p, 0] - centers[i, 0], X[p, 1] - centers[i, 1], X[p, 2] - centers[i, 2])
                if mine:
                    couple_pose(W, k, Y, Z, side, diagonal, i, N, first + k, u, information, gradient)
                else:
                    set_coupling(W, k, N, first + k, u)
            elif mine:
                couple_shared(W, k, Y, side, i, B, last + k - poses, information, gradient)
            else:
                copy_coupling(W, k, B, last + k - poses)
            if not mine:
                continue
            begin, end = offsets[i], offsets[i + 1] - 1
            if moves:
                factors, at, full = _by_columns(Y), begin, end - begin == i
                for j in range(k):
                    wanted = rows[j]
                    if full:
                        at = begin + wanted
                    else:
                        # Columns ascend: the block in column j is at most as far ahead as j itself.
                        if columns[at] > wanted:
                            continue
                        ahead = min(at + wanted - columns[at], end)
                        while columns[ahead] > wanted:
                            ahead -= 1
                        if columns[ahead] < wanted:
                            continue
                        at = ahead
                    if narrow and not is_pose:
                        subtract_upper(blocks, at, factors, W, j)
                    else:
                        subtract_product(blocks, at, factors, W, j)
            if is_pose:
                # The pose's own block is Tᵀ W: one product does for it and for what is taken off.
                subtract_product(blocks, end, _by_columns(Z), W, k)
            elif moves:
                subtract_product(blocks, end, _by_columns(Y), W, k)


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def multiply(first, last, starts, slot, N, shared_starts, shared_slot, B, centers, X, M, x, y):
    """Adds to y (rows, 6) what poses' own blocks and the points `first:last` contribute to S x."""
    for p in range(first, last):
        z0 = z1 = z2 = 0.0
        for e in range(starts[p], starts[p + 1]):
            s, n = slot[e], N[e]
            u0, u1, u2 = X[p, 0] - centers[s, 0], X[p, 1] - centers[s, 1], X[p, 2] - centers[s, 2]
            d0 = x[s, 1] * u2 - x[s, 2] * u1 + x[s, 3]
            d1 = x[s, 2] * u0 - x[s, 0] * u2 + x[s, 4]
            d2 = x[s, 0] * u1 - x[s, 1] * u0 + x[s, 5]
            z0 += n[0] * d0 + n[1] * d1 + n[2] * d2
            z1 += n[1] * d0 + n[3] * d1 + n[4] * d2
            z2 += n[2] * d0 + n[4] * d1 + n[5] * d2
        for e in range(shared_starts[p], shared_starts[p + 1]):
            s, block = shared_slot[e], B[e]
            for c in range(6):
                z0 += block[0, c] * x[s, c]
                z1 += block[1, c] * x[s, c]
                z2 += block[2, c] * x[s, c]
        w0 = M[p, 0] * z0 + M[p, 1] * z1 + M[p, 2] * z2
        w1 = M[p, 1] * z0 + M[p, 3] * z1 + M[p, 4] * z2
        w2 = M[p, 2] * z0 + M[p, 4] * z1 + M[p, 5] * z2
        for e in range(starts[p], starts[p + 1]):
            s, n = slot[e], N[e]
            u0, u1, u2 = X[p, 0] - centers[s, 0], X[p, 1] - centers[s, 1], X[p, 2] - centers[s, 2]
            d0 = x[s, 1] * u2 - x[s, 2] * u1 + x[s, 3] - w0
            d1 = x[s, 2] * u0 - x[s, 0] * u2 + x[s, 4] - w1
            d2 = x[s, 0] * u1 - x[s, 1] * u0 + x[s, 5] - w2
            v0 = n[0] * d0 + n[1] * d1 + n[2] * d2
            v1 = n[1] * d0 + n[3] * d1 + n[4] * d2
            v2 = n[2] * d0 + n[4] * d1 + n[5] * d2
            y[s, 0] += u1 * v2 - u2 * v1
            y[s, 1] += u2 * v0 - u0 * v2
            y[s, 2] += u0 * v1 - u1 * v0
            y[s, 3] += v0
            y[s, 4] += v1
            y[s, 5] += v2
        for e in range(shared_starts[p], shared_starts[p + 1]):
            s, block = shared_slot[e], B[e]
            for c in range(6):
                y[s, c] -= block[0, c] * w0 + block[1, c] * w1 + block[2, c] * w2
