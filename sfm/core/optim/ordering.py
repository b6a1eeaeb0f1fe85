"""In which order to eliminate the rows of a sparse symmetric matrix, and what its factor then looks like.

Eliminating a row couples all rows that it is coupled to. The order is by minimum degree, so that rows which are
coupled to all others (a camera that all photos share) come last by themselves. In the *elimination tree* the parent
of a row is the first row that its elimination changes; subtrees have nothing to do with one another.

Consecutive rows with nearly the same columns are eliminated together, as a *front*: a dense matrix of the rows that
are eliminated, its pivots, and the rows below that these are coupled to, the rest. Joining a front with the one that
takes in its rest adds zeros to the factor, and is done where larger tiles gain more time than the zeros cost.

On graphs of images along streets and on a plain, the order takes a tenth more operations than the exact minimum
degree of SuperLU at worst; nested dissection by distance from an end took 1.5 to 6 times as many.

Reference:
    Amestoy, Davis & Duff, An approximate minimum degree ordering algorithm, 1996 (without supervariables).
    Liu, The role of elimination trees in sparse factorization, 1990.
    Ashcraft & Grimes, The influence of relaxed supernode partitions on the multifrontal method, 1989.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from sfm.core.arrays import BoolArray
from sfm.core.optim import _ordering_kernels as kernels
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.dense_cholesky import STRIP, strip_count

_SECONDS_PER_OPERATION, _SECONDS_PER_TILE, _SECONDS_PER_ENTRY, _SECONDS_PER_FRONT = 2e-11, 1e-8, 2e-10, 1e-6
"""Measured on one core with AVX-512; which fronts are joined only depends on their ratios."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Fronts:
    """Rows in the order of their elimination, cut into F fronts, children before their parents.

    Attributes:
        order: (N,) the row of the pattern at each place; rows that are held altogether have none.
        first: (F + 1,) the place of each front's first pivot.
        rest: for each front the places of the rows below its pivots, ascending.
        parent: (F,) the front that takes in the rest of one; −1 where there is none.
        pivots, rests: (F,) numbers of unknowns.
    """

    order: np.ndarray
    first: np.ndarray
    rest: list[np.ndarray]
    parent: np.ndarray
    pivots: np.ndarray
    rests: np.ndarray

    @property
    def factor_sizes(self) -> np.ndarray:
        """(F,) numbers in the factor of each front, in strips."""
        pivots, rests = strip_count(self.pivots), strip_count(self.rests)
        return STRIP * STRIP * (pivots * (pivots + 1) // 2 + pivots * rests)

    @property
    def rest_sizes(self) -> np.ndarray:
        """(F,) numbers in the triangle that each front leaves over."""
        rests = strip_count(self.rests)
        return STRIP * STRIP * rests * (rests + 1) // 2

    @property
    def operations(self) -> np.ndarray:
        """(F,) floating-point operations to eliminate the pivots of each front."""
        return _operations(self.pivots, self.rests)

    @property
    def seconds(self) -> np.ndarray:
        """(F,) what each front takes on one core, by the cost model."""
        return _front_seconds(self.pivots, self.rests)


def _operations(pivots: Any, rests: Any) -> Any:
    """To eliminate so many pivots of fronts with so many unknowns below; numbers or arrays, as the next."""
    return ((pivots + rests) ** 3.0 - rests**3.0) / 3.0


def _front_seconds(pivots: Any, rests: Any) -> Any:
    """Seconds to sum up such fronts, to eliminate their pivots and to hand on their rests, on one core."""
    columns, rows = STRIP * -(-pivots // STRIP), STRIP * -(-rests // STRIP)
    tiles = columns * (columns / 2 + rows) / STRIP**2
    return (
        _SECONDS_PER_OPERATION * _operations(columns, rows)
        + _SECONDS_PER_TILE * tiles
        + _SECONDS_PER_ENTRY * (tiles * STRIP**2 + rests**2.0)
        + _SECONDS_PER_FRONT
    )


def find_fronts(pattern: BlockPattern, held: BoolArray) -> Fronts:
    """The fronts of a pattern without the unknowns (6N,) that are held."""
    sizes = (~held).reshape(-1, BLOCK).sum(axis=1)
    kept = np.flatnonzero(sizes)
    offsets, neighbours = _adjacency(pattern, kept)
    order = kernels.minimum_degree(offsets, neighbours)
    parent, count = kernels.elimination_tree(offsets, neighbours, order)
    order = order[_postorder(parent, count)]
    parent, count = kernels.elimination_tree(offsets, neighbours, order)
    sizes = sizes[kept[order]]
    first = _join(parent, count, sizes)
    last = first[1:] - 1
    starts = np.concatenate([[0], np.cumsum(count)])
    rows = kernels.factor_structure(offsets, neighbours, order, parent, starts)
    rest = [rows[starts[k] : starts[k + 1]] for k in last]
    front_of = np.repeat(np.arange(len(last)), np.diff(first))
    return Fronts(
        kept[order],
        first,
        rest,
        np.where(parent[last] >= 0, front_of[parent[last]], -1),
        np.add.reduceat(sizes, first[:-1]) if len(sizes) else np.zeros(0, np.int64),
        np.array([int(sizes[r].sum()) for r in rest], np.int64),
    )


def _adjacency(pattern: BlockPattern, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours of each kept row by its number among them: those of i begin at offsets[i]."""
    number = np.full(pattern.rows, -1)
    number[kept] = np.arange(len(kept))
    i = number[np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))]
    j = number[pattern.columns]
    edge = (i != j) & (i >= 0) & (j >= 0)
    one, other = np.concatenate([i[edge], j[edge]]), np.concatenate([j[edge], i[edge]])
    offsets = np.concatenate([[0], np.cumsum(np.bincount(one, minlength=len(kept)))])
    return offsets.astype(np.int64), other[np.lexsort((other, one))]


def _postorder(parent: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Places with children directly before their parents, the child with the longest column last."""
    children: list[list[int]] = [[] for _ in range(len(parent) + 1)]
    for k in np.argsort(-count, kind="stable").tolist():
        children[parent[k]].append(k)
    order, pending = [], list(children[-1])
    while pending:  # parents before their children, and all that backwards
        k = pending.pop()
        order.append(k)
        pending.extend(reversed(children[k]))
    return np.array(order[::-1], np.int64)


def _join(parent: np.ndarray, count: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Where fronts begin, and their end: columns of equal structure together, then what is worth its zeros.

    A front can be joined with its parent where it is the last child, so that their pivots are consecutive.
    """
    alike = (parent[:-1] == np.arange(1, len(parent))) & (count[:-1] == count[1:] + 1)
    ends = np.append(np.flatnonzero(~alike) + 1, len(parent)).tolist() if len(parent) else []
    joined: list[tuple[int, int, float, float]] = []  # first and end, pivots, seconds
    for begin, end in zip([0, *ends[:-1]], ends, strict=False):
        pivots, rests = float(sizes[begin:end].sum()), float(BLOCK * count[end - 1])
        seconds = _front_seconds(pivots, rests)
        while joined and begin <= parent[joined[-1][1] - 1] < end:
            together = _front_seconds(pivots + joined[-1][2], rests)
            if together > seconds + joined[-1][3]:
                break
            begin, _, more, _ = joined.pop()
            pivots, seconds = pivots + more, together
        joined.append((begin, end, pivots, seconds))
    return np.array([*(front[0] for front in joined), len(parent)], np.int64)
