from __future__ import annotations

import dataclasses
import os
import subprocess
import sys

import jaxtyping
import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3
from sfm.core.robust import (
    RansacConfig,
    align_robust,
    estimate_absolute_pose,
    estimate_fundamental,
    estimate_homography,
    estimate_relative_pose,
    refine_absolute_pose,
    refine_relative_pose,
)

REFUSED = (ValueError, jaxtyping.TypeCheckError)
PINHOLE = Camera("PINHOLE", 1600, 1200, np.array([1300.0, 1290, 800, 600]))
RADIAL = Camera("SIMPLE_RADIAL", 1600, 1200, np.array([1300.0, 800, 600, -0.12]))
FISHEYE = Camera("OPENCV_FISHEYE", 1600, 1200, np.array([500.0, 505, 800, 600, 0.02, -0.004, 0, 0]))
SPHERE = Camera("EQUIRECTANGULAR", 2000, 1000, np.array([2000.0, 1000.0]))
CAMERAS = [PINHOLE, RADIAL, FISHEYE]
SIZE = np.array([1600, 1200])


def _rng(seed=0):
    return np.random.default_rng(seed)


def _two_views(camera, *, count=300, outliers=0.5, noise=0.5, seed=0, plane=False):
    rng = _rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [2.5, 2, 1.5] + [0, 0, 5]
    if plane:
        points[:, 2] = 5 + 0.3 * points[:, 0] - 0.2 * points[:, 1]
    pose = Rigid3(Rotation3.exp(np.array([0.05, -0.2, 0.1])), np.array([1.0, 0.1, 0.2]))
    p1, p2 = camera.project(points)[0], camera.project(pose @ points)[0]
    p1, p2 = (p + rng.normal(size=p.shape) * noise for p in (p1, p2))
    wrong = int(outliers * count)
    p2[:wrong] = rng.uniform(0, 1, (wrong, 2)) * SIZE
    return p1, p2, pose, wrong


def _views_of_points(camera, *, count=200, outliers=0.5, noise=0.5, seed=0):
    rng = _rng(seed)
    pose = Rigid3(Rotation3.exp(rng.normal(size=3)), rng.normal(size=3) * 3)
    points = pose.inverse() @ (rng.uniform(-1, 1, (count, 3)) * [2.5, 2, 1.5] + [0, 0, 5])
    pixels = camera.project(pose @ points)[0] + rng.normal(size=(count, 2)) * noise
    wrong = int(outliers * count)
    pixels[:wrong] = rng.uniform(0, 1, (wrong, 2)) * SIZE
    return pixels, points, pose, wrong


def _angle_deg(a, b):
    return float(np.degrees((a.rotation @ b.rotation.inverse()).angle))


def _direction_deg(a, b):
    cosine = a.translation @ b.translation / np.linalg.norm(a.translation) / np.linalg.norm(b.translation)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
@pytest.mark.parametrize("seed", range(3))
def test_relative_pose_is_recovered_among_half_outliers_for_every_kind_of_camera(camera, seed):
    p1, p2, pose, wrong = _two_views(camera, seed=seed)
    found = estimate_relative_pose(p1, p2, camera, camera, rng=_rng())
    assert _angle_deg(found.cam2_from_cam1, pose) < 0.5
    assert _direction_deg(found.cam2_from_cam1, pose) < 1.5
    assert found.inliers[wrong:].mean() > 0.98
    assert found.inliers[:wrong].mean() < 0.1
    assert found.in_front[wrong:].mean() > 0.95
    assert np.linalg.norm(found.cam2_from_cam1.translation) == pytest.approx(1)


def test_the_marginalised_score_asks_no_knowledge_of_the_noise():
    errors = {"truncated": [], "marginalized": []}
    for seed in range(10):
        p1, p2, pose, _ = _two_views(PINHOLE, seed=seed, noise=0.3)
        for score, found in errors.items():
            config = RansacConfig(max_error_px=20.0, score=score)
            estimate = estimate_relative_pose(p1, p2, PINHOLE, PINHOLE, config, rng=_rng())
            found.append(_direction_deg(estimate.cam2_from_cam1, pose))
    assert max(errors["marginalized"]) < 1.5
    assert np.median(errors["marginalized"]) <= 1.05 * np.median(errors["truncated"])


