"""Products with a symmetric matrix of 6×6 blocks of which the lower triangle is stored.

Conjugate gradients need nothing else. Where S is known but its factor would be too large, a product with it reads
some hundred thousand blocks, against millions of observations for a product with what S is made of.
"""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.execution import ordered_map
from sfm.core.optim import _iterative_kernels as kernels
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.conjugate_gradients import Linear

_CHUNKS = 4
"""Parts of a product whose sums are added in order, whatever the number of threads."""
_SHARE_FROM = 40_000
"""Blocks from which threads pay; a product takes 25 ns for each on one, as fast as memory gives them."""


def block_product(
    pattern: BlockPattern, blocks: FloatArray, damping: FloatArray, held: BoolArray, threads: int = 1
) -> Linear:
    """x → (S + diag(damping)) x for vectors (6N,), 0 where held.

    Args:
        blocks: (B, 6, 6) of the pattern; of those on the diagonal the lower triangle counts.
        damping, held: (6N,); x must be 0 where held.
    """
    starts = np.searchsorted(pattern.offsets, np.linspace(0, len(blocks), _CHUNKS + 1))
    starts[-1:] = pattern.rows
    threads = threads if len(blocks) >= _SHARE_FROM else 1
    chunks = list(zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True))

    def product(x: FloatArray) -> FloatArray:
        rows = x.reshape(-1, BLOCK)

        def part(chunk: tuple[int, int]) -> FloatArray:
            y = np.zeros_like(rows)
            kernels.add_product(*chunk, blocks, pattern.offsets, pattern.columns, rows, y)
            return y

        total = damping * x
        for y in ordered_map(part, chunks, threads=threads):
            total += y.ravel()
        total[held] = 0
        return total

    return product
