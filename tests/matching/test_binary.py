from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.core.scene import DescriptorKind, Features
from sfm.matching import MatchingConfig, SearchableFeatures, _binary_kernels, match_features
from sfm.matching.binary import nearest_bits, packed


def features_of(descriptors: np.ndarray, kind: DescriptorKind = DescriptorKind.BINARY) -> Features:
    n = len(descriptors)
    return Features(
        np.zeros((n, 2)), np.zeros(n, np.float32), np.zeros(n, np.float32), descriptors.astype(np.uint8), kind
    )


def related_bits(seed: int, count1: int, count2: int, shared: int, flipped: float, width: int = 32):
    """Two sets of rows of bytes, of which the first `shared` of the second are rows of the first with other bits."""
    rng = np.random.default_rng(seed)
    first, second = (rng.integers(0, 256, (count, width), np.uint8) for count in (count1, count2))
    partners = rng.permutation(count1)[:shared]
    noise = np.packbits(rng.random((shared, width * 8)) < flipped, axis=1)
    second[:shared] = first[partners] ^ noise
    return first, second, partners


def matches_by_definition(first: np.ndarray, second: np.ndarray, config: MatchingConfig) -> list[tuple[int, int]]:
    """The slow, obvious twin: bits in a list and sorting."""
    bits1, bits2 = (np.unpackbits(rows, axis=1).astype(np.int64) for rows in (first, second))
    table = (bits1[:, None] != bits2[None]).sum(axis=2)

    def chosen(row: np.ndarray) -> int:
        order = np.argsort(row, kind="stable")
        runner_up = row[order[1]] if len(order) > 1 else np.inf
        passes = row[order[0]] < config.max_ratio * runner_up and row[order[0]] <= config.max_bits * bits1.shape[1]
        return int(order[0]) if passes else -1

    forward, backward = [chosen(row) for row in table], [chosen(column) for column in table.T]
    return [(i, j) for i, j in enumerate(forward) if j >= 0 and (not config.mutual or backward[j] == i)]


@pytest.mark.parametrize("mutual", [True, False])
@pytest.mark.parametrize("width", [32, 61, 64])
def test_matches_are_those_of_the_definition(mutual, width):
    first, second, _ = related_bits(1, 90, 70, 50, 0.2, width)
    config = MatchingConfig(mutual=mutual, max_ratio=0.9)
    expected = matches_by_definition(first, second, config)
    assert len(expected) > 30
    found = match_features(features_of(first), SearchableFeatures(features_of(second)), config)
    assert [tuple(row) for row in found.indices.tolist()] == expected


def test_ties_go_to_the_lower_index_in_both_directions():
    first = np.array([[0] * 8, [255] * 8, [0] * 8], np.uint8)
    second = np.array([[1] + [0] * 7, [2] + [0] * 7], np.uint8)
    best1, second1, index1, best2, _, index2 = nearest_bits(packed(first), packed(second), 10)
    assert (best1.tolist(), second1.tolist(), index1.tolist()) == ([1, 63, 1], [1, 63, 1], [0, 0, 0])
    assert (best2.tolist(), index2.tolist()) == ([1, 1], [0, 0])


def test_hashes_find_what_a_complete_comparison_finds():
    first, second, partners = related_bits(2, 3000, 2500, 2000, 0.1)
    complete, hashed = (
        match_features(features_of(first), features_of(second), MatchingConfig(hashed_above=limit)).indices
        for limit in (10**6, 0)
    )
    true = {(int(i), j) for j, i in enumerate(partners)}
    assert {tuple(m) for m in complete.tolist()} == true
    found = {tuple(m) for m in hashed.tolist()}
    assert len(found & true) > 0.97 * len(true)
    assert len(found - true) < 0.01 * len(true)


def test_distances_in_buckets_are_those_of_the_definition_where_they_are_found():
    first, second, _ = related_bits(3, 400, 300, 200, 0.15)
    best1, second1, index1, best2, second2, index2 = nearest_bits(packed(first), packed(second), 0)
    bits1, bits2 = (np.unpackbits(rows, axis=1) for rows in (first, second))
    table = (bits1[:, None] != bits2[None]).sum(axis=2)
    met = index1 >= 0
    assert met.mean() > 0.9
    np.testing.assert_array_equal(best1[met], table[np.flatnonzero(met), index1[met]])
    assert (second1[met] >= best1[met]).all()
    back = index2 >= 0
    np.testing.assert_array_equal(best2[back], table[index2[back], np.flatnonzero(back)])
    assert (second2[back] >= best2[back]).all()


def test_hashes_are_the_chosen_bits():
    rng = np.random.default_rng(4)
    words = rng.integers(0, 2**64, (20, 4), np.uint64)
    positions = rng.integers(0, 256, (3, 9)).astype(np.int32)
    keys = np.empty((3, 20), np.int32)
    _binary_kernels.hash_bits(words, positions, keys)
    for t in range(3):
        for i in range(20):
            bits = [int(words[i, p // 64]) >> (p % 64) & 1 for p in positions[t].tolist()]
            assert keys[t, i] == int("".join(map(str, bits)), 2)


def test_compiled_and_plain_kernels_agree():
    """The plain form of the bit count runs where compilation is off."""
    script = (
        "import numpy as np; from sfm.matching.binary import nearest_bits, packed\n"
        "rng = np.random.default_rng(5); a, b = (packed(rng.integers(0, 256, (n, 9), np.uint8)) for n in (12, 9))\n"
        "print([[c.tolist() for c in nearest_bits(a, b, limit)] for limit in (0, 99)])"
    )
    said = [
        subprocess.run(
            [sys.executable, "-W", "error", "-c", script],
            env=os.environ | {"NUMBA_DISABLE_JIT": disabled, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True, text=True, check=True,
        ).stdout
        for disabled in ("0", "1")
    ]  # fmt: skip
    assert said[0] == said[1] != ""


@pytest.mark.parametrize(("count1", "count2"), [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_few_features_give_few_matches(count1, count2):
    first, second = (features_of(np.zeros((n, 32))) for n in (count1, count2))
    for config in (MatchingConfig(), MatchingConfig(hashed_above=0)):
        assert len(match_features(first, second, config)) == min(count1, count2)


def test_kinds_are_not_mixed():
    binary, sift = features_of(np.zeros((2, 32))), features_of(np.zeros((2, 32)), DescriptorKind.SIFT)
    with pytest.raises(ValueError, match="BINARY and SIFT"):
        match_features(binary, sift)


def test_learned_descriptors_are_compared_around_128_by_their_own_length():
    rows = np.full((1, 128), 128)
    rows[0, 0] = 228
    other = np.full((1, 128), 128)
    other[0, 0] = 148  # 80 of 256 apart: 0.31
    first, second = (features_of(r, DescriptorKind.LEARNED) for r in (rows, other))
    assert len(match_features(first, second, MatchingConfig(max_distance=0.32))) == 1
    assert len(match_features(first, second, MatchingConfig(max_distance=0.31))) == 0


@pytest.mark.parametrize("options", [{"max_bits": 0.0}, {"max_bits": 1.5}, {"hashed_above": -1}])
def test_settings_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="must"):
        MatchingConfig(**options)
