"""Visual words, signatures and votes."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.retrieval import RetrievalConfig, similar_images
from sfm.retrieval.vocabulary import k_means, nearest, quantize, train_vocabulary
from sfm.retrieval.voting import VisualWords, _threshold, features_of_each, inverted_file, votes
from tests.retrieval.made_up import features_of, walk


def random_words(rng: np.random.Generator, count: int, vocabulary: int) -> VisualWords:
    # Few bits and turns, so that features agree by chance.
    signatures = rng.integers(0, 2**6, count).astype(np.uint64) << np.uint64(40)
    return VisualWords(
        rng.integers(0, vocabulary, count).astype(np.int32), signatures, rng.integers(0, 5, count).astype(np.uint8)
    )


def obvious_votes(query: VisualWords, others: list[VisualWords], image: int, max_hamming: int) -> list[int]:
    result = []
    for k, other in enumerate(others):
        turns = [0] * 16
        for f in range(len(query)):
            # A feature votes for the turn of the first that is alike.
            for g in range(len(other)):
                differ = (int(query.signatures[f]) ^ int(other.signatures[g])).bit_count()
                if query.words[f] == other.words[g] and differ <= max_hamming:
                    turns[(int(query.turns[f]) - int(other.turns[g])) % 16] += 1
                    break
        result.append(0 if k == image else max(turns[t] + turns[(t + 1) % 16] for t in range(16)))
    return result


def test_votes_are_those_of_a_comparison_feature_by_feature():
    rng = np.random.default_rng(0)
    images = [random_words(rng, count, 20) for count in (40, 0, 1, 60, 30)]
    file = inverted_file(images, 20)
    assert len(file.images) == 131
    for max_hamming in (0, 2, 64):
        config = RetrievalConfig(max_hamming=max_hamming)
        for image, words in enumerate(images):
            expected = obvious_votes(words, images, image, max_hamming)
            assert votes(file, words, image, len(images), config).tolist() == expected


def test_nearest_centres_are_those_of_a_comparison_with_all_and_the_first_of_equals():
    rng = np.random.default_rng(1)
    rows, centers = (rng.integers(0, 256, (n, 128)).astype(np.float32) for n in (50, 9))
    centers[4] = centers[2]
    expected = [int(np.argmin(np.sum((row - centers) ** 2, axis=1))) for row in rows]
    assert nearest(rows, centers).tolist() == expected
    assert 4 not in expected


def test_k_means_finds_separate_heaps():
    rng = np.random.default_rng(2)
    heaps = rng.integers(0, 200, (3, 128))
    rows = np.repeat(heaps, 40, axis=0) + rng.integers(-2, 3, (120, 128))
    labels = nearest(rows.astype(np.float32), k_means(rows.astype(np.float32), 12, rng))
    assert all(
        len(set(labels[start : start + 40]) & set(labels[end : end + 40])) == 0 for start, end in ((0, 40), (40, 80))
    )


def test_views_of_one_thing_have_one_word_and_signatures_that_agree():
    rng = np.random.default_rng(3)
    things = rng.integers(0, 90, (4000, 128))
    again = np.clip(things + rng.integers(-6, 7, things.shape), 0, 255).astype(np.uint8)
    vocabulary = train_vocabulary(things.astype(np.uint8), 500, rng=rng)
    assert 300 <= len(vocabulary) <= 700
    (words, bits), (words_again, bits_again) = (quantize(vocabulary, d) for d in (things.astype(np.uint8), again))
    assert np.mean(words == words_again) > 0.6
    differ = [int(a ^ b).bit_count() for a, b in zip(bits, bits_again, strict=True)]
    by_chance = [int(a ^ b).bit_count() for a, b in zip(bits, np.roll(bits, 1), strict=True)]
    assert np.mean(differ) < 10
    assert 28 < np.mean(by_chance) < 36


def test_a_vocabulary_is_the_same_for_the_same_seed_and_made_of_whole_numbers():
    descriptors = np.concatenate(walk(40))
    one, two = (train_vocabulary(descriptors, 200, rng=np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(one.words, two.words)
    np.testing.assert_array_equal(one.medians, two.medians)
    assert np.array_equal(one.words, np.rint(one.words))


@pytest.mark.parametrize("shape", [(10, 32), (10, 61)])
def test_binary_descriptors_are_refused(shape):
    with pytest.raises(ValueError, match="visual words need descriptors of 128"):
        train_vocabulary(np.zeros(shape, np.uint8), 10, rng=np.random.default_rng(0))


def test_most_votes_go_to_the_neighbours_on_a_walk():
    images = [features_of(rows) for rows in walk(30, seen=300, step=100)]
    scores = similar_images(images.__getitem__, 30)
    found = {tuple(pair): int(score) for pair, score in zip(scores.pairs.tolist(), scores.scores, strict=True)}
    chance = [score for (i, j), score in found.items() if j - i > 2]
    assert min(found[i, i + 1] for i in range(29)) > 10 * max(chance, default=1)
    assert min(found[i, i + 2] for i in range(28)) > 5 * max(chance, default=1)


def test_a_turned_image_has_as_many_votes_and_one_turned_at_random_few():
    rng = np.random.default_rng(6)
    first, second = walk(2, seen=400, step=0)
    angles = rng.uniform(0, 2 * np.pi, 400)
    images = [
        features_of(first, orientations=angles),
        features_of(second, orientations=(angles + 2.0) % (2 * np.pi)),
        features_of(second, orientations=rng.uniform(0, 2 * np.pi, 400)),
    ]
    turned, mixed, _ = similar_images(images.__getitem__, 3).scores
    assert turned > 3 * mixed


def test_votes_do_not_depend_on_threads_and_differ_little_with_the_seed():
    images = [features_of(rows) for rows in walk(20, seen=200, step=50)]
    told = []
    one = similar_images(images.__getitem__, 20, threads=1)
    three = similar_images(images.__getitem__, 20, threads=3, on_image=told.append)
    np.testing.assert_array_equal(one.pairs, three.pairs)
    np.testing.assert_array_equal(one.scores, three.scores)
    assert told == list(range(20))
    other = similar_images(images.__getitem__, 20, seed=1)
    near = {(i, i + 1) for i in range(19)}
    assert all(near <= {tuple(p) for p in s.pairs[s.scores >= s.threshold].tolist()} for s in (one, other))


def test_images_without_features_have_no_votes():
    rows = walk(2, seen=100, step=10)
    images = [features_of(rows[0]), features_of(rows[0][:0]), features_of(rows[1])]
    assert similar_images(images.__getitem__, 3).pairs.tolist() == [[0, 2]]
    empty = [images[1]] * 3
    assert len(similar_images(empty.__getitem__, 3)) == 0


def test_all_images_together_index_no_more_features_than_memory_is_meant_for():
    config = RetrievalConfig(indexed_features=4096, max_postings=1_000_000)
    assert features_of_each(10, config) == 4096
    assert features_of_each(10_000, config) == 100
    kept = similar_images(
        [features_of(rows) for rows in walk(12, seen=60)].__getitem__, 12, RetrievalConfig(candidates=1)
    )
    assert len(kept) <= 12


def test_fewer_votes_make_a_pair_promising_where_words_are_many_for_the_features():
    config = RetrievalConfig(min_votes=10)
    assert _threshold(4096.0, 65_536, config) == _threshold(512.0, 1024, config) == 10
    assert _threshold(512.0, 512, config) == 10
    assert _threshold(1600.0, 65_536, config) == 5
    assert _threshold(10.0, 65_536, config) == 4
