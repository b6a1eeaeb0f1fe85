from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.core.scene import DescriptorKind, Features
from sfm.matching import distinct_features

WIDTH, HEIGHT = 640, 480
NEAR, REACH, ALIKE, NEIGHBORS = 3.0, 6.0, 128.0, 8


def features(*, kinds: int, of_each: int, alone: int, noise: float = 4.0, seed: int = 0) -> Features:
    """Things of some kinds, several of each, and things that are there once, most of them on the right."""
    rng = np.random.default_rng(seed)
    count = kinds * of_each + alone
    raw = rng.gamma(0.6, size=(kinds + alone, 128))
    clean = 512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))
    rows = np.concatenate([np.repeat(clean[:kinds], of_each, axis=0), clean[kinds:]])
    rows = np.clip(np.rint(rows + noise * rng.normal(size=rows.shape)), 0, 255).astype(np.uint8)
    points = rng.uniform(0, 1, (count, 2)) * [WIDTH, HEIGHT]
    points[:, 0] = np.where(np.arange(count) < kinds * of_each, 1, 0.5) * points[:, 0]
    points[:, 0] = WIDTH - points[:, 0]
    order = rng.permutation(count)
    points = points[order]
    scales = rng.uniform(1, 4, count).astype(np.float32)
    return Features(points, scales, np.zeros(count, np.float32), rows[order])


def slow_distinct(found: Features) -> np.ndarray:
    """One pair of features after the other."""
    distinct = np.ones(len(found), bool)
    for i in range(len(found)):
        x, y = found.points2D[i]
        distinct[i] = min(x, y, WIDTH - x, HEIGHT - y) > REACH * found.scales[i]
        for j in range(len(found)):
            apart = np.linalg.norm(found.points2D[i] - found.points2D[j]) > NEAR * found.scales[i]
            difference = found.descriptors[i].astype(float) - found.descriptors[j]
            if i != j and apart and np.sqrt((difference**2).sum()) <= ALIKE:
                distinct[i] = False
    lone = np.zeros(len(found), bool)
    for i in range(len(found)):
        nearest = np.argsort(np.linalg.norm(found.points2D - found.points2D[i], axis=1))[:NEIGHBORS]
        lone[i] = distinct[nearest].mean() < 0.5
    return distinct & ~lone


@pytest.mark.parametrize("noise", [0.0, 4.0, 8.0])
def test_features_are_distinct_as_one_comparison_after_the_other_finds(noise):
    found = features(kinds=20, of_each=8, alone=140, noise=noise)
    distinct = distinct_features(found, WIDTH, HEIGHT)
    assert distinct is not None
    assert np.array_equal(distinct, slow_distinct(found))
    assert 60 < distinct.sum() < 140


@pytest.mark.parametrize(("of_each", "repeats"), [(1, False), (2, False), (8, True)])
def test_an_image_with_few_look_alikes_does_not_repeat_itself(of_each, repeats):
    """20 things twice among 140 are 22 %; in 8 copies each they are 53 %."""
    found = features(kinds=20, of_each=of_each, alone=140)
    assert (distinct_features(found, WIDTH, HEIGHT) is not None) == repeats


def test_more_features_than_are_sampled_and_compared_at_once_are_judged_alike():
    found = features(kinds=40, of_each=10, alone=300)
    distinct = distinct_features(found, WIDTH, HEIGHT)
    assert distinct is not None
    assert np.array_equal(distinct, slow_distinct(found))


def test_one_keypoint_of_several_orientations_has_no_look_alikes():
    found = features(kinds=40, of_each=4, alone=0, noise=2.0)
    place = np.random.default_rng(1).uniform(100, 380, (40, 2))
    _, kind = np.unique(np.argmin(_distances(found), axis=1), return_inverse=True)
    together = dataclasses.replace(found, points2D=place[kind % 40])
    assert distinct_features(found, WIDTH, HEIGHT) is not None
    assert distinct_features(together, WIDTH, HEIGHT) is None


def _distances(found: Features) -> np.ndarray:
    """From each to the first feature of each kind: which kind it is."""
    rows = found.descriptors.astype(float)
    return (np.linalg.norm(rows[:, None] - rows[None], axis=2) > ALIKE).astype(int)


def test_features_that_the_border_cuts_off_are_not_distinct():
    found = features(kinds=20, of_each=8, alone=140)
    points = found.points2D * [(WIDTH - 100) / WIDTH, (HEIGHT - 100) / HEIGHT] + 50  # all of them inside
    inside = distinct_features(dataclasses.replace(found, points2D=points), WIDTH, HEIGHT)
    cut = distinct_features(dataclasses.replace(found, points2D=points), WIDTH, HEIGHT - 60)
    assert inside is not None
    assert cut is not None
    within = HEIGHT - 60 - points[:, 1] > REACH * found.scales
    assert (cut <= (inside & within)).all()
    assert 0.8 * (inside & within).sum() < cut.sum() < inside.sum()


def test_things_that_are_there_once_are_distinct_among_themselves_and_not_alone_among_look_alikes():
    found = features(kinds=20, of_each=20, alone=40, noise=0.0)
    rows = found.descriptors.astype(float)
    alone = (np.linalg.norm(rows[:, None] - rows[None], axis=2) == 0).sum(axis=1) == 1
    rng = np.random.default_rng(2)
    left, right = rng.uniform([60, 60], [250, 420], (440, 2)), rng.uniform([350, 60], [580, 420], (440, 2))
    for points, share in ((np.where(alone[:, None], left, right), 1.0), (left, 0.0)):
        distinct = distinct_features(dataclasses.replace(found, points2D=points), WIDTH, HEIGHT)
        assert distinct is not None
        assert not distinct[~alone].any()
        assert distinct[alone].mean() == pytest.approx(share, abs=0.1)


@pytest.mark.parametrize("kind", [DescriptorKind.BINARY, DescriptorKind.LEARNED])
def test_descriptors_of_other_kinds_are_not_judged(kind):
    assert distinct_features(dataclasses.replace(features(kinds=5, of_each=20, alone=0), kind=kind), 640, 480) is None


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_features_are_judged_all_the_same(count):
    found = features(kinds=1, of_each=count, alone=0, noise=0.0)
    distinct = distinct_features(found, WIDTH, HEIGHT)
    assert (distinct is None) == (count < 2)
    assert distinct is None or not distinct.any()
