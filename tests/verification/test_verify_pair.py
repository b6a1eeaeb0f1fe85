from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import ConfigError, Rejected
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.robust import RansacConfig
from sfm.core.scene import Matches, PairKind, TwoViewGeometry
from sfm.verification import VerificationConfig, verify_pair

PINHOLE = Camera("PINHOLE", 1600, 1200, np.array([1300.0, 1290, 800, 600]), True)
RADIAL = Camera("RADIAL", 1600, 1200, np.array([1300.0, 800, 600, -0.15, 0.02]), True)
FISHEYE = Camera("OPENCV_FISHEYE", 1600, 1200, np.array([500.0, 505, 800, 600, 0.02, -0.004, 0, 0]), True)
GUESSED = Camera("SIMPLE_RADIAL", 1600, 1200, np.array([1300.0, 800, 600, 0]))
SIZE = np.array([1600, 1200])
POSE = Rigid3(Rotation3.exp(np.array([0.05, -0.2, 0.1])), np.array([0.98, 0.1, 0.17]))


def _matches(first, second):
    return Matches(np.stack([first, second], axis=1).astype(np.int32))


def _pair(camera, *, pose=POSE, plane=False, count=300, outliers=0.4, noise=0.5, seed=0, camera2=None):
    """Keypoints of both images, shuffled, and the matches between them; the first matches are wrong."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [2.5, 2, 1.5] + [0, 0, 5]
    if plane:
        points[:, 2] = 5 + 0.3 * points[:, 0] - 0.2 * points[:, 1]
    p1 = camera.project(points)[0] + rng.normal(size=(count, 2)) * noise
    p2 = (camera2 or camera).project(pose @ points)[0] + rng.normal(size=(count, 2)) * noise
    wrong = int(outliers * count)
    p2[:wrong] = rng.uniform(0, 1, (wrong, 2)) * SIZE
    order1, order2 = rng.permutation(count), rng.permutation(count)
    matches = _matches(np.argsort(order1), np.argsort(order2))
    return p1[order1], p2[order2], matches, wrong


def _verify(camera, config=VerificationConfig(), *, camera2=None, seed=1, **scene):
    p1, p2, matches, wrong = _pair(camera, camera2=camera2, **scene)
    found = verify_pair(p1, p2, matches, camera, camera2 or camera, config, rng=np.random.default_rng(seed))
    return found, matches, wrong


def _errors_deg(found, pose=POSE):
    angle = np.degrees(float((found.cam2_from_cam1.rotation @ pose.rotation.inverse()).angle))
    cosine = found.cam2_from_cam1.translation @ pose.translation / np.linalg.norm(pose.translation)
    return angle, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@pytest.mark.parametrize("camera", [PINHOLE, RADIAL, FISHEYE], ids=lambda c: c.model)
def test_a_solid_scene_seen_by_calibrated_cameras_is_calibrated(camera):
    found, matches, wrong = _verify(camera)
    assert found.kind == PairKind.CALIBRATED
    angle, direction = _errors_deg(found)
    assert angle < 0.5
    assert direction < 2.0
    assert np.linalg.norm(found.cam2_from_cam1.translation) == pytest.approx(1)
    right = {tuple(row) for row in matches.indices[wrong:].tolist()}
    kept = {tuple(row) for row in found.matches.tolist()}
    assert len(kept & right) > 0.97 * len(right)
    assert len(kept - right) < 0.1 * wrong
    assert found.E is not None


def test_keypoints_without_a_match_change_nothing():
    p1, p2, matches, _ = _pair(PINHOLE)
    more = np.concatenate([p2, np.random.default_rng(2).uniform(0, 1, (70, 2)) * SIZE])
    first, second = (
        verify_pair(p1, points, matches, PINHOLE, PINHOLE, rng=np.random.default_rng(1)) for points in (p2, more)
    )
    assert first.matches.tolist() == second.matches.tolist()
    assert (first.cam2_from_cam1.matrix == second.cam2_from_cam1.matrix).all()


def test_the_triangulation_angle_is_that_of_the_scene():
    found, _, _ = _verify(PINHOLE, outliers=0.0, noise=0.0)
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (300, 3)) * [2.5, 2, 1.5] + [0, 0, 5]
    to1, to2 = -points, POSE.center - points
    cosines = (to1 * to2).sum(1) / np.linalg.norm(to1, axis=1) / np.linalg.norm(to2, axis=1)
    assert found.tri_angle == pytest.approx(float(np.median(np.arccos(cosines))), rel=1e-3)


def test_without_known_focal_lengths_the_pair_is_uncalibrated_with_a_pose_of_the_guess():
    found, _, wrong = _verify(GUESSED)
    assert found.kind == PairKind.UNCALIBRATED
    assert found.E is None
    assert found.F is not None
    assert _errors_deg(found)[0] < 1.0
    assert len(found) > 0.95 * (300 - wrong)
    trusted, _, _ = _verify(GUESSED, VerificationConfig(trust_focal=True))
    assert trusted.kind == PairKind.CALIBRATED


def test_a_wrong_calibration_is_noticed():
    p1, p2, matches, wrong = _pair(PINHOLE, outliers=0.2)
    believed = dataclasses.replace(PINHOLE, params=np.array([4000.0, 4000, 800, 600]))
    found = verify_pair(p1, p2, matches, believed, believed, rng=np.random.default_rng(0))
    assert found.kind == PairKind.UNCALIBRATED
    assert len(found) > 0.95 * (300 - wrong)


@pytest.mark.parametrize("camera", [PINHOLE, RADIAL, GUESSED], ids=lambda c: c.model)
def test_a_plane_is_planar_and_keeps_its_pose(camera):
    found, _, wrong = _verify(camera, plane=True, outliers=0.3)
    assert found.kind == PairKind.PLANAR
    assert found.H is not None
    assert len(found) > 0.95 * (300 - wrong)
    angle, direction = _errors_deg(found)
    assert angle < 2.0
    assert direction < 8.0
    assert found.tri_angle > 0.1


@pytest.mark.parametrize("camera", [PINHOLE, RADIAL, FISHEYE, GUESSED], ids=lambda c: c.model)
def test_a_rotation_is_panoramic(camera):
    rotation = Rigid3(POSE.rotation, np.zeros(3))
    found, _, _ = _verify(camera, pose=rotation, outliers=0.3)
    assert found.kind == PairKind.PANORAMIC
    assert np.degrees(float((found.cam2_from_cam1.rotation @ POSE.rotation.inverse()).angle)) < 0.1
    assert not found.cam2_from_cam1.translation.any()
    assert found.tri_angle == 0


def test_a_watermark_is_a_watermark_and_has_no_pose():
    rng = np.random.default_rng(0)
    corner = rng.uniform(0, 1, (60, 2)) * [150, 60] + [20, 20]
    matches = _matches(np.arange(60), np.arange(60))
    moved = corner + [3.0, -2.0] + 0.2 * rng.normal(size=corner.shape)
    found = verify_pair(corner, moved, matches, PINHOLE, PINHOLE, rng=np.random.default_rng(0))
    assert found.kind == PairKind.WATERMARK
    assert found.cam2_from_cam1 is None
    assert len(found) > 50
    off = VerificationConfig(detect_watermark=False)
    kept = verify_pair(corner, moved, matches, PINHOLE, PINHOLE, off, rng=np.random.default_rng(0))
    assert kept.kind != PairKind.WATERMARK


def test_scene_points_near_the_border_are_no_watermark():
    p1, p2, matches, _ = _pair(PINHOLE, outliers=0)
    assert verify_pair(p1, p2, matches, PINHOLE, PINHOLE, rng=np.random.default_rng(0)).kind == PairKind.CALIBRATED
    image = np.random.default_rng(1).uniform(0, 1, (100, 2)) * SIZE
    same = _matches(np.arange(100), np.arange(100))
    found = verify_pair(image, image, same, PINHOLE, PINHOLE, rng=np.random.default_rng(0))
    assert found.kind == PairKind.PANORAMIC


def test_a_half_turned_and_a_small_image_are_verified():
    upside_down = Rigid3(Rotation3.exp(np.array([0, 0, np.pi])) @ POSE.rotation, POSE.translation)
    found, _, _ = _verify(PINHOLE, pose=upside_down)
    assert found.kind == PairKind.CALIBRATED
    assert _errors_deg(found, upside_down)[0] < 0.5
    small = Camera("PINHOLE", 400, 300, PINHOLE.params / 4, True)
    found, _, _ = _verify(PINHOLE, camera2=small, outliers=0.0, noise=0.2)
    assert found.kind == PairKind.CALIBRATED
    assert _errors_deg(found)[0] < 1.0


def test_a_fisheye_and_a_perspective_camera_pair_is_calibrated():
    found, _, _ = _verify(FISHEYE, camera2=PINHOLE, outliers=0.3)
    assert found.kind == PairKind.CALIBRATED
    assert _errors_deg(found)[0] < 0.5


def test_unrelated_images_are_rejected_with_a_reason():
    rng = np.random.default_rng(3)
    p1, p2 = rng.uniform(0, 1, (2, 100, 2)) * SIZE
    matches = _matches(np.arange(100), np.arange(100))
    strict = VerificationConfig(ransac=RansacConfig(max_error_px=2.0, min_inlier_ratio=0.25, max_iterations=500))
    found = verify_pair(p1, p2, matches, PINHOLE, PINHOLE, strict, rng=rng)
    assert isinstance(found, Rejected)
    few = verify_pair(p1, p2, Matches(matches.indices[:14]), PINHOLE, PINHOLE, rng=rng)
    assert few == Rejected("too_few_matches", "14 of 15 needed")


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE, GUESSED], ids=lambda c: c.model)
@pytest.mark.parametrize("case", ["one point", "a line", "not a number"])
def test_degenerate_keypoints_are_rejected_or_give_finite_results(camera, case):
    points = {
        "one point": np.full((50, 2), 700.0),
        "a line": np.arange(50.0)[:, None] * [12.0, 9],
        "not a number": np.full((50, 2), np.nan),
    }[case]
    matches = _matches(np.arange(50), np.arange(50))
    found = verify_pair(points, points[::-1].copy(), matches, camera, camera, rng=np.random.default_rng(0))
    if isinstance(found, TwoViewGeometry) and found.cam2_from_cam1 is not None:
        assert np.isfinite(found.cam2_from_cam1.matrix).all()
    assert case != "not a number" or isinstance(found, Rejected)


def test_the_kind_does_not_depend_on_the_scale_of_the_pixels():
    big = Camera("PINHOLE", 3200, 2400, PINHOLE.params * 2, True)
    p1, p2, matches, _ = _pair(PINHOLE)
    double = VerificationConfig(ransac=RansacConfig(max_error_px=8.0))
    one = verify_pair(p1, p2, matches, PINHOLE, PINHOLE, rng=np.random.default_rng(5))
    two = verify_pair(2 * p1, 2 * p2, matches, big, big, double, rng=np.random.default_rng(5))
    assert one.kind == two.kind
    assert abs(len(one) - len(two)) <= 3


def test_a_homography_of_undistorted_pixels_maps_them():
    found, matches, _ = _verify(RADIAL, plane=True, outliers=0.0, noise=0.0)
    p1, p2, _, _ = _pair(RADIAL, plane=True, outliers=0.0, noise=0.0)
    k = RADIAL.calibration_matrix
    rays1, rays2 = RADIAL.unproject(p1)[0], RADIAL.unproject(p2)[0]
    ideal1, ideal2 = (transform_points(k, rays[:, :2] / rays[:, 2:]) for rays in (rays1, rays2))
    i, j = matches.indices.T
    assert np.abs(transform_points(found.H, ideal1[i]) - ideal2[j]).max() < 1e-4


@pytest.mark.parametrize("name", ["min_calibrated_ratio", "max_homography_ratio", "min_watermark_ratio"])
def test_ratios_beyond_zero_and_one_are_refused(name):
    for value in (0.0, 1.5):
        with pytest.raises(ConfigError, match=name):
            VerificationConfig(**{name: value})