@pytest.mark.parametrize("estimator", ["relative", "fundamental", "homography"])
def test_matches_in_any_order_of_quality_give_the_mask_of_their_own_rows(estimator):
    p1, p2, _, wrong = _two_views(PINHOLE, outliers=0.4, plane=estimator == "homography")
    quality = _rng(2).uniform(size=len(p1))
    run = {
        "relative": lambda: estimate_relative_pose(p1, p2, PINHOLE, PINHOLE, rng=_rng(), quality=quality),
        "fundamental": lambda: estimate_fundamental(p1, p2, rng=_rng(), quality=quality),
        "homography": lambda: estimate_homography(p1, p2, rng=_rng(), quality=quality),
    }
    inliers = run[estimator]().inliers
    assert inliers[wrong:].mean() > 0.95
    assert inliers[:wrong].mean() < 0.12


def test_relative_pose_between_different_cameras_and_on_the_sphere():
    rng = _rng(5)
    points = rng.normal(size=(200, 3)) * 4
    points = points[np.linalg.norm(points, axis=1) > 2]
    pose = Rigid3(Rotation3.exp(np.array([0.3, 0.2, -0.5])), np.array([0.5, 0.3, 0.1]))
    p1, p2 = SPHERE.project(points)[0], SPHERE.project(pose @ points)[0]
    found = estimate_relative_pose(p1, p2, SPHERE, SPHERE, RansacConfig(max_error_px=1.0), rng=_rng())
    assert _angle_deg(found.cam2_from_cam1, pose) < 1e-3
    assert _direction_deg(found.cam2_from_cam1, pose) < 1e-2
    ahead = rng.uniform(-1, 1, (200, 3)) + [0, 0, 4]
    p1, p2 = PINHOLE.project(ahead)[0], FISHEYE.project(pose @ ahead)[0]
    found = estimate_relative_pose(p1, p2, PINHOLE, FISHEYE, rng=_rng())
    assert _angle_deg(found.cam2_from_cam1, pose) < 1e-3


def test_exact_data_give_the_exact_pose():
    p1, p2, pose, _ = _two_views(PINHOLE, outliers=0, noise=0)
    found = estimate_relative_pose(p1, p2, PINHOLE, PINHOLE, rng=_rng())
    assert _angle_deg(found.cam2_from_cam1, pose) < 1e-6
    assert _direction_deg(found.cam2_from_cam1, pose) < 1e-4
    assert found.inliers.all()


def test_a_planar_scene_has_a_relative_pose():
    p1, p2, pose, _ = _two_views(PINHOLE, outliers=0.3, plane=True)
    found = estimate_relative_pose(p1, p2, PINHOLE, PINHOLE, rng=_rng())
    assert found.inliers.mean() > 0.68
    refined = refine_relative_pose(p1, p2, PINHOLE, PINHOLE, pose)
    assert _angle_deg(refined, pose) < 1.0


def test_a_pure_rotation_gives_the_rotation_and_some_translation():
    p1, _, _, _ = _two_views(PINHOLE, outliers=0)
    rotation = Rotation3.exp(np.array([0.02, 0.1, -0.05]))
    p2 = PINHOLE.project(rotation @ PINHOLE.unproject(p1)[0])[0] + _rng(1).normal(size=p1.shape) * 0.3
    found = estimate_relative_pose(p1, p2, PINHOLE, PINHOLE, rng=_rng())
    assert _angle_deg(found.cam2_from_cam1, Rigid3(rotation, np.zeros(3))) < 0.5
    assert np.isfinite(found.cam2_from_cam1.translation).all()


