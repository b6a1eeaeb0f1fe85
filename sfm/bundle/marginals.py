"""Blocks of the covariance of poses and shared parameters, without the whole of it.

Whatever is asked of Σ = S⁻¹ lies where points or images couple two rows: the pose of an image and that of its sensor,
the parameters of a camera, and all rows that see one point. These are blocks of S itself, and those of the inverse
come from a sparse factor in a few times the work of the factor (see `sfm.core.optim.selected_inverse`).

Where S is singular because the motions Q (N, m) of the whole scene cost nothing, with Qᵀ Q = 1, let E be columns of the
identity for m entries that no motion leaves at rest. S + E Eᵀ is then regular, its inverse F is a generalised inverse
of S (S F S = S), and (1 − Q Qᵀ) F (1 − Q Qᵀ) is S⁺ whatever E is. With m solutions W = F Q and G = Qᵀ W a block is

    Σ_ij = F_ij − Q_i W_jᵀ − W_i Q_jᵀ + Q_i G Q_jᵀ

All is done with S scaled to ones on its diagonal.

Reference:
    Kanatani & Morris, Gauges and gauge transformations for uncertainty description of geometric structure, 2001.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
from scipy.linalg import qr

from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.solvers import FactorSolver

_SINGULAR = 1e-12
"""Least pivot, of a matrix with ones on its diagonal, that is not a rounding error."""
_NEARLY, _ITERATIONS = (1e-9, 1e-6, 1e-3), 4
"""What is added to the diagonal to find the direction that a singular matrix leaves open, and steps to find it."""
_DEPENDENT = 1e-9
"""Part of the largest of the lengths of motions below which one is a sum of the others."""
_AT_ONCE = 20_000
"""Blocks that are projected at once."""


class Marginals(NamedTuple):
    """Blocks (B, 6, 6) of Σ in a pattern; zero where entries are held."""

    pattern: BlockPattern
    blocks: FloatArray

    def between(self, rows: np.ndarray, columns: np.ndarray) -> FloatArray:
        """(n, 6, 6) the blocks in these rows and columns, of either triangle; zero where one of them is −1.

        Raises:
            ValueError: a block is not in the pattern.
        """
        there = (rows >= 0) & (columns >= 0)
        numbers = self.pattern.find(np.maximum(rows, columns)[there], np.minimum(rows, columns)[there])
        if np.any(numbers < 0):
            raise ValueError(f"{int(np.sum(numbers < 0))} blocks are not in the pattern")
        found, upper = self.blocks[numbers], (rows < columns)[there]
        found[upper] = found[upper].transpose(0, 2, 1)
        out = np.zeros((len(rows), BLOCK, BLOCK))
        out[there] = found
        return out


def marginals(
    pattern: BlockPattern, blocks: FloatArray, solver: FactorSolver, free: BoolArray, motions: FloatArray, threads: int
) -> Marginals | int:
    """The blocks of Σ in the pattern of S, or the number of an entry that S leaves open beside the motions.

    Args:
        blocks: (B, 6, 6) of S; overwritten.
        solver: for this pattern and the entries that are not `free` (6N,).
        motions: (6N, m) columns that span what costs nothing.
    """
    diagonal = np.einsum("kaa->ka", blocks[pattern.diagonal]).ravel()
    open_ = np.flatnonzero(free & ~(diagonal > 0))
    if len(open_):
        return int(open_[0])
    scale = np.divide(1.0, np.sqrt(np.abs(diagonal)), out=np.zeros(len(diagonal)), where=free)
    _scale(blocks, pattern, scale)
    basis = _orthonormal(motions, free)
    held = _kept_from_moving(basis, free, scale)
    if not solver.factor(blocks, held, threads) or solver.least_pivot() < _SINGULAR:
        return _open_entry(solver, blocks, held, free, threads)
    inverse = solver.inverse_blocks()
    _scale(inverse, pattern, scale)
    if basis.shape[1]:
        _project(inverse, pattern, basis, np.stack([scale * solver.solve(scale * q) for q in basis.T], axis=1))
    return Marginals(pattern, inverse)


def _scale(blocks: FloatArray, pattern: BlockPattern, scale: FloatArray) -> None:
    """Multiplies rows and columns by those of `scale` (6N,)."""
    wide = scale.reshape(-1, BLOCK)
    blocks *= wide[_rows(pattern)][:, :, None]
    blocks *= wide[pattern.columns][:, None, :]


def _orthonormal(motions: FloatArray, free: BoolArray) -> FloatArray:
    """Orthonormal columns (6N, k) with the same span in the entries that are free."""
    basis = np.zeros(motions.shape)
    lengths = np.linalg.norm(motions[free], axis=0)
    if not np.any(lengths > 0):
        return basis[:, :0]
    directions, sizes, _ = np.linalg.svd(motions[free] / np.where(lengths > 0, lengths, 1.0), full_matrices=False)
    directions = directions[:, sizes > _DEPENDENT * sizes[0]]
    basis = basis[:, : directions.shape[1]]
    basis[free] = directions
    return basis


def _kept_from_moving(basis: FloatArray, free: BoolArray, scale: FloatArray) -> FloatArray:
    """(6N,) 1 for as many entries as there are motions, which cannot all rest in any of these, else 0."""
    held = np.zeros(len(free))
    if basis.shape[1]:
        rows = np.flatnonzero(free)
        _, order = cast(tuple[FloatArray, np.ndarray], qr((basis[rows] / scale[rows, None]).T, mode="r", pivoting=True))
        held[rows[order[: basis.shape[1]]]] = 1.0
    return held


def _project(inverse: FloatArray, pattern: BlockPattern, Q: FloatArray, W: FloatArray) -> None:
    """Turns blocks of F into those of (1 − Q Qᵀ) F (1 − Q Qᵀ)."""
    half = (W - 0.5 * Q @ (Q.T @ W)).reshape(-1, BLOCK, Q.shape[1])
    Q, row = Q.reshape(half.shape), _rows(pattern)
    for first in range(0, len(inverse), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        i, j = row[part], pattern.columns[part]
        inverse[part] -= Q[i] @ half[j].transpose(0, 2, 1)
        inverse[part] -= half[i] @ Q[j].transpose(0, 2, 1)


def _open_entry(solver: FactorSolver, blocks: FloatArray, held: FloatArray, free: BoolArray, threads: int) -> int:
    """The largest entry of the direction that S changes least, by inverse iteration."""
    direction = np.where(free, np.random.default_rng(0).normal(size=len(free)), 0.0)
    if any(solver.factor(blocks, held + much, threads) for much in _NEARLY):
        for _ in range(_ITERATIONS):
            direction = solver.solve(direction / np.linalg.norm(direction))
    return int(np.argmax(np.abs(direction)))


def _rows(pattern: BlockPattern) -> np.ndarray:
    """(B,) the row of each block."""
    return np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))
