from __future__ import annotations

import numpy as np

from sfm.core.optim.block_pattern import BlockPattern


def blocks_of(pattern):
    rows = np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))
    return list(zip(rows.tolist(), pattern.columns.tolist(), strict=True))


def test_a_full_pattern_numbers_the_lower_triangle_by_rows():
    pattern = BlockPattern.full(4)
    assert blocks_of(pattern) == [(i, j) for i in range(4) for j in range(i + 1)]
    assert pattern.is_full
    np.testing.assert_array_equal(pattern.find(np.array([2, 3]), np.array([1, 3])), [4, 9])


def test_pairs_in_either_order_and_the_diagonal_make_a_pattern():
    pattern = BlockPattern.of_pairs(4, np.array([0, 3, 1, 0]), np.array([2, 1, 3, 2]))
    assert blocks_of(pattern) == [(0, 0), (1, 1), (2, 0), (2, 2), (3, 1), (3, 3)]
    np.testing.assert_array_equal(pattern.diagonal, [0, 1, 3, 5])
    assert not pattern.is_full


def test_a_block_that_is_not_there_has_no_number():
    pattern = BlockPattern.of_pairs(3, np.array([1]), np.array([0]))
    np.testing.assert_array_equal(pattern.find(np.array([2, 1, 2]), np.array([0, 0, 2])), [-1, 1, 3])


def test_nothing_has_a_pattern_too():
    for pattern in (BlockPattern.full(0), BlockPattern.of_pairs(0, np.zeros(0, int), np.zeros(0, int))):
        assert pattern.rows == len(pattern.columns) == 0
        assert len(pattern.find(np.zeros(0, int), np.zeros(0, int))) == 0