def test_refinement_brings_a_disturbed_pose_back():
    p1, p2, pose, _ = _two_views(PINHOLE, outliers=0.2)
    disturbed = Rigid3.exp(np.array([0.003, -0.004, 0.003, 0.02, 0.02, -0.02])) @ pose
    refined = refine_relative_pose(p1, p2, PINHOLE, PINHOLE, disturbed)
    assert _direction_deg(refined, pose) < 0.5 * _direction_deg(disturbed, pose)
    with pytest.raises(ValueError, match="translation"):
        refine_relative_pose(p1, p2, PINHOLE, PINHOLE, Rigid3.identity())


@pytest.mark.parametrize("seed", range(3))
def test_fundamental_matrix_is_recovered_among_half_outliers(seed):
    p1, p2, _, wrong = _two_views(PINHOLE, seed=seed)
    found = estimate_fundamental(p1, p2, rng=_rng())
    assert found.inliers[wrong:].mean() > 0.97
    assert found.inliers[:wrong].mean() < 0.1
    singular = np.linalg.svd(found.matrix)[1]
    assert singular[2] < 1e-12 * singular[0]


def test_fundamental_matrix_of_a_scene_with_a_dominant_plane_explains_what_lies_off_it():
    explained = []
    for seed in range(10):
        p1, p2, pose, wrong = _two_views(PINHOLE, count=400, outliers=0.3, seed=seed, plane=True)
        rng = _rng(seed)
        points = rng.uniform(-1, 1, (30, 3)) * [2.5, 2, 1.5] + [0, 0, 5]
        off1, off2 = PINHOLE.project(points)[0], PINHOLE.project(pose @ points)[0]
        off1, off2 = (p + rng.normal(size=p.shape) * 0.5 for p in (off1, off2))
        found = estimate_fundamental(np.concatenate([p1, off1]), np.concatenate([p2, off2]), rng=_rng(seed))
        assert found.inliers[wrong:400].mean() > 0.97
        explained.append(found.inliers[400:].mean())
    assert np.mean(explained) > 0.95
    assert min(explained) > 0.85


def test_homography_of_points_noisier_than_the_bound_is_as_good_as_with_a_bound_that_fits():
    h = np.array([[1.1, 0.05, 30], [-0.02, 0.95, -20], [1e-5, -2e-5, 1]])
    corners, errors = np.array([[0.0, 0], [1600, 0], [0, 1200], [1600, 1200]]), {}
    for seed in range(15):
        rng = _rng(seed)
        p1 = rng.uniform(0, 1, (150, 2)) * SIZE
        p2 = transform_points(h, p1) + rng.normal(size=p1.shape) * 2.0
        p2[:75] = rng.uniform(0, 1, (75, 2)) * SIZE
        for case in ((1.0, "marginalized"), (1.0, "truncated"), (6.0, "truncated")):
            config = RansacConfig(max_error_px=case[0], score=case[1], min_inliers=8)
            found = estimate_homography(p1, p2, config, rng=_rng(seed))
            there = transform_points(found.matrix, corners) - transform_points(h, corners)
            errors.setdefault(case, []).append(np.linalg.norm(there, axis=1).max())
    tight, truncated, fitting = (np.median(e) for e in errors.values())
    assert tight < 1.3 * fitting
    assert tight < 0.6 * truncated


def test_fundamental_matrix_is_found_among_seventy_per_cent_outliers():
    found = []
    for seed in range(10):
        p1, p2, _, wrong = _two_views(PINHOLE, outliers=0.7, seed=seed)
        estimate = estimate_fundamental(p1, p2, RansacConfig(max_error_px=1.0), rng=_rng(seed))
        found.append(not isinstance(estimate, Rejected) and estimate.inliers[wrong:].mean() > 0.6)
    # Two of 10,000 samples are clean: those of the inliers of other models find what is missing.
    assert np.mean(found) == 1.0


