from __future__ import annotations

import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.core.scene import Features
from sfm.matching import MatchingConfig, match_features
from sfm.retrieval import (
    RetrievalConfig,
    exhaustive_pairs,
    missing_links,
    pair_scores,
    probes_of,
    promising_pairs,
)


def walk(images: int, seed: int = 0, step: int = 20, seen: int = 60) -> list[np.ndarray]:
    """Descriptors of a walk past a row of things: image k sees things `step` k … `step` k + `seen`, with noise."""
    rng = np.random.default_rng(seed)
    things = rng.integers(0, 90, (step * images + seen, 128))
    return [
        np.clip(things[step * k : step * k + seen] + rng.integers(-8, 9, (seen, 128)), 0, 255).astype(np.float32)
        for k in range(images)
    ]


def features_of(descriptors: np.ndarray, scales: np.ndarray | None = None) -> Features:
    n = len(descriptors)
    scales = np.zeros(n) if scales is None else scales
    return Features(np.zeros((n, 2)), scales.astype(np.float32), np.zeros(n, np.float32), descriptors.astype(np.uint8))


def test_scores_count_the_matches_of_a_complete_comparison():
    probes = [*walk(5), np.zeros((0, 128), np.float32), walk(1, seed=9)[0][:1]]
    config = RetrievalConfig(probe_ratio=0.9)
    by_matcher = MatchingConfig(max_ratio=0.9, max_distance=1e6)
    scores = pair_scores(probes, config)
    for i, j in exhaustive_pairs(range(7)):
        expected = len(match_features(features_of(probes[i]), features_of(probes[j]), by_matcher))
        assert scores[i, j] == scores[j, i] == expected
    assert not np.diag(scores).any()
    assert scores[0, 1] >= 35


def test_the_number_of_threads_does_not_matter():
    probes = walk(70)
    np.testing.assert_array_equal(pair_scores(probes, threads=1), pair_scores(probes, threads=3))


def test_probes_are_the_features_of_largest_scale():
    descriptors = np.random.default_rng(1).integers(0, 90, (50, 128))
    scales = np.random.default_rng(2).permutation(50) + 1.0
    found = probes_of(features_of(descriptors, scales), RetrievalConfig(probes=10))
    np.testing.assert_array_equal(found, descriptors[scales > 40])
    assert len(probes_of(features_of(descriptors, scales), RetrievalConfig(probes=100))) == 50


def test_promising_are_neighbours_on_the_walk_and_hardly_any_others():
    scores = pair_scores(walk(30))
    found = set(promising_pairs(scores, RetrievalConfig(neighbors=0)))
    near = {(i, j) for i, j in exhaustive_pairs(range(30)) if j - i <= 2}
    assert near <= found
    assert len(found - near) < 10


def test_pairs_without_any_match_are_promising_only_if_their_names_are_neighbours():
    found = promising_pairs(np.zeros((5, 5), np.int32), RetrievalConfig(neighbors=1))
    assert found == [(0, 1), (1, 2), (2, 3), (3, 4)]


def test_the_best_partners_are_promising_even_with_few_matches():
    scores = np.zeros((6, 6), np.int32)
    scores[0, 1:] = scores[1:, 0] = [1, 1, 3, 4, 2]
    found = promising_pairs(scores, RetrievalConfig(neighbors=0, partners=2, min_score=9))
    assert found == [(0, 3), (0, 4), (0, 5)]  # image 5 has no better partner than image 0


def test_missing_links_join_parts_by_pairs_that_were_not_tried():
    scores = np.ones((6, 6), np.int32) - np.eye(6, dtype=np.int32)
    triangles = [(0, 1), (1, 2), (0, 2), (3, 4), (4, 5), (3, 5)]
    assert missing_links(scores, [*triangles, (5, 0)], triangles, RetrievalConfig(retries=0)) == []
    links = missing_links(scores, [*triangles, (5, 0)], triangles)
    assert len(links) == 8  # all between the triangles but the one that was tried
    assert (0, 5) not in links
    assert (1, 4) in missing_links(scores, triangles, [*triangles, (0, 5)])  # one link alone is not enough
    assert missing_links(scores, triangles, [*triangles, (0, 5), (1, 4)]) == []


def test_missing_links_are_the_most_similar_when_there_are_many():
    scores = np.triu(np.arange(100).reshape(10, 10), 1)
    scores = (scores + scores.T).astype(np.int32)
    links = missing_links(scores, [], [], RetrievalConfig(retries=1))
    assert len(links) == 10
    assert min(scores[i, j] for i, j in links) >= np.sort(scores[np.triu_indices(10, 1)])[-10]


@pytest.mark.parametrize("options", [{"probes": 1}, {"probe_ratio": 0.0}, {"retries": -1}, {"exhaustive_up_to": -1}])
def test_settings_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="must"):
        RetrievalConfig(**options)


def test_exhaustive_pairs_are_sorted_and_each_occurs_once():
    assert exhaustive_pairs([5, 1, 3, 1]) == [(1, 3), (1, 5), (3, 5)]
    assert exhaustive_pairs([4]) == []
