"""Kernels of the multifrontal factorisation; the method and the meaning of the arrays are in `sparse_cholesky`."""

from __future__ import annotations

import numba as nb

from sfm.core.optim._cholesky_kernels import (
    PANEL,
    factor_panel,
    solve_backward,
    solve_forward,
    strip_start,
    subtract_panel,
)
from sfm.core.optim._tile_kernels import add_run


@nb.njit(cache=True, nogil=True, error_model="numpy")
def assemble_front(f, plan, blocks, damping, L, U):
    """Sums a front: its blocks of S + diag(damping), and what its children left over."""
    at, rest, pivots = plan.factor_at[f], plan.rest_at[f], plan.pivots[f]
    columns, rows = (pivots + 7) >> 3, (plan.rests[f] + 7) >> 3
    for n in range(at, plan.factor_at[f + 1]):
        L[n] = 0.0
    for n in range(rest, rest + 32 * rows * (rows + 1)):
        U[n] = 0.0
    for p in range(pivots, 8 * columns):
        L[at + strip_start(p >> 3, columns) + (p & 7) + 8 * p] = 1.0
    for n in range(plan.entries[f], plan.entries[f + 1]):
        block, high, low = plan.entry_block[n], plan.entry_high[n], plan.entry_low[n]
        for a in range(6):
            if plan.rank[6 * high + a] < 0:
                continue
            p = plan.entry_high_at[n] + plan.rank[6 * high + a]
            row = at + strip_start(p >> 3, columns) + (p & 7)
            for b in range(a + 1 if high == low else 6):
                if plan.rank[6 * low + b] >= 0:
                    q = plan.entry_low_at[n] + plan.rank[6 * low + b]
                    L[row + 8 * q] = blocks[block, a, b] if high >= low else blocks[block, b, a]
            if high == low:
                L[row + 8 * p] += damping[6 * high + a]
    for n in range(plan.children[f], plan.children[f + 1]):
        child = plan.child[n]
        start, count, source = plan.rest_starts[child], plan.rests[child], plan.rest_at[child]
        inside = 0
        while inside < count and plan.place[start + inside] < 8 * columns:
            inside += 1
        r = 0
        while r < count:
            # Rows that are consecutive in a strip of the child and in a strip of this front are added together. The
            # last columns reach above the diagonal for some of them, but not out of its tile, where nothing counts.
            p, run = plan.place[start + r], 1
            while (r + run) & 7 and (p + run) & 7 and r + run < count and plan.place[start + r + run] == p + run:
                run += 1
            of = source + strip_start(r >> 3, count) + (r & 7)
            to = at + strip_start(p >> 3, columns) + (p & 7)
            for c in range(min(r + run, inside)):
                add_run(L, to + 8 * plan.place[start + c], U, of + 8 * c, run)
            to = rest + strip_start((p >> 3) - columns, rows) + (p & 7) - 64 * columns
            for c in range(inside, r + run):
                add_run(U, to + 8 * plan.place[start + c], U, of + 8 * c, run)
            r += run


@nb.njit(cache=True, nogil=True, error_model="numpy")
def factor_fronts(fronts, plan, blocks, damping, L, U):
    """Factors fronts one after the other, children before their parents; False: not positive definite."""
    for f in fronts:
        assemble_front(f, plan, blocks, damping, L, U)
        at, rest, columns = plan.factor_at[f], plan.rest_at[f], (plan.pivots[f] + 7) >> 3
        end = columns + ((plan.rests[f] + 7) >> 3)
        for first in range(0, columns, PANEL):
            last = min(first + PANEL, columns)
            if not factor_panel(L, at, columns, first, last, first, end):
                return False
            if last < columns:
                subtract_panel(L, at, columns, first, last, last, last, end, L, 0)
            subtract_panel(L, at, columns, first, last, columns, columns, end, U, rest)
    return True


@nb.njit(cache=True, nogil=True, error_model="numpy")
def solve_fronts(plan, L, z, x):
    """Overwrites z, unknowns in the order of their elimination, by S⁻¹ z; x has room for the largest front."""
    fronts = len(plan.pivots)
    for step in range(2 * fronts):
        forward = step < fronts
        f = step if forward else 2 * fronts - 1 - step
        pivots, count, first, start = plan.pivots[f], plan.rests[f], plan.first[f], plan.rest_starts[f]
        columns = (pivots + 7) >> 3
        end = columns + ((count + 7) >> 3)
        x[: 8 * end] = 0.0
        x[:pivots] = z[first : first + pivots]
        for r in range(count):
            x[8 * columns + r] = z[plan.unknown[start + r]]
        if forward:
            solve_forward(L, plan.factor_at[f], columns, end, x)
            for r in range(count):
                z[plan.unknown[start + r]] = x[8 * columns + r]
        else:
            solve_backward(L, plan.factor_at[f], columns, end, x)
        z[first : first + pivots] = x[:pivots]
