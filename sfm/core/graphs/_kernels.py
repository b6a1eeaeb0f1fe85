"""Union-find kernels; other kernels call `find_root` and `unite` for merging under conditions of their own.

`parents` starts as arange(count). A root is its own parent and always the smallest member of its set, hence
`parents[i] <= i` at all times; halving paths on the way keeps the cost near constant.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def find_root(parents, i):
    """The smallest member of the set of `i`."""
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i


@njit(cache=True, nogil=True)
def unite(parents, i, j):
    """Merges the sets of `i` and `j`; False where they were one already."""
    i, j = find_root(parents, i), find_root(parents, j)
    if i == j:
        return False
    parents[max(i, j)] = min(i, j)
    return True


@njit(cache=True, nogil=True)
def unite_in_order(parents, edges, order):
    """Unites along `edges[order]`; returns which edges, in that order, merged two sets."""
    merged = np.zeros(len(order), np.bool_)
    for k in range(len(order)):
        merged[k] = unite(parents, edges[order[k], 0], edges[order[k], 1])
    return merged


@njit(cache=True, nogil=True)
def flatten(parents):
    """Points every member at its root."""
    for i in range(len(parents)):
        parents[i] = parents[parents[i]]
