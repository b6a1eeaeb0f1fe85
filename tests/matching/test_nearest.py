from __future__ import annotations

import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.core.scene import Features
from sfm.matching import MatchingConfig, match_features, nearest


def features_of(descriptors: np.ndarray) -> Features:
    n = len(descriptors)
    return Features(np.zeros((n, 2)), np.zeros(n, np.float32), np.zeros(n, np.float32), descriptors.astype(np.uint8))


def related_descriptors(seed: int, count1: int, count2: int, shared: int) -> tuple[Features, Features]:
    """Two sets of which the first `shared` rows of one are noisy copies of rows of the other."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 90, (count1, 128))
    second = rng.integers(0, 90, (count2, 128))
    second[:shared] = np.clip(first[rng.permutation(count1)[:shared]] + rng.integers(-25, 26, (shared, 128)), 0, 255)
    return features_of(first), features_of(second)


def matches_by_definition(features1: Features, features2: Features, config: MatchingConfig) -> list[tuple[int, int]]:
    """The slow, obvious twin: Python integers and sorting."""
    a, b = (f.descriptors.astype(np.int64) for f in (features1, features2))
    table = ((a[:, None] - b[None]) ** 2).sum(axis=2)

    def chosen(row: np.ndarray) -> int:
        order = np.argsort(row, kind="stable")
        second = row[order[1]] if len(order) > 1 else np.inf
        passes = row[order[0]] < config.max_ratio**2 * second and row[order[0]] <= (512 * config.max_distance) ** 2
        return int(order[0]) if passes else -1

    forward = [chosen(row) for row in table]
    backward = [chosen(column) for column in table.T]
    return [(i, j) for i, j in enumerate(forward) if j >= 0 and (not config.mutual or backward[j] == i)]


@pytest.mark.parametrize("mutual", [True, False])
@pytest.mark.parametrize("ratio", [0.8, 0.95, 1.0])
def test_matches_are_those_of_the_definition(ratio, mutual):
    config = MatchingConfig(max_ratio=ratio, mutual=mutual)
    features1, features2 = related_descriptors(1, 90, 70, 40)
    expected = matches_by_definition(features1, features2, config)
    assert len(expected) >= 40
    assert [tuple(row) for row in match_features(features1, features2, config).indices.tolist()] == expected


def test_the_size_of_blocks_does_not_matter(monkeypatch):
    features1, features2 = related_descriptors(2, 61, 83, 30)
    expected = match_features(features1, features2).indices
    monkeypatch.setattr(nearest, "_BLOCK_ROWS", 7)
    assert np.array_equal(match_features(features1, features2).indices, expected)


def test_exchanging_the_images_exchanges_the_columns():
    features1, features2 = related_descriptors(3, 80, 60, 30)
    forward = match_features(features1, features2).indices
    backward = match_features(features2, features1).indices
    assert {tuple(m) for m in forward.tolist()} == {(i, j) for j, i in backward.tolist()}


def test_the_lower_index_wins_a_tie():
    far, near = np.zeros((1, 128)), np.full((1, 128), 40)
    features1, features2 = features_of(near), features_of(np.concatenate([far, near + 1, near - 1]))
    one_way = MatchingConfig(max_ratio=1.0, mutual=False)
    assert match_features(features1, features2, one_way).indices.tolist() == []  # as near as each other: no match
    distances, _, index, *_ = nearest._nearest_of_all(features1.descriptors, features2.descriptors)
    assert index.tolist() == [1]
    assert distances.tolist() == [128.0]


def test_distances_are_exact_at_the_extremes():
    features1 = features_of(np.full((1, 128), 255))
    features2 = features_of(np.stack([np.zeros(128), np.r_[np.full(127, 255), 254], np.full(128, 255)]))
    best, second, index, best2, *_ = nearest._nearest_of_all(features1.descriptors, features2.descriptors)
    assert (best[0], second[0], index[0]) == (0, 1, 2)
    assert best2.tolist() == [128 * 255**2, 1, 0]


def test_a_feature_too_far_from_all_others_has_no_match():
    features1, features2 = features_of(np.full((1, 128), 45)), features_of(np.zeros((1, 128)))
    assert len(match_features(features1, features2)) == 0
    assert len(match_features(features1, features2, MatchingConfig(max_distance=1.1))) == 1


@pytest.mark.parametrize(("count1", "count2"), [(0, 0), (0, 5), (5, 0)])
def test_no_features_give_no_matches(count1, count2):
    features1, features2 = features_of(np.zeros((count1, 128))), features_of(np.zeros((count2, 128)))
    for config in (MatchingConfig(), MatchingConfig(exact_below=0)):
        assert match_features(features1, features2, config).indices.shape == (0, 2)


def test_descriptors_of_different_or_too_great_length_are_refused():
    short, long = features_of(np.zeros((2, 64))), features_of(np.zeros((2, 256)))
    with pytest.raises(ValueError, match="64 and 256"):
        match_features(short, long)
    with pytest.raises(ValueError, match="up to 128"):
        match_features(long, long)


@pytest.mark.parametrize(
    "options",
    [{"max_ratio": 0.0}, {"max_ratio": 1.1}, {"max_distance": 0.0}, {"cells_searched": 0}, {"exact_below": -1}],
)
def test_settings_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match=r"must|above"):
        MatchingConfig(**options)