def test_a_mirrored_plane_is_none():
    p1 = _rng(3).uniform(0, 1, (100, 2)) * SIZE
    mirrored = p1 * [-1, 1] + [1600, 0]
    assert isinstance(estimate_homography(p1, mirrored, rng=_rng()), Rejected)
    assert estimate_homography(p1, SIZE - p1, rng=_rng()).inliers.all()


@pytest.mark.parametrize("seed", range(3))
def test_homography_is_recovered_among_half_outliers_with_the_sign_of_visible_points(seed):
    rng = _rng(seed)
    h = np.array([[1.1, 0.05, 30], [-0.02, 0.95, -20], [1e-5, -2e-5, 1]])
    p1 = rng.uniform(0, 1, (300, 2)) * SIZE
    p2 = transform_points(h, p1) + rng.normal(size=p1.shape) * 0.5
    p2[:150] = rng.uniform(0, 1, (150, 2)) * SIZE
    found = estimate_homography(p1, p2, rng=_rng())
    assert found.inliers[150:].mean() > 0.99
    assert found.inliers[:150].mean() < 0.02
    corners = np.array([[0.0, 0], [1600, 0], [0, 1200], [1600, 1200]])
    assert np.abs(transform_points(found.matrix, corners) - transform_points(h, corners)).max() < 1.0
    assert (found.matrix[2] @ np.append(p1[200], 1)) > 0


def test_homography_errors_treat_both_images_alike():
    rng = _rng(7)
    h = np.diag([0.25, 0.25, 1.0])
    p1 = rng.uniform(0, 1, (200, 2)) * SIZE
    p2 = transform_points(h, p1) + rng.normal(size=p1.shape) * 0.1
    forward = estimate_homography(p1, p2, rng=_rng()).inliers
    backward = estimate_homography(p2, p1, rng=_rng()).inliers
    assert (forward == backward).mean() > 0.98


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
@pytest.mark.parametrize("seed", range(3))
def test_absolute_pose_is_recovered_among_half_outliers_for_every_kind_of_camera(camera, seed):
    pixels, points, pose, wrong = _views_of_points(camera, seed=seed)
    found = estimate_absolute_pose(pixels, points, camera, rng=_rng())
    assert _angle_deg(found.cam_from_world, pose) < 0.3
    assert np.linalg.norm(found.cam_from_world.center - pose.center) < 0.03
    assert found.inliers[wrong:].all()
    assert found.inliers[:wrong].mean() < 0.1
    assert found.camera is camera


def test_points_behind_the_camera_are_no_inliers():
    pixels, points, pose, _ = _views_of_points(PINHOLE, outliers=0)
    behind = pose.inverse() @ -(pose @ points[:40])
    found = estimate_absolute_pose(
        np.concatenate([pixels, pixels[:40]]), np.concatenate([points, behind]), PINHOLE, rng=_rng()
    )
    assert found.inliers[:200].all()
    assert not found.inliers[200:].any()


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
@pytest.mark.parametrize("factor", [0.5, 1.7])
def test_an_unknown_focal_length_is_found_with_the_pose(camera, factor):
    pixels, points, pose, _ = _views_of_points(camera, outliers=0.3, seed=3)
    params = camera.params.copy()
    params[list(camera.model_info.focal_indices)] *= factor
    guess = dataclasses.replace(camera, params=params)
    found = estimate_absolute_pose(pixels, points, guess, rng=_rng(), refine_focal=True)
    assert found.camera.mean_focal_length == pytest.approx(camera.mean_focal_length, rel=0.01)
    assert np.linalg.norm(found.cam_from_world.center - pose.center) < 0.1


