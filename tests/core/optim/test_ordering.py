from __future__ import annotations

import itertools

import numpy as np
import pytest

from sfm.core.optim import _ordering_kernels as kernels
from sfm.core.optim.block_pattern import BlockPattern
from sfm.core.optim.ordering import find_fronts


def eliminated(pattern, order):
    """The rows below the diagonal of each column of the factor, by eliminating one row after the other."""
    rows = np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))
    neighbours = [set() for _ in range(pattern.rows)]
    for i, j in zip(rows.tolist(), pattern.columns.tolist(), strict=True):
        if i != j:
            neighbours[i].add(j)
            neighbours[j].add(i)
    place = {int(row): k for k, row in enumerate(order)}
    columns = []
    for row in order.tolist():
        left = neighbours[row]
        for i in left:
            neighbours[i] |= left - {i}
            neighbours[i].discard(row)
        columns.append(sorted(place[i] for i in left))
    return columns


def adjacency(pattern):
    """Offsets and neighbours of all rows."""
    full = np.zeros((pattern.rows, pattern.rows), bool)
    full[np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets)), pattern.columns] = True
    full |= full.T
    np.fill_diagonal(full, False)
    rows, neighbours = np.nonzero(full)
    return np.searchsorted(rows, np.arange(pattern.rows + 1)), neighbours


def random_pattern(rng, rows, pairs):
    return BlockPattern.of_pairs(rows, *rng.integers(0, rows, (2, pairs)))


@pytest.mark.parametrize(("rows", "pairs"), [(1, 0), (7, 0), (12, 14), (60, 90), (80, 700)])
def test_tree_and_structure_equal_those_of_a_plain_elimination(rng, rows, pairs):
    pattern = random_pattern(rng, rows, pairs)
    graph, order = adjacency(pattern), rng.permutation(rows)
    expected = eliminated(pattern, order)
    parent, count = kernels.elimination_tree(*graph, order)
    starts = np.concatenate([[0], np.cumsum(count)])
    found = kernels.factor_structure(*graph, order, parent, starts)
    assert [found[a:b].tolist() for a, b in itertools.pairwise(starts)] == expected
    assert parent.tolist() == [min(column, default=-1) for column in expected]


@pytest.mark.parametrize(("rows", "pairs"), [(1, 0), (7, 0), (12, 14), (60, 90), (300, 900), (80, 2000)])
def test_the_order_by_minimum_degree_is_an_order_and_fills_less_than_one_by_chance(rng, rows, pairs):
    pattern = random_pattern(rng, rows, pairs)
    order = kernels.minimum_degree(*adjacency(pattern))
    assert sorted(order.tolist()) == list(range(rows))
    filled, by_chance = (sum(map(len, eliminated(pattern, o))) for o in (order, rng.permutation(rows)))
    assert filled <= by_chance
    if rows == 300:
        assert filled < 0.6 * by_chance


def test_a_tree_is_eliminated_without_any_fill(rng):
    rows = 200
    pattern = BlockPattern.of_pairs(rows, np.arange(1, rows), rng.integers(0, np.arange(1, rows)))
    order = kernels.minimum_degree(*adjacency(pattern))
    assert sum(map(len, eliminated(pattern, order))) == rows - 1


def test_a_row_that_is_coupled_to_all_comes_last(rng):
    rows = 120
    near = [(i, i + d) for i in range(1, rows) for d in (1, 2, 3) if i + d < rows]
    pattern = BlockPattern.of_pairs(rows, *np.array(near + [(0, i) for i in range(1, rows)]).T)
    fronts = find_fronts(pattern, np.zeros(6 * rows, bool))
    assert fronts.first[-2] <= np.flatnonzero(fronts.order == 0)[0]


def test_fronts_cover_what_a_plain_elimination_leaves(rng):
    pattern = random_pattern(rng, 90, 150)
    held = np.zeros(540, bool)
    held[rng.integers(0, 540, 60)] = True
    held[60:72] = True  # two rows altogether
    fronts = find_fronts(pattern, held)
    assert sorted(fronts.order.tolist()) == [i for i in range(90) if i not in (10, 11)]
    rows = np.repeat(np.arange(90), np.diff(pattern.offsets))
    kept = ~np.isin(rows, (10, 11)) & ~np.isin(pattern.columns, (10, 11))
    columns = eliminated(
        BlockPattern.of_pairs(90, rows[kept], pattern.columns[kept]), np.append(fronts.order, [10, 11])
    )
    for f, rest in enumerate(fronts.rest):
        pivots = range(fronts.first[f], fronts.first[f + 1])
        assert set().union(*(columns[k] for k in pivots)) - set(pivots) == set(rest.tolist())
        if len(rest):
            parent = fronts.parent[f]
            assert parent > f
            inside = {*range(fronts.first[parent], fronts.first[parent + 1]), *fronts.rest[parent].tolist()}
            assert set(rest.tolist()) <= inside
        else:
            assert fronts.parent[f] == -1
    assert fronts.pivots.sum() == np.sum(~held)
