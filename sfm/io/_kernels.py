"""Records of a fixed head and a tail of variable length, split into two arrays and joined again.

file:   head₀ tail₀ head₁ tail₁ …        tailᵢ = countᵢ items of `item_size` bytes
count:  a little-endian uint64 at `count_at` in the head
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def measure_records(data, head_size, count_at, item_size, counts):
    """Fills `counts` with the items of each record; returns the end of the last one, or −1 − (record that overruns).

    `data` are the bytes from the first record on.
    """
    position = 0
    for record in range(counts.size):
        if position + head_size > data.size:
            return -1 - record
        count = 0
        for byte in range(8):
            count |= np.int64(data[position + count_at + byte]) << (8 * byte)
        # In unsigned terms: a negative count or one beyond the file cannot be.
        if count < 0 or count > (data.size - position - head_size) // item_size:
            return -1 - record
        counts[record] = count
        position += head_size + count * item_size
    return position


@njit(cache=True, nogil=True)
def split_records(data, offsets, item_size, heads, tails):
    """Copies the bytes of each record to its row of `heads` (P, head) and its items to `tails` (n · item_size)."""
    position = 0
    for record in range(heads.shape[0]):
        for byte in range(heads.shape[1]):
            heads[record, byte] = data[position + byte]
        position += heads.shape[1]
        for byte in range(offsets[record] * item_size, offsets[record + 1] * item_size):
            tails[byte] = data[position]
            position += 1


@njit(cache=True, nogil=True)
def join_records(heads, offsets, item_size, tails, data):
    """The inverse of `split_records`: fills `data`."""
    position = 0
    for record in range(heads.shape[0]):
        for byte in range(heads.shape[1]):
            data[position + byte] = heads[record, byte]
        position += heads.shape[1]
        for byte in range(offsets[record] * item_size, offsets[record + 1] * item_size):
            data[position] = tails[byte]
            position += 1
