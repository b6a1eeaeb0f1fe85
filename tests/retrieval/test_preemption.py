from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.core.scene import DescriptorKind
from sfm.matching import MatchingConfig, match_features
from sfm.retrieval import RetrievalConfig, exhaustive_pairs, probe_scores, probes_of
from tests.retrieval.made_up import features_of, walk


def test_scores_count_the_matches_of_a_complete_comparison():
    probes = [*walk(5), np.zeros((0, 128), np.uint8), walk(1, seed=9)[0][:1]]
    by_matcher = MatchingConfig(max_ratio=0.9, max_distance=1e6)
    scores = probe_scores(probes, RetrievalConfig(probe_ratio=0.9))
    assert scores.pairs.tolist() == [list(pair) for pair in exhaustive_pairs(range(7))]
    for (i, j), score in zip(scores.pairs, scores.scores, strict=True):
        assert score == len(match_features(features_of(probes[i]), features_of(probes[j]), by_matcher))
    assert scores.scores[0] >= 35


def test_only_the_wanted_pairs_are_compared_and_come_out_the_same():
    probes = walk(40)
    every = probe_scores(probes)
    some = every.pairs[::7]
    chosen = probe_scores(probes, pairs=[(i, j) for i, j in some.tolist()])
    np.testing.assert_array_equal(chosen.pairs, some)
    np.testing.assert_array_equal(chosen.scores, every.scores[::7])


def test_the_number_of_threads_does_not_matter_and_each_image_is_told_once():
    probes, told = walk(70), []
    one = probe_scores(probes, threads=1)
    three = probe_scores(probes, threads=3, on_image=told.append)
    np.testing.assert_array_equal(one.scores, three.scores)
    assert told == list(range(70))


def test_probes_are_the_features_of_largest_scale():
    descriptors = np.random.default_rng(1).integers(0, 90, (50, 128), dtype=np.uint8)
    scales = np.random.default_rng(2).permutation(50) + 1.0
    found = probes_of(features_of(descriptors, scales), RetrievalConfig(probes=10))
    np.testing.assert_array_equal(found, descriptors[scales > 40])
    assert len(probes_of(features_of(descriptors, scales), RetrievalConfig(probes=100))) == 50


def test_probes_of_one_scale_come_from_all_over_the_image():
    rows = np.arange(1000)
    descriptors = np.zeros((1000, 128), np.uint8)
    descriptors[:, 0], descriptors[:, 1] = rows // 256, rows % 256
    probes = probes_of(features_of(descriptors, np.ones(1000)), RetrievalConfig(probes=100)).astype(int)
    numbers = 256 * probes[:, 0] + probes[:, 1]
    assert len(numbers) == 100
    assert np.histogram(numbers, bins=5, range=(0, 1000))[0].min() >= 10


def test_squared_distances_of_binary_probes_are_the_bits_that_differ():
    rows = np.random.default_rng(3).integers(0, 256, (2, 32), dtype=np.uint8)
    features = dataclasses.replace(features_of(rows), kind=DescriptorKind.BINARY)
    bits = probes_of(features).astype(int)
    assert bits.shape == (2, 256)
    assert np.sum((bits[0] - bits[1]) ** 2) == sum(int(a ^ b).bit_count() for a, b in zip(*rows.tolist(), strict=True))


@pytest.mark.parametrize(
    "options",
    [
        {"probes": 1}, {"probe_ratio": 0.0}, {"retries": -1}, {"exhaustive_up_to": -1},
        {"max_hamming": 65}, {"overlap": 0}, {"max_distance_m": -1.0},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="must"):
        RetrievalConfig(**options)
