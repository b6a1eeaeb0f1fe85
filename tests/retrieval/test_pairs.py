"""Pairs by order, by position, and which of them suit a set."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sfm.retrieval import PairScores, RetrievalConfig, exhaustive_pairs
from sfm.retrieval.choice import choose_method, numbered_like_frames
from sfm.retrieval.pairs import earth_centered_m, nearby_pairs, sequential_pairs, spatial_pairs
from sfm.retrieval.sequence import loop_closures, sequence_pairs

NOWHERE = np.full((200, 3), np.nan)
FRAMES = [f"frame_{k:04}.jpg" for k in range(1, 201)]


def steady(images: int, votes: int) -> PairScores:
    """Every image has `votes` in common with the eight around it."""
    pairs = np.array([(i, j) for i in range(images) for j in range(i + 1, min(i + 9, images))])
    return PairScores(images, pairs, np.full(len(pairs), votes), 10)


def test_exhaustive_pairs_are_sorted_and_each_occurs_once():
    assert exhaustive_pairs([5, 1, 3, 1]) == [(1, 3), (1, 5), (3, 5)]
    assert exhaustive_pairs([4]) == []


def test_nearby_are_images_within_reach():
    assert nearby_pairs(4, 1) == [(0, 1), (1, 2), (2, 3)]
    assert nearby_pairs(3, 9) == exhaustive_pairs(range(3))
    assert nearby_pairs(3, 0) == []


def test_a_sequence_pairs_neighbours_and_doublings():
    pairs = sequential_pairs(100, 5)
    apart = {j - i for i, j in pairs}
    assert apart == {1, 2, 3, 4, 5, 8, 16, 32}
    assert all(sum(j - i == step for i, j in pairs) == 100 - step for step in apart)
    assert sequential_pairs(1, 5) == []


def test_a_loop_is_closed_by_votes_far_away_in_the_order():
    pairs = np.array([[0, 5], [0, 31], [0, 40], [0, 41], [0, 42], [1, 60], [2, 50]])
    scores = PairScores(100, pairs, np.array([90, 50, 40, 30, 20, 12, 9]), 10)
    config = RetrievalConfig(overlap=10, loop_partners=1)
    # For image 0 the best alone, but the other images of its pairs have no better one either.
    assert loop_closures(scores, config) == [(0, 31), (0, 40), (0, 41), (0, 42), (1, 60)]
    assert set(sequence_pairs(scores, config)) == {*sequential_pairs(100, 10), *loop_closures(scores, config)}


def test_spatial_pairs_are_the_nearest_by_distance_in_any_frame():
    rng = np.random.default_rng(0)
    places = rng.normal(size=(40, 3)) * 100
    expected = set()
    for i in range(40):
        distance = np.linalg.norm(places - places[i], axis=1)
        distance[i] = np.inf
        expected |= {tuple(sorted((i, int(j)))) for j in np.argsort(distance, kind="stable")[:4]}
    assert spatial_pairs(places, 4) == sorted(expected)
    assert spatial_pairs(places + 1e6, 4) == sorted(expected)
    near = {(i, j) for i, j in expected if np.linalg.norm(places[i] - places[j]) <= 60}
    assert 0 < len(near) < len(expected)
    assert spatial_pairs(places, 4, 60.0) == sorted(near)


def test_images_at_one_place_and_those_without_one_have_few_pairs():
    places = np.zeros((6, 3))
    assert spatial_pairs(places, 2) == [(0, 1), (0, 2), (0, 3), (0, 4), (0, 5), (1, 2), (1, 3), (1, 4), (1, 5)]
    places[2:5] = np.nan
    assert spatial_pairs(places, 9) == [(0, 1), (0, 5), (1, 5)]
    assert spatial_pairs(np.full((3, 3), np.nan), 2) == []


def test_positions_of_the_globe_are_where_they_should_be():
    found = earth_centered_m(
        np.array([0.0, 90.0, 0.0, 48.0]), np.array([0.0, 0.0, 90.0, 11.0]), np.array([0.0, 0, 10, 500])
    )
    np.testing.assert_allclose(found[:3], [[6378137, 0, 0], [0, 0, 6356752.3142], [0, 6378147, 0]], atol=1e-3)
    step = earth_centered_m(np.array([48.0 + 1 / 3600]), np.array([11.0]), np.array([500.0])) - found[3:]
    assert np.linalg.norm(step) == pytest.approx(30.89, abs=0.01)  # a second of arc on the meridian


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (FRAMES, True),
        ([f"{k}.png" for k in range(0, 400, 4)], True),
        ([name for k, name in enumerate(FRAMES) if k % 3], False),
        ([*FRAMES[:50], *(f"other_{k}.jpg" for k in range(50))], False),
        (["a.jpg", "b.jpg"], False),
        (["1.jpg"], False),
    ],
)
def test_frames_are_numbered_in_steady_steps(names, expected):
    assert numbered_like_frames(names) is expected


def test_the_method_follows_from_number_order_and_position():
    grid = np.array(list(itertools.product(range(20), range(10), [0]))) * 15.0
    one, several = [(640, 480)] * 200, [(640, 480 + k % 2) for k in range(200)]
    video, photos = steady(200, 60), steady(200, 12)
    for scores, sizes, positions, expected in (
        (video, one, NOWHERE, "sequential"),
        (video, several, NOWHERE, "vocabulary"),
        (photos, one, NOWHERE, "vocabulary"),
        (photos, one, grid, "spatial"),
        (video, one, grid, "spatial"),  # a survey from the air is numbered too, but not a single line
        (photos, one, grid / 10, "vocabulary"),  # as dense as GPS is wrong
        (photos, one, np.where(np.arange(200)[:, None] % 2, grid, np.nan), "vocabulary"),
    ):
        assert choose_method(scores, FRAMES, sizes, positions)[0] == expected
    assert choose_method(steady(50, 60), FRAMES[:50], one[:50], grid[:50])[0] == "vocabulary"
