"""Connected components by union-find.

Reference:
    Tarjan, Efficiency of a good but not linear set union algorithm, J. ACM 22(2), 1975.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64, Integer

from sfm.core.graphs import _kernels


def connected_labels(count: int, edges: Integer[np.ndarray, "M 2"]) -> Int64[np.ndarray, " V"]:
    """For each of the nodes 0 … count − 1 the smallest node that it is connected with (itself, if with none).

    The labels do not depend on the order or the direction of the edges. Loops and repeated edges do no harm.

    Raises:
        ValueError: an edge names a node that is not there.
    """
    edges = checked_edges(count, edges)
    parents = np.arange(count)
    _kernels.unite_in_order(parents, edges, np.arange(len(edges)))
    _kernels.flatten(parents)
    return parents


def connected_components(count: int, edges: Integer[np.ndarray, "M 2"]) -> list[Int64[np.ndarray, " K"]]:
    """The nodes of each component, ascending; largest component first, equal ones by their smallest node.

    Raises:
        ValueError: an edge names a node that is not there.
    """
    labels = connected_labels(count, edges)
    by_label = np.argsort(labels, kind="stable")
    starts = np.flatnonzero(np.diff(labels[by_label], prepend=-1))
    components = np.split(by_label, starts[1:]) if count else []
    return sorted(components, key=len, reverse=True)


def checked_edges(count: int, edges: Integer[np.ndarray, "M 2"]) -> Int64[np.ndarray, "M 2"]:
    """The edges as the kernels take them.

    Raises:
        ValueError: an edge names a node outside 0 … count − 1.
    """
    edges = np.ascontiguousarray(edges, np.int64)
    if edges.ndim != 2 or edges.shape[1] != 2:
        raise ValueError(f"expected edges (M, 2), got {edges.shape}")
    if len(edges) and (edges.min() < 0 or edges.max() >= count):
        raise ValueError(f"edges name nodes {edges.min()} to {edges.max()}, there are {count}")
    return edges
