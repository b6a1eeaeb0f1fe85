import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as scipy_components
from scipy.sparse.csgraph import minimum_spanning_tree as scipy_tree

from sfm.core.graphs import (
    _kernels,
    connected_components,
    connected_labels,
    maximum_spanning_tree,
    two_edge_connected_labels,
)

COUNT = 12
EDGES = st.integers(0, 25).flatmap(lambda m: hnp.arrays(np.int64, (m, 2), elements=st.integers(0, COUNT - 1)))


def labels_by_flooding(count, edges):
    """The slow twin: every node takes the smaller label of its neighbours until nothing changes."""
    labels = list(range(count))
    changed = True
    while changed:
        changed = False
        for i, j in edges:
            low = min(labels[i], labels[j])
            changed |= labels[i] != low or labels[j] != low
            labels[i] = labels[j] = low
    return labels


@given(EDGES)
def test_a_label_is_the_smallest_connected_node(edges):
    assert connected_labels(COUNT, edges).tolist() == labels_by_flooding(COUNT, edges)


@given(EDGES, st.randoms(use_true_random=False))
def test_labels_ignore_the_order_and_direction_of_edges(edges, random):
    shuffled = [row[::-1] if random.random() < 0.5 else row for row in edges.tolist()]
    random.shuffle(shuffled)
    other = np.array(shuffled, np.int32).reshape(-1, 2)
    np.testing.assert_array_equal(connected_labels(COUNT, edges), connected_labels(COUNT, other))


def test_components_of_a_large_random_graph_are_those_of_scipy(rng):
    count = 200_000
    edges = rng.integers(0, count, (150_000, 2), dtype=np.int32)
    edges.flags.writeable = False
    labels = connected_labels(count, edges)
    number, theirs = scipy_components(coo_array((np.ones(len(edges)), edges.T), (count, count)), directed=False)
    assert len(np.unique(labels)) == number
    assert len(np.unique(np.stack([labels, theirs]), axis=1).T) == number
    np.testing.assert_array_equal(labels[labels], labels)


def test_a_long_chain_in_the_worst_order_is_one_component():
    nodes = np.arange(300_000)
    chain = np.stack([nodes[:-1], nodes[1:]], 1)[::-1]
    assert not connected_labels(len(nodes), chain).any()


@given(EDGES)
def test_components_partition_the_nodes_largest_first(edges):
    components = connected_components(COUNT, edges)
    assert sorted(np.concatenate(components).tolist()) == list(range(COUNT))
    keys = [(-len(c), c[0]) for c in components]
    assert keys == sorted(keys)
    labels = connected_labels(COUNT, edges)
    for component in components:
        assert np.all(np.diff(component) > 0)
        assert set(labels[component]) == {component[0]}


def test_a_graph_without_nodes_has_no_components():
    none = np.zeros((0, 2), np.int64)
    assert connected_components(0, none) == []
    assert len(connected_labels(0, none)) == 0
    assert len(maximum_spanning_tree(0, none, np.zeros(0))) == 0


def test_without_edges_every_node_is_alone():
    none = np.zeros((0, 2), np.int64)
    assert [c.tolist() for c in connected_components(3, none)] == [[0], [1], [2]]
    assert len(maximum_spanning_tree(3, none, np.zeros(0))) == 0


@pytest.mark.parametrize("edge", [(0, 3), (-1, 0)])
def test_edges_to_absent_nodes_are_refused(edge):
    edges = np.array([edge])
    with pytest.raises(ValueError, match="there are 3"):
        connected_labels(3, edges)
    with pytest.raises(ValueError, match="there are 3"):
        maximum_spanning_tree(3, edges, np.ones(1))


def test_unite_tells_whether_two_sets_became_one():
    parents = np.arange(4)
    assert _kernels.unite(parents, 3, 1)
    assert not _kernels.unite(parents, 1, 3)
    assert _kernels.unite(parents, 3, 0)
    assert [_kernels.find_root(parents, i) for i in range(4)] == [0, 0, 2, 0]


@given(EDGES, st.integers(0, 2**32 - 1))
def test_the_tree_has_the_greatest_weight_that_scipy_finds(edges, seed):
    edges = edges[edges[:, 0] != edges[:, 1]]
    edges = np.unique(np.sort(edges, 1), axis=0)
    weights = np.random.default_rng(seed).integers(1, 6, len(edges))
    rows = maximum_spanning_tree(COUNT, edges, weights)
    theirs = scipy_tree(coo_array((-weights.astype(float), edges.T), (COUNT, COUNT)))
    assert weights[rows].sum() == -theirs.sum()
    np.testing.assert_array_equal(connected_labels(COUNT, edges[rows]), connected_labels(COUNT, edges))
    assert len(rows) == COUNT - len(connected_components(COUNT, edges))
    assert np.all(np.diff(weights[rows]) <= 0)


@given(EDGES, st.integers(0, 2**32 - 1))
def test_the_tree_does_not_depend_on_the_order_of_edges(edges, seed):
    rng = np.random.default_rng(seed)
    weights = (edges.sum(1) % 3).astype(np.uint8)
    order = rng.permutation(len(edges))
    tree = edges[maximum_spanning_tree(COUNT, edges, weights)]
    shuffled = edges[order][maximum_spanning_tree(COUNT, edges[order], weights[order])]
    np.testing.assert_array_equal(np.sort(tree, 1), np.sort(shuffled, 1))


def test_among_equal_weights_the_smaller_nodes_win():
    edges = np.array([[2, 1], [0, 2], [1, 0], [0, 1], [3, 3]])
    assert maximum_spanning_tree(4, edges, np.ones(5)).tolist() == [2, 1]


def test_infinite_weights_are_allowed_and_nan_is_not():
    edges = np.array([[0, 1], [1, 2], [0, 2]])
    assert maximum_spanning_tree(3, edges, np.array([np.inf, -np.inf, 1.0])).tolist() == [0, 2]
    with pytest.raises(ValueError, match="NaN"):
        maximum_spanning_tree(3, edges, np.array([1.0, np.nan, 2.0]))


def test_a_missing_weight_is_refused():
    with pytest.raises((ValueError, TypeError)):
        maximum_spanning_tree(3, np.array([[0, 1], [1, 2]]), np.ones(1))


def _labels_by_definition(count, edges):
    """Two nodes share a part if no single edge, taken away, separates them."""
    simple = sorted({(min(e), max(e)) for e in edges})
    together = np.ones((count, count), bool)
    for gone in [None, *simple]:
        rest = np.array([e for e in simple if e != gone], np.int64).reshape(-1, 2)
        labels = connected_labels(count, rest)
        together &= labels[:, None] == labels
    return together.argmax(axis=1)


@pytest.mark.parametrize("seed", range(20))
def test_parts_of_the_two_edge_connected_labels_are_those_that_no_edge_separates(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 14))
    edges = rng.integers(0, count, (int(rng.integers(0, 2 * count)), 2))
    expected = _labels_by_definition(count, [tuple(e) for e in edges.tolist()])
    np.testing.assert_array_equal(two_edge_connected_labels(count, edges), expected)
    np.testing.assert_array_equal(two_edge_connected_labels(count, rng.permuted(edges, axis=1)[::-1]), expected)


def test_a_bridge_separates_two_rings():
    rings = [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (2, 3)]
    assert two_edge_connected_labels(6, np.array(rings)).tolist() == [0, 0, 0, 3, 3, 3]
    assert two_edge_connected_labels(6, np.array([*rings, (0, 5)])).tolist() == [0] * 6
