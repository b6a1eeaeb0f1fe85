"""What solves the reduced system of an adjustment, and which of the means is the cheapest.

S is symmetric and positive definite, of the 6×6 blocks of a `BlockPattern`. It is factored again and again, with
other numbers and another damping, for one pattern: what depends on the pattern alone is done once.

A factor in one dense triangle takes n³ / 3 operations and 4 n² bytes for n unknowns. A sparse one takes what the
order of elimination leaves of that: little where each row is coupled to few others, more than the dense one where
the couplings are at random.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np

from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.cholmod import CholmodCholesky
from sfm.core.optim.dense_cholesky import DenseCholesky, strips_size
from sfm.core.optim.ordering import Fronts, find_fronts
from sfm.core.optim.sparse_cholesky import SparseCholesky, sparse_bytes

SolverKind: TypeAlias = Literal["dense", "sparse", "cholmod"]

_ALWAYS_DENSE_UNKNOWNS = 1200
"""Up to here a dense factor takes some milliseconds, which the kernels of the other are not worth compiling for."""
_ALWAYS_DENSE_SHARE = 0.5
"""Of all blocks that exist, from which on no order helps."""
_WORTH_SPARSE = 0.75
"""Of the time of a dense factor, below which a sparse one is taken: where they are close, it needs more memory."""
_DENSE_SECONDS_PER_OPERATION, _DENSE_SECONDS_PER_ENTRY = 1.1e-11, 1.5e-9
"""Measured on the same core as the times of fronts in `ordering`."""


@runtime_checkable
class ReducedSolver(Protocol):
    """Factors a matrix of one pattern, then solves with the factor as often as is wanted."""

    def factor(self, blocks: FloatArray, damping: FloatArray, threads: int = 1) -> bool:
        """Whether S + diag(damping) is finite and positive definite; if so, `solve` may follow.

        Args:
            blocks: (B, 6, 6) of the pattern, not modified; of those on the diagonal the lower triangle counts.
            damping: (6N,).
        """
        ...

    def solve(self, side: FloatArray) -> FloatArray:
        """x (6N,) with (S + diag(damping)) x = side, and 0 where held."""
        ...


class FactorSolver(ReducedSolver, Protocol):
    """A solver by an exact factor, which also tells what is in the inverse."""

    def least_pivot(self) -> float:
        """The least pivot of the factor, the square of an entry on its diagonal; inf where nothing is free."""
        ...

    def inverse_blocks(self) -> FloatArray:
        """The blocks (B, 6, 6) of (S + diag(damping))⁻¹ where the pattern has one, 0 where held."""
        ...


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """What a solver takes for each factorisation, known before any of it is taken.

    Attributes:
        seconds: on one core of the machine on which they were measured.
        fronts: of the sparse factor, whose search is part of the forecast.
    """

    kind: SolverKind
    bytes: int
    operations: float
    seconds: float
    fronts: Fronts | None = dataclasses.field(default=None, repr=False)


def forecast_dense(held: BoolArray) -> Forecast:
    """What `DenseCholesky` takes, whatever the pattern."""
    n = int(np.sum(~held))
    operations = n**3 / 3
    seconds = _DENSE_SECONDS_PER_OPERATION * operations + _DENSE_SECONDS_PER_ENTRY * n**2 / 2
    return Forecast("dense", 8 * strips_size(n), operations, seconds)


def forecast_sparse(pattern: BlockPattern, held: BoolArray) -> Forecast:
    """What `SparseCholesky` takes; looks for the order of elimination."""
    fronts = find_fronts(pattern, held)
    seconds = float(fronts.seconds.sum())
    return Forecast("sparse", sparse_bytes(fronts), float(fronts.operations.sum()), seconds, fronts)


def forecast_cholmod(pattern: BlockPattern, held: BoolArray) -> Forecast:
    """About what `CholmodCholesky` takes: the fronts of our own order, and S by its entries with an index each."""
    ours, entries = forecast_sparse(pattern, held), BLOCK * BLOCK * len(pattern.columns)
    return Forecast("cholmod", ours.bytes + 28 * entries, ours.operations, ours.seconds)


def forecast_cheapest(pattern: BlockPattern, held: BoolArray) -> Forecast:
    """What the fastest of the solvers takes, the dense one where they are close.

    Args:
        held: (6N,) unknowns that stay zero.
    """
    dense = forecast_dense(held)
    if _is_dense(pattern, held):
        return dense
    sparse = forecast_sparse(pattern, held)
    return sparse if sparse.seconds < _WORTH_SPARSE * dense.seconds else dense


def make_solver(
    pattern: BlockPattern, held: BoolArray, forecast: Forecast
) -> DenseCholesky | SparseCholesky | CholmodCholesky:
    """The solver of a forecast for the same pattern and held unknowns (6N,); takes its memory.

    Raises:
        MissingDependencyError: that of CHOLMOD is not installed.
    """
    match forecast.kind:
        case "dense":
            return DenseCholesky(pattern, held)
        case "sparse":
            return SparseCholesky(pattern, held, forecast.fronts)
        case "cholmod":
            return CholmodCholesky(pattern, held)


def _is_dense(pattern: BlockPattern, held: BoolArray) -> bool:
    """Whether a dense factor is best without a look at the couplings."""
    blocks = pattern.rows * (pattern.rows + 1) / 2
    return int(np.sum(~held)) <= _ALWAYS_DENSE_UNKNOWNS or len(pattern.columns) >= _ALWAYS_DENSE_SHARE * blocks
