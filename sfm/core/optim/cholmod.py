"""Sparse Cholesky factorisation by CHOLMOD of SuiteSparse, where scikit-sparse is installed.

It meets the same contract as `sparse_cholesky`, finds its order of elimination by AMD or METIS, and factors supernodes
with the BLAS it is linked with: the last bits, and the number of threads, are up to that.

Reference:
    Chen, Davis, Hager & Rajamanickam, Algorithm 887: CHOLMOD, supernodal sparse Cholesky factorization and
        update/downdate, 2008.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix

from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optional import import_cholmod


class CholmodCholesky:
    """Factors S + diag(damping) again and again for one pattern; meets `solvers.ReducedSolver`.

    Args:
        held: (6N,) unknowns that stay zero; they have no row in the factor.

    Raises:
        MissingDependencyError: scikit-sparse is not installed, or not one with the interface of 0.4.
    """

    def __init__(self, pattern: BlockPattern, held: BoolArray) -> None:
        self._cholmod = import_cholmod()
        self._free, size = np.flatnonzero(~held), int(np.sum(~held))
        position = np.full(len(held), -1)
        position[self._free] = np.arange(size)
        block, a, b = (axis.ravel() for axis in np.indices((len(pattern.columns), BLOCK, BLOCK), np.int32))
        rows = np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))
        row, column = position[BLOCK * rows[block] + a], position[BLOCK * pattern.columns[block] + b]
        used = np.flatnonzero((row >= column) & (column >= 0))
        # Blocks come by rows, and so do the entries of each column.
        self._source = used[np.argsort(column[used], kind="stable")]
        row, column = row[self._source], column[self._source]
        starts = np.searchsorted(column, np.arange(size + 1))
        self._diagonal = starts[:-1]
        self._S = csc_matrix((np.zeros(len(row)), row.astype(np.int32), starts.astype(np.int32)), (size, size))
        self._factor = self._cholmod.analyze(self._S, mode="supernodal")

    def factor(self, blocks: FloatArray, damping: FloatArray, threads: int = 1) -> bool:
        """Whether S + diag(damping) is finite and positive definite; if so, `solve` may follow.

        Args:
            blocks: (B, 6, 6) of the pattern; of those on the diagonal the lower triangle counts.
            damping: (6N,).
            threads: of no meaning here.
        """
        numbers = np.ascontiguousarray(blocks).ravel().take(self._source)
        numbers[self._diagonal] += damping[self._free]
        if not np.isfinite(numbers).all():
            return False
        self._S.data = numbers
        try:
            self._factor.cholesky_inplace(self._S)
        except self._cholmod.CholmodNotPositiveDefiniteError:
            return False
        return True

    def solve(self, side: FloatArray) -> FloatArray:
        """x (6N,) with (S + diag(damping)) x = side, and 0 where held."""
        x = np.zeros(len(side))
        if len(self._free):
            x[self._free] = self._factor(side[self._free])
        return x
