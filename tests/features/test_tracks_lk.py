from __future__ import annotations

import cv2
import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.features.tracks_lk import TrackingConfig, track_features
from tests.features.rendering import texture

MOTION = np.array([[1.004, 0.006, 2.3], [-0.006, 1.004, -1.6]])
"""From one frame to the next, px with pixel centres at one half."""


def moved(points: np.ndarray) -> np.ndarray:
    return points @ MOTION[:, :2].T + MOTION[:, 2]


def video(count: int) -> list[np.ndarray]:
    """A picture that is shifted, turned and enlarged a little from frame to frame."""
    picture, frames = texture(1, (300, 400)), []
    whole = np.eye(3)
    for _ in range(count):
        at_zero = whole[:2].copy()
        at_zero[:, 2] += whole[:2, :2] @ [0.5, 0.5] - 0.5
        frames.append(
            cv2.warpAffine(picture, at_zero, (400, 300), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        )
        whole = np.vstack([MOTION, [0, 0, 1]]) @ whole
    return frames


def test_corners_are_followed_to_a_tenth_of_a_pixel_without_bias():
    first, *rest = list(track_features(video(4)))
    assert len(first.matches_with_previous) == 0
    for before, frame in zip([first, *rest[:-1]], rest, strict=True):
        rows = frame.matches_with_previous.indices
        assert len(rows) > 0.6 * len(before.features)
        errors = frame.features.points2D[rows[:, 1]] - moved(before.features.points2D[rows[:, 0]])
        assert np.median(np.linalg.norm(errors, axis=1)) < 0.1
        assert np.abs(np.median(errors, axis=0)).max() < 0.02


def test_a_corner_keeps_its_row_for_as_long_as_it_is_followed_and_lost_ones_are_replaced():
    config = TrackingConfig(max_features=150)
    frames = list(track_features(video(6), config))
    for frame in frames:
        assert 100 < len(frame.features) <= 150
        rows = frame.matches_with_previous.indices
        assert np.array_equal(rows[:, 1], np.arange(len(rows)))
        assert (np.diff(rows[:, 0]) > 0).all()
    new = frames[5].features.points2D[len(frames[5].matches_with_previous) :]
    old = frames[5].features.points2D[: len(frames[5].matches_with_previous)]
    assert np.linalg.norm(new[:, None] - old[None], axis=2).min() > 8


def test_what_is_covered_is_lost_and_not_carried_along():
    frames = video(2)
    covered = frames[1].copy()
    covered[100:200, 100:250] = texture(9, (100, 150))
    before, after = track_features([frames[0], covered])
    rows = after.matches_with_previous.indices
    now = moved(before.features.points2D)
    hidden = ((now > [115, 115]) & (now < [235, 185])).all(axis=1)
    assert hidden.sum() > 15
    assert hidden[rows[:, 0]].sum() <= 0.1 * hidden.sum()


def test_nothing_is_found_or_followed_into_a_mask():
    mask = np.ones((300, 400), np.bool_)
    mask[:, :200] = False
    for frame in track_features(video(3), mask=mask):
        assert len(frame.features) > 30
        assert frame.features.points2D[:, 0].min() >= 199.9


def test_colour_blank_frames_and_a_cut_are_no_trouble():
    frames = video(2)
    clip = [np.full((300, 400, 3), 90, np.uint8), np.repeat(frames[0][..., None], 3, 2), texture(7, (300, 400))]
    blank, first, other = track_features(clip)
    assert len(blank.features) == 0
    assert len(first.features) > 100
    assert len(other.matches_with_previous) < 0.2 * len(first.features)
    assert list(track_features([])) == []


def test_frames_of_another_size_are_refused():
    with pytest.raises(ValueError, match="frame has shape"):
        list(track_features([np.zeros((60, 80), np.uint8), np.zeros((80, 60), np.uint8)]))
    with pytest.raises(ConfigError, match="odd"):
        TrackingConfig(window_px=20)


def test_tracking_twice_gives_the_same_bits():
    first, second = (list(track_features(video(3))) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.features.points2D.tobytes() == b.features.points2D.tobytes()
        assert np.array_equal(a.matches_with_previous.indices, b.matches_with_previous.indices)
