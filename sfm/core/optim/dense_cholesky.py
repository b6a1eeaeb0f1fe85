"""Dense Cholesky factorisation S = L Lᵀ of a matrix of 6×6 blocks, in strips.

L lies in strips of eight rows, padded with rows of the identity at the end. Strip i has the 8 (i + 1) columns that
reach to the diagonal, column by column, so that eight numbers of a column are one vector register and every inner
product runs through memory in order. Columns are eliminated in panels: the panel's own rows, then the rows below,
then what the panel subtracts from the columns to its right. The last two are shared out among threads by rows. The
sum behind an element of L is always taken in the same order, so that no number depends on the number of threads.

On one thread this takes a third to a half of the time of LAPACK (OpenBLAS) for 120 to 3,000 unknowns where vectors
have eight doubles, and with four half of it up to as much. Threads of a BLAS are not used: its bits would depend on
their number, and those of OpenBLAS keep their cores busy for a while in waiting for more.

Reference:
    Gustavson, Recursion leads to automatic variable blocking for dense linear-algebra algorithms, 1997.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.execution import chunk_bounds, ordered_map
from sfm.core.optim import _cholesky_kernels as kernels
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.selected_inverse import front_inverse, gathered_blocks, least_pivot_of

STRIP = 8
"""Rows of a strip."""
Count = TypeVar("Count", int, np.ndarray)
SHARE_FROM = 100
"""Strips from which threads pay; handing out the work of a panel takes a third of a millisecond."""


class DenseCholesky:
    """Factors S + diag(damping) again and again for one pattern; meets `solvers.ReducedSolver`.

    Args:
        held: (6N,) unknowns that stay zero; they have no row in the factor.
    """

    def __init__(self, pattern: BlockPattern, held: BoolArray) -> None:
        self._pattern, self._free = pattern, np.flatnonzero(~held)
        self._position = np.full(BLOCK * pattern.rows, -1)
        self._position[self._free] = np.arange(len(self._free))
        self._L = np.empty(strips_size(len(self._free)))

    def factor(self, blocks: FloatArray, damping: FloatArray, threads: int = 1) -> bool:
        """Whether S + diag(damping) is finite and positive definite; if so, `solve` may follow.

        Args:
            blocks: (B, 6, 6) of the pattern; of those on the diagonal the lower triangle counts.
            damping: (6N,).
        """
        n, pattern, L = len(self._free), self._pattern, self._L
        L.fill(0)
        padding = np.arange(n % STRIP or STRIP, STRIP)
        L[len(L) - STRIP * STRIP + (STRIP + 1) * padding] = 1

        def scatter(rows: tuple[int, int]) -> None:
            kernels.scatter_blocks(*rows, blocks, pattern.offsets, pattern.columns, self._position, damping, L)

        share = threads if strip_count(n) >= SHARE_FROM else 1
        list(ordered_map(scatter, chunk_bounds(pattern.rows, share), threads=share))
        return factor_strips(L, strip_count(n), threads)

    def solve(self, side: FloatArray) -> FloatArray:
        """x (6N,) with (S + diag(damping)) x = side, and 0 where held."""
        x = np.zeros(len(side))
        x[self._free] = solve_strips(self._L, side[self._free])
        return x

    def least_pivot(self) -> float:
        """The least pivot of the factor, the square of an entry on its diagonal; inf where nothing is free."""
        return least_pivot_of(self._L, len(self._free)) if len(self._free) else float("inf")

    def inverse_blocks(self) -> FloatArray:
        """The blocks (B, 6, 6) of (S + diag(damping))⁻¹ where the pattern has one, 0 where held."""
        Z = front_inverse(self._L, strip_count(len(self._free)), np.zeros((0, 0)))
        row = np.repeat(np.arange(self._pattern.rows), np.diff(self._pattern.offsets))
        position = self._position.reshape(-1, BLOCK)
        return gathered_blocks(Z, position[row], position[self._pattern.columns])


def strip_count(unknowns: Count) -> Count:
    """Strips that hold so many rows; for each number of an array too."""
    return -(-unknowns // STRIP)


def strips_size(unknowns: int) -> int:
    """Numbers in a factor of so many rows."""
    strips = strip_count(unknowns)
    return STRIP * STRIP * strips * (strips + 1) // 2


def factor_strips(L: FloatArray, strips: int, threads: int = 1) -> bool:
    """Overwrites the strips of S by those of L, with 1 / L_jj for L_jj; False where S is not positive definite."""
    for first in range(0, strips, kernels.PANEL):
        last = min(first + kernels.PANEL, strips)
        if not kernels.factor_panel(L, 0, strips, first, last, first, last):
            return False
        eliminate_panel(L, 0, strips, strips, first, last, L, 0, threads)
    return True


def eliminate_panel(
    L: FloatArray, at: int, pivots: int, end: int, first: int, last: int, rest: FloatArray, rest_at: int, threads: int
) -> None:
    """The panel of strips `first:last` in the rows below it, and what it subtracts from the columns to its right.

    Args:
        L: has the factor of the front at `at`; `pivots` of its `end` strips are eliminated in the end.
        rest: has the Schur complement of the others at `rest_at`.
    """
    threads = threads if end - last >= SHARE_FROM else 1

    def below(rows: tuple[int, int]) -> None:
        kernels.factor_panel(L, at, pivots, first, last, *rows)

    def right(rows: tuple[int, int]) -> None:
        if last < pivots:
            kernels.subtract_panel(L, at, pivots, first, last, last, *rows, L, 0)
        if rows[1] > pivots:
            kernels.subtract_panel(L, at, pivots, first, last, pivots, max(pivots, rows[0]), rows[1], rest, rest_at)

    list(ordered_map(below, _row_ranges(last, end, threads), threads=threads))
    list(ordered_map(right, _row_ranges(last, end, threads), threads=threads))


def _row_ranges(first: int, end: int, threads: int) -> list[tuple[int, int]]:
    """Ranges of rows for threads; several for each, since the rows further down have more to do."""
    return [(first + a, first + b) for a, b in chunk_bounds(end - first, 4 * threads if threads > 1 else 1)]


def solve_strips(L: FloatArray, side: FloatArray) -> FloatArray:
    """x with L Lᵀ x = side."""
    strips = strip_count(len(side))
    x = np.zeros(STRIP * strips)
    x[: len(side)] = side
    kernels.solve_forward(L, 0, strips, strips, x)
    kernels.solve_backward(L, 0, strips, strips, x)
    return x[: len(side)]
