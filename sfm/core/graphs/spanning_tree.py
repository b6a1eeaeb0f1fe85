"""Spanning trees of weighted graphs, by Kruskal's algorithm."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64, Integer

from sfm.core.graphs import _kernels
from sfm.core.graphs.union_find import checked_edges


def maximum_spanning_tree(
    count: int, edges: Integer[np.ndarray, "M 2"], weights: Float[np.ndarray, " M"] | Integer[np.ndarray, " M"]
) -> Int64[np.ndarray, " T"]:
    """Rows of the edges that connect all that can be connected, at the greatest sum of weights.

    Of equally heavy edges the one with the smaller nodes is preferred (of repeated ones the first), so the tree does
    not depend on the order of the edges. A graph of several components gives a tree for each: there are count − T.

    Args:
        count: the nodes are 0 … count − 1.
        edges: undirected; loops are never chosen.

    Returns:
        Rows of `edges`, heaviest first.

    Raises:
        ValueError: a weight is NaN, edges and weights differ in length, or an edge names a node that is not there.
    """
    edges = checked_edges(count, edges)
    if np.shape(weights) != (len(edges),):
        raise ValueError(f"{np.shape(weights)} weights for {len(edges)} edges")
    if np.isnan(weights).any():
        raise ValueError("a weight is NaN")
    # Ranks, since negating the weights themselves would overflow unsigned ones.
    rank = np.unique(weights, return_inverse=True)[1]
    order = np.lexsort((edges.max(1), edges.min(1), -rank))
    merged = _kernels.unite_in_order(np.arange(count), edges, order)
    return order[merged]
