from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.core.scene import DescriptorKind, Features
from sfm.features import Frame, TrackingConfig, track_features
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


def tracked(
    frames: list[np.ndarray | None], config: TrackingConfig = TrackingConfig(), mask: np.ndarray | None = None
) -> list[Features]:
    return list(track_features([None if grey is None else Frame(grey, mask) for grey in frames], config))


def numbers(features: Features) -> np.ndarray:
    return features.descriptors.copy().view("<u4").ravel()


def common(first: Features, second: Features) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the corners that both have."""
    return np.intersect1d(numbers(first), numbers(second), return_indices=True)[1:]


def test_corners_are_followed_to_a_tenth_of_a_pixel_without_bias():
    frames = tracked([*video(4)])
    for before, now in itertools.pairwise(frames):
        rows1, rows2 = common(before, now)
        assert len(rows1) > 0.6 * len(before)
        errors = now.points2D[rows2] - moved(before.points2D[rows1])
        assert np.median(np.linalg.norm(errors, axis=1)) < 0.1
        assert np.abs(np.median(errors, axis=0)).max() < 0.02


def test_a_corner_keeps_its_number_for_as_long_as_it_is_followed_and_lost_ones_are_replaced():
    frames = tracked([*video(6)], TrackingConfig(max_corners=150))
    seen: set[int] = set()
    for before, frame in zip([None, *frames[:-1]], frames, strict=True):
        assert 100 < len(frame) <= 150
        assert frame.kind == DescriptorKind.FOLLOWED
        now = numbers(frame)
        assert (np.diff(now.astype(np.int64)) > 0).all()
        # A number that was lost does not come again.
        assert not (set(now.tolist()) & seen) - set(numbers(before).tolist() if before else [])
        seen.update(now.tolist())
    old = np.isin(numbers(frames[5]), numbers(frames[4]))
    new, rest = frames[5].points2D[~old], frames[5].points2D[old]
    assert len(new) > 0
    assert np.linalg.norm(new[:, None] - rest[None], axis=2).min() > 8


def test_what_is_covered_is_lost_and_not_carried_along():
    frames = video(2)
    covered = frames[1].copy()
    covered[100:200, 100:250] = texture(9, (100, 150))
    before, after = tracked([frames[0], covered])
    rows, _ = common(before, after)
    now = moved(before.points2D)
    hidden = ((now > [115, 115]) & (now < [235, 185])).all(axis=1)
    assert hidden.sum() > 15
    assert hidden[rows].sum() <= 0.1 * hidden.sum()


def test_nothing_is_found_or_followed_into_a_mask():
    mask = np.ones((300, 400), np.bool_)
    mask[:, :200] = False
    for frame in tracked([*video(3)], mask=mask):
        assert len(frame) > 30
        assert frame.points2D[:, 0].min() >= 199.9
    with pytest.raises(ValueError, match="shape of the image"):
        tracked([*video(1)], mask=mask[:-1])


def test_blank_frames_and_cuts_end_tracks_and_nothing_else():
    first, second = video(2)
    frames = tracked([np.full((300, 400), 90, np.uint8), first, texture(7, (300, 400)), second[:200], second])
    assert len(frames[0]) == 0
    assert min(map(len, frames[1:])) > 60
    for before, now in itertools.pairwise(frames[1:]):
        assert len(common(before, now)[0]) < 0.2 * len(before)
    assert tracked([]) == []


def test_a_missing_frame_is_bridged():
    first, _, third = video(3)
    before, nothing, after = tracked([first, None, third])
    assert len(nothing) == 0
    rows1, rows2 = common(before, after)
    assert len(rows1) > 0.5 * len(before)
    errors = after.points2D[rows2] - moved(moved(before.points2D[rows1]))
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.1


def test_tracking_twice_gives_the_same_bits():
    first, second = (tracked([*video(3)]) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.points2D.tobytes() == b.points2D.tobytes()
        assert np.array_equal(a.descriptors, b.descriptors)


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(ConfigError, match="odd"):
        TrackingConfig(window_px=20)
    with pytest.raises(ConfigError, match="at least 1"):
        TrackingConfig(max_corners=0)
