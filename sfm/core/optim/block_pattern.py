"""Which blocks of a symmetric matrix of 6×6 blocks exist.

Unknowns come in rows of six: a pose, up to six parameters of a camera, a pose of a sensor on its rig, a bias; rows that
need fewer are padded, and padding is *held* at zero by the solver. Only the lower triangle is stored, row by row; the
blocks on the diagonal always exist.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Int32, Int64

from sfm.core.arrays import Value, readonly

BLOCK = 6
"""Unknowns in a row."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BlockPattern(Value):
    """The lower triangle of a symmetric matrix of N × N blocks, by rows.

    Attributes:
        offsets: (N + 1,) where the blocks of each row begin among all.
        columns: (B,) the column of each block, ascending within a row; the last of row i is i.
    """

    offsets: Int64[np.ndarray, " N1"]
    columns: Int32[np.ndarray, " B"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "offsets", readonly(self.offsets, (len(self.offsets),), np.int64))
        object.__setattr__(self, "columns", readonly(self.columns, (int(self.offsets[-1]),), np.int32))

    @staticmethod
    def full(rows: int) -> BlockPattern:
        """Every block of the lower triangle: block (i, j) is number i (i + 1) / 2 + j."""
        ends = np.arange(rows + 1, dtype=np.int64)
        return BlockPattern(ends * (ends + 1) // 2, np.tril_indices(rows)[1].astype(np.int32))

    @staticmethod
    def of_pairs(rows: int, first: np.ndarray, second: np.ndarray) -> BlockPattern:
        """The blocks (first, second) in either order, repeated or not, and the diagonal."""
        diagonal = np.arange(rows, dtype=np.int64)
        high, low = np.maximum(first, second).astype(np.int64), np.minimum(first, second).astype(np.int64)
        keys = np.unique(np.concatenate([high * rows + low, diagonal * rows + diagonal]))
        offsets = np.searchsorted(keys, np.arange(rows + 1, dtype=np.int64) * rows)
        return BlockPattern(offsets.astype(np.int64), (keys % max(rows, 1)).astype(np.int32))

    @property
    def rows(self) -> int:
        """Number of block rows N."""
        return len(self.offsets) - 1

    @property
    def diagonal(self) -> np.ndarray:
        """(N,) the number of each row's diagonal block."""
        return self.offsets[1:] - 1

    @property
    def is_full(self) -> bool:
        """Whether no block is missing."""
        return 2 * len(self.columns) == self.rows * (self.rows + 1)

    def find(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """(n,) the numbers of the blocks in `rows` and `columns`, of the lower triangle; −1 for those it lacks."""
        if not len(self.columns):
            return np.full(len(rows), -1)
        count = np.int64(self.rows)
        keys = np.repeat(np.arange(self.rows, dtype=np.int64), np.diff(self.offsets)) * count + self.columns
        wanted = np.asarray(rows, np.int64) * count + columns
        found = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where(keys[found] == wanted, found, -1)
