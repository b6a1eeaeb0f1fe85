"""Bags of words, VLAD and Fisher vectors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.retrieval import RetrievalConfig
from sfm.retrieval.aggregation import aggregated_partners
from sfm.retrieval.bag_of_words import bag_partners, best_partners, weighed_bags
from sfm.retrieval.fisher import fisher_vector, train_mixture
from sfm.retrieval.vlad import vlad
from tests.retrieval.made_up import features_of, walk


@pytest.mark.parametrize("similarity", ["tfidf", "vlad", "fisher"])
def test_vectors_find_the_neighbours_on_a_walk(similarity):
    images = [features_of(rows) for rows in walk(30, seen=200, step=50)]
    config = RetrievalConfig(similarity=similarity, candidates=4)
    found = aggregated_partners(images.__getitem__, 30, config)
    near = {(i, i + 1) for i in range(29)}
    assert len(near.intersection(found)) >= 28
    assert len(found) <= 120
    assert found == aggregated_partners(images.__getitem__, 30, config)


def test_few_images_are_all_candidates():
    assert len(aggregated_partners(lambda image: features_of(walk(1)[0]), 5)) == 10


def test_similarity_of_bags_is_the_cosine_of_tf_idf():
    words = [np.array(some, np.int32) for some in ([0, 0, 1, 3], [1, 2, 3], [3], [0, 2, 2, 2, 3])]
    bags = weighed_bags(words, 5).toarray()
    weights = np.zeros((4, 5))
    for image, some in enumerate(words):
        for word in set(some.tolist()):
            having = sum(word in other for other in words)
            weights[image, word] = np.sqrt(np.sum(some == word)) * np.log(4 / having)
    length = np.linalg.norm(weights, axis=1)
    assert length[2] == 0  # its one word is on every image
    np.testing.assert_allclose(bags, weights / np.where(length > 0, length, 1)[:, None], atol=1e-12)
    assert all(2 not in pair for pair in bag_partners(weighed_bags(words, 5), 3))


def test_the_best_partners_are_the_most_similar_and_never_oneself():
    similar = np.array([[9.0, 1.0, 2.0, 0.0], [1.0, 9.0, 0.0, 0.0]])
    assert set(best_partners(similar, 0, 1)) == {(0, 2), (0, 1)}
    assert set(best_partners(similar, 0, 4)) == {(0, 1), (0, 2)}  # nothing in common is no partner


def test_vlad_is_the_sum_of_what_descriptors_differ_from_their_centres():
    rng = np.random.default_rng(0)
    rows = rng.integers(0, 255, (50, 128), dtype=np.uint8)
    centers = rng.integers(0, 255, (3, 128)).astype(np.float32)
    expected = np.zeros((3, 128))
    for row in rows.astype(float):
        k = np.argmin(np.sum((row - centers) ** 2, axis=1))
        expected[k] += row - centers[k]
    expected /= np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), 1e-12)
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(vlad(rows, centers), expected.ravel(), atol=1e-6)
    assert not vlad(rows[:0], centers).any()


def test_a_fisher_vector_is_the_gradient_of_the_likelihood():
    rng = np.random.default_rng(1)
    rows = rng.integers(0, 100, (400, 128), dtype=np.uint8)
    mixture = train_mixture(rows, 3, 4, rng=rng)
    assert mixture.weights.sum() == pytest.approx(1)
    some = rows[:20]
    reduced = (some - mixture.mean) @ mixture.axes

    def likelihood(means: np.ndarray, variances: np.ndarray) -> float:
        z = (reduced[:, None] - means) ** 2 / variances
        return np.log(np.sum(mixture.weights * np.exp(-0.5 * (z + np.log(variances)).sum(2)), axis=1)).mean()

    deviation, root = np.sqrt(mixture.variances), np.sqrt(mixture.weights)[:, None]
    steps = [np.eye(1, 12, k).reshape(3, 4) * 1e-5 * deviation for k in range(12)]
    of_means = [
        (likelihood(mixture.means + d, mixture.variances) - likelihood(mixture.means - d, mixture.variances)) / 2e-5
        for d in steps
    ]
    of_deviations = [
        (likelihood(mixture.means, (deviation + d) ** 2) - likelihood(mixture.means, (deviation - d) ** 2)) / 2e-5
        for d in steps
    ]
    gradient = np.concatenate([np.reshape(of_means, (3, 4)) / root, np.reshape(of_deviations, (3, 4)) / root / 2**0.5])
    expected = np.sign(gradient.ravel()) * np.sqrt(np.abs(gradient.ravel()))
    np.testing.assert_allclose(fisher_vector(mixture, some), expected / np.linalg.norm(expected), atol=1e-3)
    assert not fisher_vector(mixture, some[:0]).any()


def test_a_mixture_needs_descriptors_and_no_other_vector_is_known():
    rng = np.random.default_rng(2)
    with pytest.raises(ValueError, match="need 8 descriptors"):
        train_mixture(np.zeros((7, 128), np.uint8), 4, rng=rng)
    images = [features_of(rows) for rows in walk(4)]
    with pytest.raises(ValueError, match="no vector"):
        aggregated_partners(images.__getitem__, 4, dataclasses.replace(RetrievalConfig(), candidates=1))
