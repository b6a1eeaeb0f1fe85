from __future__ import annotations

import numpy as np
import pytest

from sfm.matching import MatchingConfig, SearchableFeatures, _kernels, match_features
from sfm.matching.cells import sort_into_cells
from tests.matching.test_nearest import features_of, related_descriptors

EVERYWHERE = MatchingConfig(exact_below=0, cells_searched=10**6)


def clustered(seed: int, count: int, spread: int = 12) -> np.ndarray:
    """Descriptors around 60 prototypes, as those of real images are: sparse and in clusters."""
    rng = np.random.default_rng(seed)
    prototypes = np.minimum(rng.exponential(30, (60, 128)), 200)
    noise = rng.normal(0, spread, (count, 128))
    return np.clip(np.rint(prototypes[rng.integers(0, 60, count)] + noise), 0, 255)


@pytest.mark.parametrize("mutual", [True, False])
def test_searching_all_cells_finds_what_a_complete_comparison_finds(mutual):
    features1, features2 = related_descriptors(4, 700, 500, 200)
    complete = match_features(features1, features2, MatchingConfig(mutual=mutual))
    searched = match_features(features1, features2, MatchingConfig(mutual=mutual, exact_below=0, cells_searched=10**6))
    assert len(complete) >= 150
    np.testing.assert_array_equal(searched.indices, complete.indices)


def test_few_cells_find_nearly_all_matches_and_hardly_any_others():
    rng = np.random.default_rng(5)
    base = clustered(5, 4000)
    second = np.clip(base[rng.permutation(4000)] + rng.integers(-6, 7, base.shape), 0, 255)
    features1, features2 = features_of(base), features_of(second)
    complete, found = (
        {tuple(m) for m in match_features(features1, features2, MatchingConfig(exact_below=limit)).indices.tolist()}
        for limit in (10**6, 0)
    )
    assert len(complete) > 3000
    assert len(found & complete) > 0.98 * len(complete)
    assert len(found - complete) < 0.02 * len(complete)


def test_the_index_is_used_above_the_limit_and_gives_the_same_when_it_is_prepared():
    features1, features2 = related_descriptors(6, 300, 300, 120)
    prepared1, prepared2 = SearchableFeatures(features1), SearchableFeatures(features2)
    expected = match_features(features1, features2, EVERYWHERE).indices
    np.testing.assert_array_equal(match_features(prepared1, prepared2, EVERYWHERE).indices, expected)
    assert prepared1.has_cells
    few = SearchableFeatures(features1)
    match_features(few, prepared2, MatchingConfig(exact_below=301))
    assert not few.has_cells


@pytest.mark.parametrize("count", [1, 2, 47, 96, 1000])
def test_every_descriptor_is_in_the_cell_of_its_nearest_centre(count):
    descriptors = clustered(7, count).astype(np.float32)
    cells = sort_into_cells(descriptors)
    assert sorted(cells.order.tolist()) == list(range(count))
    np.testing.assert_array_equal(cells.descriptors, descriptors[cells.order])
    np.testing.assert_array_equal(cells.centers, np.rint(cells.centers))
    label = np.repeat(np.arange(len(cells.centers)), np.diff(cells.starts))
    distance = ((cells.descriptors[:, None].astype(np.int64) - cells.centers.astype(np.int64)) ** 2).sum(axis=2)
    np.testing.assert_array_equal(label, distance.argmin(axis=1))


def test_descriptors_that_are_all_alike_share_one_cell():
    cells = sort_into_cells(np.full((500, 128), 7, np.float32))
    assert np.diff(cells.starts).max() == 500
    features = features_of(np.full((500, 128), 7))
    assert len(match_features(features, features, EVERYWHERE)) == 0


def test_the_nearest_cells_are_those_of_a_sort():
    rng = np.random.default_rng(8)
    descriptors, centers = (rng.integers(0, 4, (n, 128)).astype(np.float32) for n in (200, 30))
    half = np.einsum("ij,ij->i", centers, centers) / 2
    found = np.empty((200, 7), np.int32)
    _kernels.nearest_cells(descriptors @ centers.T, half, found)
    table = half - descriptors @ centers.T
    np.testing.assert_array_equal(found, np.argsort(table, axis=1, kind="stable")[:, :7])


def test_groups_are_a_stable_sort():
    labels = np.random.default_rng(9).integers(0, 5, 100).astype(np.int32)
    starts, order = np.empty(7, np.int64), np.empty(100, np.int32)
    _kernels.group(labels, starts, order)
    np.testing.assert_array_equal(order, np.argsort(labels, kind="stable"))
    np.testing.assert_array_equal(starts, np.searchsorted(np.sort(labels), np.arange(7)))


def test_gathered_rows_are_the_rows():
    source, rows = np.random.default_rng(10).normal(size=(20, 3)), np.array([4, 4, 19, 0], np.int32)
    out = np.empty((4, 3))
    _kernels.gather(source, rows, out)
    np.testing.assert_array_equal(out, source[rows])
