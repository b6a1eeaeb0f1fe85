"""Sparse Cholesky factorisation S = L Lᵀ of a matrix of 6×6 blocks by fronts.

A front sums what belongs to its pivots: their blocks of S, and what its children in the tree have left over. It is
a dense matrix in the strips of `dense_cholesky`, pivots first; to eliminate these gives their columns of L and a
triangle, the Schur complement of the rest, that the parent takes in. Triangles lie on two stacks, those of odd and
of even depth in the tree: the triangles of the children end one stack when the parent's is put on the other.

Subtrees have nothing to do with each other and are shared out among threads; the fronts above them, few and large,
are done one by one with their rows shared out. Every front takes in its children in one order, so that no number
depends on the number of threads.

Reference:
    Duff & Reid, The multifrontal solution of indefinite sparse symmetric linear equations, 1983.
    Liu, The multifrontal method for sparse matrix solution: theory and practice, 1992.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.execution import ordered_map
from sfm.core.optim import _sparse_cholesky_kernels as kernels
from sfm.core.optim._cholesky_kernels import PANEL, factor_panel
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.dense_cholesky import SHARE_FROM, STRIP, eliminate_panel, strip_count
from sfm.core.optim.front_schedule import schedule_of
from sfm.core.optim.ordering import Fronts, find_fronts
from sfm.core.optim.selected_inverse import front_inverse, gathered_blocks, least_pivot_of

_WORTH_SHARING_S = 5e-3
"""Seconds of a whole factorisation from which threads pay."""


class Plan(NamedTuple):
    """Where things are; all that kernels need besides numbers.

    Attributes:
        pivots, rests: (F,) unknowns of each front.
        first: (F,) the first pivot among the unknowns in the order of their elimination.
        factor_at: (F + 1,) where the factor of each front begins in L.
        rest_at: (F,) where the triangle of each front begins in U.
        rest_starts: (F + 1,) where the unknowns of each front's rest begin in the two arrays that follow.
        unknown: the unknowns of the rest, by the order of elimination.
        place: their rows in the front of the parent.
        children, child: (F + 1,) where the children of each front begin, and these.
        entries: (F + 1,) where the blocks of each front begin in the arrays that follow.
        entry_block: (B,) number of the block in the pattern.
        entry_high, entry_low: (B,) its rows of the pattern, the one that is eliminated later first.
        entry_high_at, entry_low_at: (B,) where the unknowns of these begin in the front.
        rank: (6N,) number of an unknown among those of its row that are free; −1 for held ones.
    """

    pivots: np.ndarray
    rests: np.ndarray
    first: np.ndarray
    factor_at: np.ndarray
    rest_at: np.ndarray
    rest_starts: np.ndarray
    unknown: np.ndarray
    place: np.ndarray
    children: np.ndarray
    child: np.ndarray
    entries: np.ndarray
    entry_block: np.ndarray
    entry_high: np.ndarray
    entry_low: np.ndarray
    entry_high_at: np.ndarray
    entry_low_at: np.ndarray
    rank: np.ndarray


class SparseCholesky:
    """Factors S + diag(damping) again and again for one pattern; meets `solvers.ReducedSolver`.

    Args:
        held: (6N,) unknowns that stay zero; they have no row in the factor.
        fronts: of this pattern and these unknowns, where they are known already.
    """

    def __init__(self, pattern: BlockPattern, held: BoolArray, fronts: Fronts | None = None) -> None:
        fronts = find_fronts(pattern, held) if fronts is None else fronts
        schedule = schedule_of(fronts)
        self._free, self._blocks = _free_in_order(fronts, held), len(pattern.columns)
        self._plan = _plan(pattern, held, fronts, schedule.rest_at)
        self._jobs, self._top = schedule.jobs, schedule.top
        self._shared = fronts.seconds.sum() >= _WORTH_SHARING_S
        self._L, self._U = np.empty(int(self._plan.factor_at[-1])), np.empty(schedule.size)
        largest = STRIP * (strip_count(fronts.pivots) + strip_count(fronts.rests))
        self._front = np.empty(int(largest.max(initial=0)))

    def factor(self, blocks: FloatArray, damping: FloatArray, threads: int = 1) -> bool:
        """Whether S + diag(damping) is finite and positive definite; if so, `solve` may follow.

        Args:
            blocks: (B, 6, 6) of the pattern; of those on the diagonal the lower triangle counts.
            damping: (6N,).
        """

        def subtree(fronts: np.ndarray) -> bool:
            return kernels.factor_fronts(fronts, self._plan, blocks, damping, self._L, self._U)

        if threads == 1 or not self._shared:
            return all(map(subtree, [*self._jobs, self._top]))
        if not all(list(ordered_map(subtree, self._jobs, threads=threads))):
            return False
        return all(self._factor_front(f, blocks, damping, threads) for f in self._top)

    def _factor_front(self, f: np.int64, blocks: FloatArray, damping: FloatArray, threads: int) -> bool:
        """One front, with its rows shared out among threads if it is large."""
        plan, L, U = self._plan, self._L, self._U
        at, rest, columns = int(plan.factor_at[f]), int(plan.rest_at[f]), strip_count(int(plan.pivots[f]))
        end = columns + strip_count(int(plan.rests[f]))
        if end < SHARE_FROM:
            return kernels.factor_fronts(np.array([f]), plan, blocks, damping, L, U)
        kernels.assemble_front(f, plan, blocks, damping, L, U)
        for first in range(0, columns, PANEL):
            last = min(first + PANEL, columns)
            if not factor_panel(L, at, columns, first, last, first, last):
                return False
            eliminate_panel(L, at, columns, end, first, last, U, rest, threads)
        return True

    def solve(self, side: FloatArray) -> FloatArray:
        """x (6N,) with (S + diag(damping)) x = side, and 0 where held."""
        z = side[self._free]
        kernels.solve_fronts(self._plan, self._L, z, self._front)
        x = np.zeros(len(side))
        x[self._free] = z
        return x

    def least_pivot(self) -> float:
        """The least pivot of the factor, the square of an entry on its diagonal; inf where nothing is free."""
        at, pivots = self._plan.factor_at, self._plan.pivots
        fronts = (least_pivot_of(self._L[at[f] :], int(pivots[f])) for f in range(len(pivots)))
        return min(fronts, default=float("inf"))

    def inverse_blocks(self) -> FloatArray:
        """The blocks (B, 6, 6) of (S + diag(damping))⁻¹ where the pattern has one, 0 where held."""
        plan, blocks = self._plan, np.zeros((self._blocks, BLOCK, BLOCK))
        below = {f: np.zeros((0, 0)) for f in np.flatnonzero(plan.rests == 0).tolist()}
        for f in range(len(plan.pivots) - 1, -1, -1):
            L = self._L[plan.factor_at[f] : plan.factor_at[f + 1]]
            Z = front_inverse(L, strip_count(int(plan.pivots[f])), below.pop(f))
            for child in plan.child[plan.children[f] : plan.children[f + 1]].tolist():
                place = plan.place[plan.rest_starts[child] : plan.rest_starts[child + 1]]
                below[child] = np.pad(Z[np.ix_(place, place)], (0, -len(place) % STRIP))
            own = slice(plan.entries[f], plan.entries[f + 1])
            blocks[plan.entry_block[own]] = _own_blocks(plan, own, Z)
        return blocks


def _own_blocks(plan: Plan, own: slice, Z: FloatArray) -> FloatArray:
    """The blocks of a front's own entries of S in the inverse Z of the front."""
    high, low, rank = plan.entry_high[own], plan.entry_low[own], plan.rank.reshape(-1, BLOCK)
    rows = np.where(rank[high] >= 0, rank[high] + plan.entry_high_at[own, None], -1)
    columns = np.where(rank[low] >= 0, rank[low] + plan.entry_low_at[own, None], -1)
    blocks = gathered_blocks(Z, rows, columns)
    return np.where((high < low)[:, None, None], blocks.transpose(0, 2, 1), blocks)


