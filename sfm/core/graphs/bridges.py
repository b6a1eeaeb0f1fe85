"""Parts of a graph that hang together by more than one edge."""

from __future__ import annotations

from collections import deque

import numpy as np
from jaxtyping import Int64, Integer

from sfm.core.graphs.union_find import checked_edges


def two_edge_connected_labels(count: int, edges: Integer[np.ndarray, "M 2"]) -> Int64[np.ndarray, " V"]:
    """For each of the nodes 0 … count − 1 a label, the same for nodes that no single edge separates.

    A label is the smallest node of its part. The edges that separate parts are the bridges: those of a spanning tree
    that no other edge goes around. Each other edge, one after the other, unites the nodes on its way through the tree.
    Loops and repeated edges do no harm; a repeated edge counts once.

    Raises:
        ValueError: an edge names a node that is not there.
    """
    edges = np.unique(np.sort(checked_edges(count, edges), axis=1), axis=0)
    parent, depth, others = _spanning_forest(count, edges.tolist())
    up = list(range(count))

    def find(node: int) -> int:
        while up[node] != node:
            up[node] = up[up[node]]
            node = up[node]
        return node

    for i, j in others:
        a, b = find(i), find(j)
        while a != b:
            if depth[a] < depth[b]:
                a, b = b, a
            up[a] = find(parent[a])
            a = find(a)
    roots = np.array([find(node) for node in range(count)], np.int64)
    smallest = np.full(count, count, np.int64)
    np.minimum.at(smallest, roots, np.arange(count))
    return smallest[roots]


def _spanning_forest(count: int, edges: list[list[int]]) -> tuple[list[int], list[int], list[tuple[int, int]]]:
    """Parent (itself for a root) and depth of every node, and the edges that are not in the forest."""
    neighbors: list[list[int]] = [[] for _ in range(count)]
    for i, j in edges:
        neighbors[i].append(j)
        neighbors[j].append(i)
    parent, depth = [-1] * count, [0] * count
    for root in range(count):
        if parent[root] >= 0:
            continue
        parent[root] = root
        waiting = deque([root])
        while waiting:
            node = waiting.popleft()
            for other in neighbors[node]:
                if parent[other] < 0:
                    parent[other], depth[other] = node, depth[node] + 1
                    waiting.append(other)
    others = [(i, j) for i, j in edges if i != j and parent[i] != j and parent[j] != i]
    return parent, depth, others
