from __future__ import annotations

import numpy as np

from sfm.retrieval import PairScores, RetrievalConfig, exhaustive_pairs, missing_links, probe_scores, promising_pairs
from sfm.retrieval.scores import partner_ranks, summed_scores
from tests.retrieval.made_up import walk


def scores_of(matrix: np.ndarray, threshold: int = 6) -> PairScores:
    """Scores of all pairs from the upper triangle of a matrix."""
    pairs = np.argwhere(np.triu(np.ones_like(matrix), 1))
    return PairScores(len(matrix), pairs, matrix[pairs[:, 0], pairs[:, 1]], threshold)


def test_promising_are_neighbours_on_the_walk_and_hardly_any_others():
    found = set(promising_pairs(probe_scores(walk(30)), RetrievalConfig(neighbors=0)))
    near = {(i, j) for i, j in exhaustive_pairs(range(30)) if j - i <= 2}
    assert near <= found
    assert len(found - near) < 10


def test_pairs_without_any_match_are_promising_only_if_their_names_are_neighbours():
    for scores in (scores_of(np.zeros((5, 5), np.int32)), PairScores(5, np.zeros((0, 2), int), np.zeros(0, int), 6)):
        assert promising_pairs(scores, RetrievalConfig(neighbors=1)) == [(0, 1), (1, 2), (2, 3), (3, 4)]


def test_the_best_partners_are_promising_even_with_few_matches():
    matrix = np.zeros((6, 6), np.int32)
    matrix[0, 1:] = [1, 1, 3, 4, 2]
    found = promising_pairs(scores_of(matrix, 9), RetrievalConfig(neighbors=0, partners=2))
    assert found == [(0, 3), (0, 4), (0, 5)]  # image 5 has no better partner than image 0


def test_the_rank_of_a_pair_is_the_better_of_those_of_its_images():
    rng = np.random.default_rng(0)
    matrix = np.triu(rng.integers(0, 5, (9, 9)), 1)
    scores, whole = scores_of(matrix), matrix + matrix.T
    for (i, j), rank in zip(scores.pairs, partner_ranks(scores), strict=True):
        ranks = [
            sum(whole[a, k] > whole[a, b] or (whole[a, k] == whole[a, b] and k < b) for k in range(9) if k != a)
            for a, b in ((i, j), (j, i))
        ]
        assert rank == min(ranks)


def test_scores_of_both_directions_are_added_up():
    summed = summed_scores(4, np.array([[3, 1], [0, 2], [1, 3]]), np.array([5, 2, 7]), 6)
    assert summed.pairs.tolist() == [[0, 2], [1, 3]]
    assert summed.scores.tolist() == [2, 12]


def test_missing_links_join_parts_by_pairs_that_were_not_tried():
    scores = scores_of(np.ones((6, 6), np.int32))
    triangles = [(0, 1), (1, 2), (0, 2), (3, 4), (4, 5), (3, 5)]
    assert missing_links(scores, [*triangles, (5, 0)], triangles, RetrievalConfig(retries=0)) == []
    links = missing_links(scores, [*triangles, (5, 0)], triangles)
    assert len(links) == 8  # all between the triangles but the one that was tried
    assert (0, 5) not in links
    assert (1, 4) in missing_links(scores, triangles, [*triangles, (0, 5)])  # one link alone is not enough
    assert missing_links(scores, triangles, [*triangles, (0, 5), (1, 4)]) == []


def test_missing_links_are_the_most_similar_when_there_are_many():
    scores = scores_of(np.triu(np.arange(100).reshape(10, 10), 1))
    links = missing_links(scores, [], [], RetrievalConfig(retries=1))
    assert len(links) == 10
    of = {tuple(pair): score for pair, score in zip(scores.pairs.tolist(), scores.scores, strict=True)}
    assert min(of[pair] for pair in links) >= np.sort(scores.scores)[-10]