def test_refinement_of_an_absolute_pose_ignores_points_of_weight_zero():
    pixels, points, pose, wrong = _views_of_points(RADIAL)
    disturbed = Rigid3.exp(np.array([0.002, -0.003, 0.002, 0.01, 0.01, -0.02])) @ pose
    weights = (np.arange(len(points)) >= wrong).astype(np.float64)
    found = refine_absolute_pose(pixels, points, RADIAL, disturbed, weights=weights)
    shifted = pixels.copy()
    shifted[:wrong] = 0.0
    same = refine_absolute_pose(shifted, points, RADIAL, disturbed, weights=weights)
    assert _angle_deg(found.cam_from_world, pose) < 0.1
    np.testing.assert_allclose(found.cam_from_world.translation, same.cam_from_world.translation, atol=1e-4)


@pytest.mark.parametrize("with_scale", [True, False])
def test_alignment_is_recovered_among_half_outliers(with_scale):
    rng = _rng(1)
    truth = Sim3(np.float64(2.5 if with_scale else 1.0), Rotation3.exp(rng.normal(size=3)), rng.normal(size=3))
    a = rng.normal(size=(60, 3))
    b = truth @ a + rng.normal(size=a.shape) * 1e-3
    b[:30] += rng.normal(size=(30, 3)) * 3
    a[40] = np.nan
    found, mask = align_robust(a, b, 0.01, rng=_rng(), with_scale=with_scale)
    assert float(found.scale) == pytest.approx(float(truth.scale), rel=2e-3)
    assert mask[41:].all()
    assert not mask[:30].any()
    assert not mask[40]


def test_alignment_of_two_collinear_or_unrelated_sets_is_rejected_or_small():
    line = np.arange(10.0)[:, None] * [1.0, 2, 3]
    assert isinstance(align_robust(line, line, 0.1, rng=_rng()), Rejected)
    assert isinstance(align_robust(line[:2], line[:2], 0.1, rng=_rng()), Rejected)
    with pytest.raises(ValueError, match="positive"):
        align_robust(line, line, 0.0, rng=_rng())


def _estimators():
    config = RansacConfig(max_iterations=300)
    return {
        "relative": lambda a, b, rng: estimate_relative_pose(a, b, PINHOLE, PINHOLE, config, rng=rng),
        "fundamental": lambda a, b, rng: estimate_fundamental(a, b, config, rng=rng),
        "homography": lambda a, b, rng: estimate_homography(a, b, config, rng=rng),
        "absolute": lambda a, b, rng: estimate_absolute_pose(
            a, np.concatenate([b, 1e3 + b[:, :1]], axis=1), PINHOLE, config, rng=rng
        ),
    }


DEGENERATE = {
    "nothing": (np.zeros((0, 2)), np.zeros((0, 2))),
    "fewer than minimal": (np.arange(6.0).reshape(3, 2), np.arange(6.0).reshape(3, 2)),
    "one point": (np.full((50, 2), 300.0), np.full((50, 2), 300.0)),
    "a line": (np.arange(50.0)[:, None] * [8.0, 4], np.arange(50.0)[:, None] * [6.0, 5]),
    "not a number": (np.full((50, 2), np.nan), np.full((50, 2), np.nan)),
    "all outliers": (_rng(8).uniform(0, 1200, (60, 2)), _rng(9).uniform(0, 1200, (60, 2))),
    "infinite": (np.full((50, 2), np.inf), np.full((50, 2), 1.0)),
}


@pytest.mark.parametrize("estimator", ["relative", "fundamental", "homography", "absolute"])
@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_data_are_rejected_or_give_finite_results(estimator, case):
    found = _estimators()[estimator](*DEGENERATE[case], _rng())
    if isinstance(found, Rejected):
        assert found.reason
        return
    assert case in ("one point", "a line", "all outliers")
    for name in ("matrix", "essential"):
        if hasattr(found, name):
            assert np.isfinite(getattr(found, name)).all()
    if estimator == "absolute":
        assert np.isfinite(found.cam_from_world.matrix).all()
    assert case != "all outliers" or found.inliers.sum() < 30


@pytest.mark.parametrize("estimator", ["relative", "fundamental"])
def test_rows_that_are_not_finite_are_ignored(estimator):
    p1, p2, _, wrong = _two_views(PINHOLE, outliers=0.2)
    p1[-3], p2[-5] = np.nan, np.inf
    found = _estimators()[estimator](p1, p2, _rng())
    assert found.inliers[wrong:].mean() > 0.9
    assert not found.inliers[[-3, -5]].any()


