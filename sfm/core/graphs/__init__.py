"""Graphs of images and features: nodes are numbers, edges are rows of two."""

from sfm.core.graphs.bridges import two_edge_connected_labels
from sfm.core.graphs.spanning_tree import maximum_spanning_tree
from sfm.core.graphs.union_find import connected_components, connected_labels

__all__ = ["connected_components", "connected_labels", "maximum_spanning_tree", "two_edge_connected_labels"]