def sparse_bytes(fronts: Fronts) -> int:
    """Memory that `SparseCholesky` takes for the numbers of these fronts."""
    return 8 * int(fronts.factor_sizes.sum() + schedule_of(fronts).size)


def _free_in_order(fronts: Fronts, held: BoolArray) -> np.ndarray:
    """The unknowns that are free, in the order of their elimination."""
    unknowns = (BLOCK * fronts.order[:, None] + np.arange(BLOCK)).ravel()
    return unknowns[~held[unknowns]]


def _plan(pattern: BlockPattern, held: BoolArray, fronts: Fronts, rest_at: np.ndarray) -> Plan:
    free = (~held).reshape(-1, BLOCK)
    rank = np.where(free, np.cumsum(free, axis=1) - 1, -1).astype(np.int32).ravel()
    sizes = free.sum(axis=1)[fronts.order]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    columns = STRIP * strip_count(fronts.pivots)
    count = len(fronts.pivots)
    place_of = np.full(pattern.rows, -1)
    place_of[fronts.order] = np.arange(len(fronts.order))
    entries = _entries(pattern, fronts, place_of)
    bounds = np.searchsorted(entries.front, np.arange(count + 1))
    rest_starts = np.concatenate([[0], np.cumsum(fronts.rests)])
    unknown, place = np.empty(rest_starts[-1], np.int32), np.empty(rest_starts[-1], np.int32)
    high_at, low_at = np.empty(len(entries.front), np.int32), np.empty(len(entries.front), np.int32)
    children = np.argsort(fronts.parent, kind="stable")
    child_starts = np.searchsorted(fronts.parent[children], np.arange(count + 1))
    local = np.empty(len(fronts.order), np.int64)
    for f, rest in enumerate(fronts.rest):
        first, last = fronts.first[f], fronts.first[f + 1]
        local[first:last] = starts[first:last] - starts[first]
        if len(rest):
            local[rest] = columns[f] + np.concatenate([[0], np.cumsum(sizes[rest])[:-1]])
            unknown[rest_starts[f] : rest_starts[f + 1]] = _expanded(starts[rest], sizes[rest])
        own = slice(bounds[f], bounds[f + 1])
        high_at[own], low_at[own] = local[place_of[entries.high[own]]], local[place_of[entries.low[own]]]
        for c in children[child_starts[f] : child_starts[f + 1]]:
            rows = fronts.rest[c]
            place[rest_starts[c] : rest_starts[c + 1]] = _expanded(local[rows], sizes[rows])
    return Plan(
        fronts.pivots, fronts.rests, starts[fronts.first[:-1]],
        np.concatenate([[0], np.cumsum(fronts.factor_sizes)]), rest_at,
        rest_starts, unknown, place, child_starts, children, bounds,
        entries.block, entries.high, entries.low, high_at, low_at, rank,
    )  # fmt: skip


def _expanded(begins: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """The numbers begin, begin + 1, … for each begin, as many as its size."""
    ends = np.cumsum(sizes)
    return np.repeat(begins - ends + sizes, sizes) + np.arange(ends[-1] if len(ends) else 0)


class _Entries(NamedTuple):
    """Blocks of free rows by front: numbers of the block and of its rows, the one that is eliminated later first."""

    front: np.ndarray
    block: np.ndarray
    high: np.ndarray
    low: np.ndarray


def _entries(pattern: BlockPattern, fronts: Fronts, place_of: np.ndarray) -> _Entries:
    row = np.repeat(np.arange(pattern.rows, dtype=np.int32), np.diff(pattern.offsets))
    block = np.flatnonzero((place_of[row] >= 0) & (place_of[pattern.columns] >= 0)).astype(np.int32)
    row, column = row[block], pattern.columns[block]
    later = place_of[row] >= place_of[column]
    high, low = np.where(later, row, column), np.where(later, column, row)
    front_of = np.repeat(np.arange(len(fronts.pivots)), np.diff(fronts.first))
    front = front_of[place_of[low]]
    by_front = np.argsort(front, kind="stable")
    return _Entries(front[by_front], block[by_front], high[by_front], low[by_front])