@pytest.mark.parametrize("estimator", ["relative", "fundamental", "homography", "absolute"])
def test_the_same_seed_gives_the_same_bits(estimator):
    p1, p2, _, _ = _two_views(PINHOLE, plane=estimator == "homography")
    run = _estimators()[estimator]
    first, second = run(p1, p2, _rng(3)), run(p1, p2, _rng(3))
    if isinstance(first, Rejected):
        assert first == second
        return
    np.testing.assert_array_equal(first.inliers, second.inliers)
    if estimator != "absolute":
        name = "essential" if estimator == "relative" else "matrix"
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize("estimator", ["relative", "fundamental", "homography", "absolute"])
def test_point_sets_of_different_lengths_are_refused(estimator):
    with pytest.raises(REFUSED):
        _estimators()[estimator](np.zeros((20, 2)), np.zeros((19, 2)), _rng())


def test_inliers_are_those_of_a_tighter_bound_only_if_they_meet_it():
    p1, p2, _, _ = _two_views(PINHOLE, noise=1.0)
    wide = estimate_relative_pose(p1, p2, PINHOLE, PINHOLE, RansacConfig(max_error_px=6.0), rng=_rng())
    tight = estimate_relative_pose(p1, p2, PINHOLE, PINHOLE, RansacConfig(max_error_px=1.0), rng=_rng())
    assert 20 < tight.inliers.sum() < wide.inliers.sum()
    strict = RansacConfig(min_inlier_ratio=0.9)
    found = estimate_relative_pose(p1, p2, PINHOLE, PINHOLE, strict, rng=_rng())
    assert isinstance(found, Rejected)
    assert found.reason == "low_inlier_ratio"


_PROGRAM = """
import numpy as np
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.robust import RansacConfig, estimate_absolute_pose, estimate_fundamental, estimate_homography
from sfm.core.robust import estimate_relative_pose
camera = Camera("SIMPLE_RADIAL", 1600, 1200, np.array([1300.0, 800, 600, -0.05]))
rng = np.random.default_rng(0)
points = rng.uniform(-1, 1, (30, 3)) + [0, 0, 5]
pose = Rigid3(Rotation3.exp(np.array([0.05, -0.2, 0.1])), np.array([1.0, 0.1, 0.2]))
p1, p2 = camera.project(points)[0], camera.project(pose @ points)[0]
p1, p2 = p1 + 0.3 * rng.normal(size=p1.shape), p2 + 0.3 * rng.normal(size=p2.shape)
p2[:6] += 40 * rng.normal(size=(6, 2))
out, g = [], np.random.default_rng
for score, quality in (("truncated", None), ("marginalized", -np.abs(np.arange(30) - 14.2))):
    config = RansacConfig(min_iterations=5, max_iterations=5, min_inliers=8, max_error_px=3, score=score)
    chance = lambda: {"rng": g(1), "quality": quality}
    out.append(estimate_relative_pose(p1, p2, camera, camera, config, **chance()).essential)
    out.append(estimate_fundamental(p1, p2, config, **chance()).matrix)
    out.append(estimate_homography(p1, p1 + [3, 4], config, **chance()).matrix)
    out.append(estimate_absolute_pose(p2, points, camera, config, **chance()).cam_from_world.matrix)
print(repr([m.ravel().tolist() for m in out]))
"""


def test_estimates_are_the_same_without_compilation():
    outputs = [
        subprocess.run(
            [sys.executable, "-c", _PROGRAM],
            env={**os.environ, "NUMBA_DISABLE_JIT": disabled},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for disabled in ("0", "1")
    ]
    compiled, interpreted = (eval(text) for text in outputs)
    assert len(compiled) == 8
    for a, b in zip(compiled, interpreted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)
