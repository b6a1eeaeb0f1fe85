"""Kernels of the Cholesky factorisation in strips; the layout is in `dense_cholesky`.

A *front* has `pivots` strips of columns that are eliminated and rows of the same number and more, up to `end`. Its
factor lies at `at` in a flat array: the first strips reach to the diagonal, those below all have 8 × `pivots` columns.
What is left of the rows below after the elimination, the Schur complement, is a triangle of strips of its own.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from sfm.core.optim._tile_kernels import (
    solve_tile,
    subtract_strip_product,
    subtract_strip_vector,
    subtract_two_strip_products,
    subtract_vector_strip,
)

PANEL = 32
"""Strips of a panel: the columns of two strips fill the first cache."""
GROUP = 32
"""Strips that stay in the second cache while others pass by."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def strip_start(strip, pivots):
    """Where a strip of a front begins, counted from the start of the front."""
    full = min(strip, pivots)
    return 32 * full * (full + 1) + 64 * pivots * (strip - full)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def scatter_blocks(first, last, blocks, offsets, columns, position, damping, L):
    """Writes the block rows `first:last` of S + diag(damping) to the strips of L, all its columns pivots.

    `position` says which row and column of L an unknown has, −1 that it has none; it ascends.
    """
    for i in range(first, last):
        for n in range(offsets[i], offsets[i + 1]):
            j = columns[n]
            for a in range(6):
                p = position[6 * i + a]
                if p < 0:
                    continue
                start = strip_start(p >> 3, p + 8) + (p & 7)
                for b in range(a + 1 if i == j else 6):
                    q = position[6 * j + b]
                    if q >= 0:
                        L[start + 8 * q] = blocks[n, a, b]
                if i == j:
                    L[start + 8 * p] += damping[6 * i + a]


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _factor_tile(L, t):
    """Overwrites a tile by its factor, with 1 / L_jj for L_jj and zeros above; False: not positive definite."""
    for j in range(8):
        pivot = L[t + 9 * j]
        if not (pivot > 0.0 and pivot < np.inf):
            return False
        inverse = 1.0 / math.sqrt(pivot)
        L[t + 9 * j] = inverse
        for i in range(j + 1, 8):
            L[t + 8 * j + i] *= inverse
        for i in range(j):
            L[t + 8 * j + i] = 0.0
        for k in range(j + 1, 8):
            x = L[t + 8 * j + k]
            for i in range(k, 8):
                L[t + 8 * k + i] -= x * L[t + 8 * j + i]
    return True


@nb.njit(cache=True, nogil=True, error_model="numpy")
def factor_panel(L, at, pivots, first, last, top, end):
    """Columns of strips `first:last` of the factor in the rows of strips `top:end`; False: not positive definite.

    What the columns before `first` subtract is subtracted already. The rows of the columns themselves come first.
    """
    for i in range(top, end, 2):
        pair = i + 1 < end
        row0, row1 = at + strip_start(i, pivots), at + strip_start(i + 1, pivots)
        for j in range(first, min(i + 2 if pair else i + 1, last)):
            column, k = at + strip_start(j, pivots), 8 * (j - first)
            t0, t1, x0, x1, y = row0 + 64 * j, row1 + 64 * j, row0 + 64 * first, row1 + 64 * first, column + 64 * first
            if j > i:
                subtract_strip_product(L, t1, L, x1, y, k)
                if not _factor_tile(L, t1):
                    return False
                continue
            if pair:
                subtract_two_strip_products(L, t0, t1, L, x0, x1, y, k)
            else:
                subtract_strip_product(L, t0, L, x0, y, k)
            if i > j:
                solve_tile(L, t0, column + 64 * j)
            elif not _factor_tile(L, t0):
                return False
            if pair:
                solve_tile(L, t1, column + 64 * j)
    return True


@nb.njit(cache=True, nogil=True, error_model="numpy")
def subtract_panel(L, at, pivots, first, last, left, top, end, C, rest):
    """Subtracts X Yᵀ, X and Y the columns `first:last` of L, from what they are not yet subtracted from.

    That is the strips `top:end`, from column `left` on: of L itself as far as its pivots reach, or where `left` is
    `pivots` of the Schur complement, which begins at `rest` of C.
    """
    inside = left < pivots
    k, right = 8 * (last - first), min(pivots, end) if inside else end
    for begin in range(left, right, GROUP):
        for i in range(max(top, begin), end, 2):
            pair = i + 1 < end
            row0, row1 = at + strip_start(i, pivots), at + strip_start(i + 1, pivots)
            x0, x1 = row0 + 64 * first, row1 + 64 * first
            if not inside:
                row0 = rest + strip_start(i - pivots, end) - 64 * pivots
                row1 = rest + strip_start(i + 1 - pivots, end) - 64 * pivots
            for j in range(begin, min(begin + GROUP, right, i + 2 if pair else i + 1)):
                y = at + strip_start(j, pivots) + 64 * first
                if j > i:
                    subtract_strip_product(C, row1 + 64 * j, L, x1, y, k)
                elif pair:
                    subtract_two_strip_products(C, row0 + 64 * j, row1 + 64 * j, L, x0, x1, y, k)
                else:
                    subtract_strip_product(C, row0 + 64 * j, L, x0, y, k)


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def solve_forward(L, at, pivots, end, x):
    """Solves with the pivots of a front from above, and subtracts what they are in the rows below."""
    for i in range(end):
        start, columns = at + strip_start(i, pivots), 8 * min(i, pivots)
        subtract_strip_vector(x, 8 * i, L, start, columns)
        if i < pivots:
            tile = start + 64 * i
            for j in range(8):
                x[8 * i + j] *= L[tile + 9 * j]
                for r in range(j + 1, 8):
                    x[8 * i + r] -= L[tile + 8 * j + r] * x[8 * i + j]


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def solve_backward(L, at, pivots, end, x):
    """Solves with the transposed pivots of a front from below; the rows below are known."""
    for i in range(end - 1, -1, -1):
        start, columns = at + strip_start(i, pivots), 8 * min(i, pivots)
        if i < pivots:
            tile = start + 64 * i
            for j in range(7, -1, -1):
                for r in range(j + 1, 8):
                    x[8 * i + j] -= L[tile + 8 * j + r] * x[8 * i + r]
                x[8 * i + j] *= L[tile + 9 * j]
        subtract_vector_strip(x, 8 * i, L, start, columns)
