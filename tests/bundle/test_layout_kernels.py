"""The kernels behind the layout against sets and sorted lists."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sfm.bundle import _layout_kernels as kernels

ROWS, POSES = 150, 120
"""More than two words of marks for each row."""


def couplings(rng: np.random.Generator, points: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Offsets and ascending rows of poses, then of shared rows; some points have none."""
    seen = [np.sort(rng.choice(POSES, rng.integers(0, 6), replace=False)) for _ in range(points)]
    also = [POSES + np.sort(rng.choice(ROWS - POSES, rng.integers(0, 4), replace=False)) for _ in range(points)]
    out = []
    for rows in (seen, also):
        out += [np.cumsum([0, *map(len, rows)]), np.concatenate(rows).astype(np.int32)]
    return out[0], out[1], out[2], out[3]


def pairs(starts: np.ndarray, slot: np.ndarray, shared_starts: np.ndarray, shared_slot: np.ndarray) -> set:
    """(high, low) of all rows that one point couples."""
    found = set()
    for p in range(len(starts) - 1):
        rows = [*slot[starts[p] : starts[p + 1]], *shared_slot[shared_starts[p] : shared_starts[p + 1]]]
        found |= {(int(max(pair)), int(min(pair))) for pair in itertools.combinations(rows, 2)}
    return found


def marks(marked: np.ndarray) -> set:
    """(row, column) of the bits that are set."""
    return {
        (i, 64 * k + bit) for i, words in enumerate(marked) for k, word in enumerate(words)
        for bit in range(64) if int(word) >> bit & 1
    }  # fmt: skip


def no_marks() -> np.ndarray:
    return np.zeros((ROWS, ROWS // 64 + 1), np.uint64)


@pytest.mark.parametrize("count", [1, 7, 400])
def test_rows_are_sorted_by_their_key_and_keep_their_order_among_equals(rng, count):
    keys = rng.integers(0, count, 500).astype(np.int32)
    order = rng.permutation(500)[:300].astype(np.int32)
    out, offsets = kernels.sort_rows(order, keys, count)
    np.testing.assert_array_equal(out, sorted(order, key=lambda row: keys[row]))
    np.testing.assert_array_equal(offsets, [np.sum(keys[order] < k) for k in range(count + 1)])
    assert out.dtype == np.int32


def test_nothing_to_sort_has_offsets_all_the_same():
    out, offsets = kernels.sort_rows(np.zeros(0, np.int32), np.zeros(0, np.int32), 3)
    assert len(out) == 0
    np.testing.assert_array_equal(offsets, np.zeros(4))


def test_the_marked_pairs_are_those_that_a_point_couples(rng):
    coupled, marked = couplings(rng), no_marks()
    kernels.mark_pairs(*coupled, marked)
    assert marks(marked) == pairs(*coupled)


def test_marks_are_added_to_those_there_are(rng):
    coupled, marked = couplings(rng), no_marks()
    rows, columns = rng.integers(0, ROWS, (2, 50)).astype(np.int32)
    kernels.mark(rows, columns, marked)
    kernels.mark_pairs(*coupled, marked)
    assert marks(marked) == pairs(*coupled) | set(zip(rows.tolist(), columns.tolist(), strict=True))


def test_marked_blocks_are_listed_by_rows_with_the_diagonal_at_their_ends(rng):
    coupled, marked = couplings(rng), no_marks()
    kernels.mark_pairs(*coupled, marked)
    offsets, columns = kernels.marked_blocks(marked)
    expected = sorted(pairs(*coupled) | {(i, i) for i in range(ROWS)})
    found = [(i, int(j)) for i in range(ROWS) for j in columns[offsets[i] : offsets[i + 1]]]
    assert found == expected


def test_pairs_are_counted_in_the_blocks_that_a_pattern_has(rng):
    starts, slot, shared_starts, shared_slot = couplings(rng, 200)
    marked = no_marks()
    kernels.mark_pairs(starts[:101], slot, shared_starts[:101], shared_slot, marked)  # the first half of the points
    offsets, columns = kernels.marked_blocks(marked)
    counts = np.zeros(len(columns))
    kernels.count_pairs(starts, slot, offsets, columns, counts)
    expected: dict[tuple[int, int], int] = {}
    for p in range(200):
        for low, high in itertools.combinations(slot[starts[p] : starts[p + 1]].tolist(), 2):
            expected[high, low] = expected.get((high, low), 0) + 1
    for i in range(ROWS):
        for k in range(offsets[i], offsets[i + 1]):
            assert counts[k] == expected.get((i, int(columns[k])), 0)
    assert 0 < counts.sum() < sum(expected.values())
