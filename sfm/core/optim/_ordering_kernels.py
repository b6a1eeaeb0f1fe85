"""Kernels on the graph of a symmetric matrix: elimination order, elimination tree, rows of the factor."""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def minimum_degree(offsets, neighbours):
    """An order (N,) in which vertices of about the smallest degree are eliminated first.

    Eliminating a vertex makes its neighbours a clique. A clique is kept as one *element*, which takes in the
    elements that it covers: a vertex has a list of neighbours from the start and a list of elements, and both
    together never grow. The degree is bounded from above by what each element adds to the newest one.
    """
    N = len(offsets) - 1
    own, cliques = neighbours.copy(), np.empty_like(neighbours)
    own_count, clique_count = offsets[1:] - offsets[:-1], np.zeros(N, np.int64)
    degree = own_count.copy()
    pool = np.empty(2 * (len(neighbours) + N), np.int64)
    begin, size, used = np.zeros(N, np.int64), np.zeros(N, np.int64), 0
    head, after, before = np.full(N + 1, -1), np.full(N, -1), np.full(N, -1)
    for i in range(N - 1, -1, -1):
        d = degree[i]
        after[i] = head[d]
        if head[d] >= 0:
            before[head[d]] = i
        head[d] = i
    order, marked, met, outside = np.empty(N, np.int64), np.full(N, -1), np.full(N, -1), np.zeros(N, np.int64)
    least = 0
    for step in range(N):
        while head[least] < 0:
            least += 1
        p = head[least]
        head[least] = after[p]
        if after[p] >= 0:
            before[after[p]] = -1
        order[step], marked[p] = p, step
        if used + N > len(pool):  # Elements that others took in make room; those left are no more than edges.
            used = 0
            for e in order[:step]:
                for n in range(size[e]):
                    pool[used + n] = pool[begin[e] + n]
                begin[e] = used
                used += size[e]
        # The new element: all neighbours, through edges and through elements.
        begin[p] = used
        for n in range(offsets[p], offsets[p] + clique_count[p]):
            e = cliques[n]
            for m in range(begin[e], begin[e] + size[e]):
                i = pool[m]
                if marked[i] != step:
                    marked[i] = step
                    pool[used] = i
                    used += 1
            size[e] = 0
        for n in range(offsets[p], offsets[p] + own_count[p]):
            i = own[n]
            if marked[i] != step:
                marked[i] = step
                pool[used] = i
                used += 1
        size[p] = used - begin[p]
        members = pool[begin[p] : used]
        for i in members:
            for n in range(offsets[i], offsets[i] + clique_count[i]):
                e = cliques[n]
                if met[e] != step:
                    met[e], outside[e] = step, size[e]
                outside[e] -= 1
        for i in members:
            at, bound, kept = offsets[i], 0, 0
            for n in range(at, at + clique_count[i]):
                e = cliques[n]
                if size[e] and outside[e] > 0:
                    bound += outside[e]
                    cliques[at + kept] = e
                    kept += 1
            cliques[at + kept] = p
            clique_count[i] = kept + 1
            kept = 0
            for n in range(at, at + own_count[i]):
                if marked[own[n]] != step:
                    own[at + kept] = own[n]
                    kept += 1
            own_count[i] = kept
            d = min(degree[i], bound + kept) + size[p] - 1
            d = min(d, N - step - 2)
            if before[i] >= 0:
                after[before[i]] = after[i]
            else:
                head[degree[i]] = after[i]
            if after[i] >= 0:
                before[after[i]] = before[i]
            degree[i] = d
            before[i], after[i] = -1, head[d]
            if head[d] >= 0:
                before[head[d]] = i
            head[d] = i
            least = min(least, d)
        for i in members:
            for n in range(offsets[i], offsets[i] + clique_count[i]):
                e = cliques[n]
                if e != p and met[e] == step and outside[e] == 0:
                    size[e] = 0
    return order


@nb.njit(cache=True, nogil=True)
def elimination_tree(offsets, neighbours, order):
    """Parent (N,) of each place in the order, −1 for roots, and the number of entries below it in its column."""
    N = len(order)
    place = np.empty(N, np.int64)
    for i in range(N):
        place[order[i]] = i
    parent, root, count, seen = np.full(N, -1), np.full(N, -1), np.zeros(N, np.int64), np.full(N, -1)
    for i in range(N):
        for n in range(offsets[order[i]], offsets[order[i] + 1]):
            k = place[neighbours[n]]
            while k != -1 and k < i:
                above = root[k]
                root[k] = i
                if above == -1:
                    parent[k] = i
                k = above
        seen[i] = i
        for n in range(offsets[order[i]], offsets[order[i] + 1]):
            k = place[neighbours[n]]
            while k < i and seen[k] != i:
                seen[k] = i
                count[k] += 1
                k = parent[k]
    return parent, count


@nb.njit(cache=True, nogil=True)
def factor_structure(offsets, neighbours, order, parent, starts):
    """Rows below the diagonal of each column of the factor, ascending; those of column k begin at starts[k]."""
    N = len(order)
    place = np.empty(N, np.int64)
    for i in range(N):
        place[order[i]] = i
    rows, used, seen = np.empty(starts[N], np.int32), starts[:-1].copy(), np.full(N, -1)
    for i in range(N):
        seen[i] = i
        for n in range(offsets[order[i]], offsets[order[i] + 1]):
            k = place[neighbours[n]]
            while k < i and seen[k] != i:
                seen[k] = i
                rows[used[k]] = i
                used[k] += 1
                k = parent[k]
    return rows
