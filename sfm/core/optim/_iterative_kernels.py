"""Kernels of the iterative solution; see `preconditioners`."""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def join_pairs(first, second, order, rows, largest):
    """Joins the sets of the pairs in `order` unless they would have more than `largest` rows; the set of each row."""
    parent, size = np.arange(rows), np.ones(rows, np.int64)
    for n in order:
        a, b = first[n], second[n]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a != b and size[a] + size[b] <= largest:
            parent[max(a, b)] = min(a, b)
            size[min(a, b)] = size[a] + size[b]
    for i in range(rows):  # a parent has a smaller number, so it is final by now
        parent[i] = parent[parent[i]]
    return parent
