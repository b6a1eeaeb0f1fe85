"""Made-up keypoints of a wall of tiles: matches of tiles are off by whole tiles, those of other things are right."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Matches, PairKind, TwoViewGeometry
from sfm.verification import VerificationConfig, verify_pair

CAMERA = Camera("PINHOLE", 1600, 1200, np.array([1300.0, 1290, 800, 600]), True)
POSE = Rigid3(Rotation3.exp(np.array([0.02, -0.1, 0.03])), np.array([-0.9, 0.1, 0.1]))
LEVEL = Rigid3(Rotation3.exp(np.zeros(3)), np.array([-1.0, 0, 0]))
TILE = 0.5


class Pair:
    """Two photos of a wall at depth 5 in front of which some things hang at other depths.

    Args:
        tiles: matches of the wall; each is off by up to `off` tiles in x and in y.
        others: right matches of distinct things; `flat` for such that lie in the wall.
        wrong: distinct things that are matched anywhere.
    """

    def __init__(self, *, tiles=200, off=(2, 1), others=0, flat=False, wrong=0, pose=POSE, seed=0):
        rng = np.random.default_rng(seed)
        count = tiles + others + wrong
        points = rng.uniform(-1, 1, (count, 3)) * [2.2, 1.6, 1] + [0.3, 0, 5]
        points[:tiles, 2] = 5
        points[tiles:, 2] = 5 if flat else points[tiles:, 2] - 1
        shift = np.zeros((count, 3))
        shift[:tiles, :2] = TILE * rng.integers(-np.array(off), np.array(off) + 1, (tiles, 2))
        self.points1 = CAMERA.project(points)[0] + 0.3 * rng.normal(size=(count, 2))
        self.points2 = CAMERA.project(pose @ (points + shift))[0] + 0.3 * rng.normal(size=(count, 2))
        self.points2[tiles + others :] = rng.uniform(0, 1, (wrong, 2)) * [1600, 1200]
        self.distinct = np.arange(count) >= tiles
        self.matches = Matches(np.stack([np.arange(count)] * 2, axis=1).astype(np.int32))
        self.right = ~shift.any(axis=1) & (np.arange(count) < tiles + others)

    def verified(self, config=VerificationConfig(), *, told="both", seed=1) -> TwoViewGeometry | Rejected:
        distinct1, distinct2 = (self.distinct if told in (side, "both") else None for side in ("first", "second"))
        rng = np.random.default_rng(seed)
        both = self.points1, self.points2, self.matches, CAMERA, CAMERA, config
        return verify_pair(*both, distinct1=distinct1, distinct2=distinct2, rng=rng)


def errors_deg(found: TwoViewGeometry, pose: Rigid3 = POSE) -> tuple[float, float]:
    assert found.cam2_from_cam1 is not None
    angle = np.degrees(float((found.cam2_from_cam1.rotation @ pose.rotation.inverse()).angle))
    cosine = found.cam2_from_cam1.translation @ pose.translation / np.linalg.norm(pose.translation)
    return angle, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_tiles_along_a_row_have_a_geometry_but_prove_none():
    """Shifts along the epipolar lines: nothing but their look-alikes tells that the depths are wrong."""
    pair = Pair(off=(3, 0), pose=LEVEL)
    found = pair.verified(told="none")
    assert not isinstance(found, Rejected)
    assert not pair.right[found.matches[:, 0]].all()
    assert pair.verified() == Rejected("repeated_texture", "0 of 0 distinct matches agree")


@pytest.mark.parametrize("told", ["first", "second", "both"])
def test_it_is_enough_that_one_of_the_images_repeats_itself(told):
    found = Pair(off=(3, 0), pose=LEVEL).verified(told=told)
    assert isinstance(found, Rejected)
    assert found.reason == "repeated_texture"


def test_other_things_decide_and_tiles_that_are_off_are_left_out():
    pair = Pair(off=(3, 0), others=40, pose=LEVEL)
    whole, found = pair.verified(told="none"), pair.verified()
    assert not isinstance(whole, Rejected)
    assert pair.right[whole.matches[:, 0]].mean() < 0.6
    assert not isinstance(found, Rejected)
    assert found.kind == PairKind.CALIBRATED
    assert pair.right[found.matches[:, 0]].all()
    assert len(found) >= 38
    assert max(errors_deg(found, LEVEL)) < 1


def test_other_things_are_found_among_many_tiles_that_would_hide_them():
    pair = Pair(tiles=600, off=(4, 3), others=60)
    whole, found = pair.verified(told="none"), pair.verified()
    assert isinstance(whole, Rejected) or len(whole) < 150
    assert not isinstance(found, Rejected)
    assert max(errors_deg(found)) < 1


def test_a_homography_brings_in_the_tiles_that_it_puts_where_they_are():
    pair = Pair(tiles=300, off=(1, 1), others=60, flat=True)
    found = pair.verified()
    assert not isinstance(found, Rejected)
    assert found.kind == PairKind.PLANAR
    kept = np.zeros(len(pair.matches), bool)
    kept[found.matches[:, 0]] = True
    assert kept[pair.right].mean() > 0.97
    assert not kept[~pair.right].any()


@pytest.mark.parametrize(("wrong", "verified"), [(0, True), (20, True), (36, False)])
def test_distinct_matches_that_agree_must_outnumber_the_others(wrong, verified):
    """40 against 36 lead by 4 only, and some of those agree by chance."""
    found = Pair(tiles=30, off=(2, 0), others=40, wrong=wrong).verified()
    assert isinstance(found, TwoViewGeometry) == verified
    assert verified or (isinstance(found, Rejected) and found.reason == "repeated_texture")


def test_the_lead_that_is_needed_is_a_setting():
    pair = Pair(tiles=30, off=(2, 0), others=24)
    assert isinstance(pair.verified(), TwoViewGeometry)
    assert isinstance(pair.verified(VerificationConfig(min_distinct_lead=25)), Rejected)


@pytest.mark.parametrize(("off_too", "verified"), [(0, True), (20, True), (80, False)])
def test_one_homography_for_nearly_all_look_alikes_is_proof(off_too, verified):
    """The wall is not so regular: its tiles were told apart. With 80 of 280 that are off it is not certain."""
    pair = Pair(tiles=200, off=(0, 0))
    scattered = Pair(tiles=off_too, off=(3, 3), seed=2)
    pair.points1 = np.concatenate([pair.points1, scattered.points1])
    pair.points2 = np.concatenate([pair.points2, scattered.points2])
    pair.distinct = np.zeros(200 + off_too, bool)
    pair.matches = Matches(np.stack([np.arange(200 + off_too)] * 2, axis=1).astype(np.int32))
    found = pair.verified()
    assert isinstance(found, TwoViewGeometry) == verified
    if isinstance(found, TwoViewGeometry):
        assert found.kind == PairKind.PLANAR
        assert len(found) >= 195


def test_where_nothing_repeats_the_masks_change_nothing():
    pair = Pair(tiles=0, others=200, wrong=80)
    plain, told = pair.verified(told="none"), pair.verified()
    assert isinstance(plain, TwoViewGeometry)
    assert isinstance(told, TwoViewGeometry)
    assert told.kind == plain.kind
    assert told.matches.tolist() == plain.matches.tolist()


def test_too_few_matches_are_too_few_whether_they_repeat_or_not():
    assert Pair(tiles=14).verified() == Rejected("too_few_matches", "14 of 15 needed")
