"""Orders of observations, and which rows points couple: marks are bits, a row of words for each row of the matrix."""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True, error_model="numpy")
def sort_rows(order, keys, count):
    """The rows in `order`, sorted by their key below `count` (stable), and the offsets (count + 1,) of the keys."""
    offsets = np.zeros(count + 1, np.int64)
    for k in range(len(order)):
        offsets[keys[order[k]] + 1] += 1
    for k in range(count):
        offsets[k + 1] += offsets[k]
    place, out = offsets[:-1].copy(), np.empty(len(order), np.int32)
    for k in range(len(order)):
        row = order[k]
        out[place[keys[row]]] = row
        place[keys[row]] += 1
    return out, offsets


@nb.njit(cache=True, nogil=True, error_model="numpy")
def mark_pairs(starts, slot, shared_starts, shared_slot, marked):
    """Marks all pairs of rows, the lower one first in number, that a point couples."""
    one = np.uint64(1)
    for p in range(len(starts) - 1):
        for a in range(starts[p], starts[p + 1]):
            for b in range(starts[p], a):
                marked[slot[a], slot[b] >> 6] |= one << np.uint64(slot[b] & 63)
        for a in range(shared_starts[p], shared_starts[p + 1]):
            row = marked[shared_slot[a]]
            for b in range(starts[p], starts[p + 1]):
                row[slot[b] >> 6] |= one << np.uint64(slot[b] & 63)
            for b in range(shared_starts[p], a):
                row[shared_slot[b] >> 6] |= one << np.uint64(shared_slot[b] & 63)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def mark(rows, columns, marked):
    """Marks the blocks in `rows` and `columns`, of the lower triangle."""
    for k in range(len(rows)):
        marked[rows[k], columns[k] >> 6] |= np.uint64(1) << np.uint64(columns[k] & 63)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def marked_blocks(marked):
    """Offsets (N + 1,) and columns of the marked blocks by rows, and of those on the diagonal."""
    rows = len(marked)
    offsets = np.zeros(rows + 1, np.int64)
    for i in range(rows):
        marked[i, i >> 6] |= np.uint64(1) << np.uint64(i & 63)
        count = 0
        for word in marked[i]:
            while word != 0:
                word &= word - np.uint64(1)
                count += 1
        offsets[i + 1] = offsets[i] + count
    columns = np.empty(offsets[rows], np.int32)
    k = 0
    for i in range(rows):
        for j in range(i + 1):
            if marked[i, j >> 6] >> np.uint64(j & 63) & np.uint64(1):
                columns[k] = j
                k += 1
    return offsets, columns


@nb.njit(cache=True, nogil=True, error_model="numpy")
def count_pairs(starts, slot, offsets, columns, out):
    """Adds to each block of a pattern how many points couple the two rows."""
    for p in range(len(starts) - 1):
        for a in range(starts[p], starts[p + 1]):
            at, end = offsets[slot[a]], offsets[slot[a] + 1]
            for b in range(starts[p], a):
                while at < end and columns[at] < slot[b]:
                    at += 1
                if at < end and columns[at] == slot[b]:
                    out[at] += 1.0
