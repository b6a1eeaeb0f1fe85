"""Homographies, the closed form and its ladder, and first poses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.refine_lenses import lens_by_name
from calib.refine_views import BoardView, gather
from calib.zhang import (
    centred_focal_lengths,
    find_start,
    fit_view_homographies,
    intrinsics_from_homographies,
    poses_of_views,
)
from sfm.core.errors import Rejected
from sfm.core.geometry.homography import fit_homography
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.calib.boards_in_space import FISHEYE, LENS, PINHOLE, flat_board, poses_before, seen

BOARD = flat_board()


def made(camera, rng, count=8, noise_px=0.0, **how):
    poses = poses_before(camera, count, rng, **how)
    return poses, gather(BOARD, seen(camera, BOARD, poses, rng, noise_px))


def test_homographies_are_those_of_the_linear_fit_of_each_view(rng):
    _, observations = made(PINHOLE, rng, noise_px=0.5)
    found = fit_view_homographies(observations)
    for v in range(len(observations)):
        rows = slice(observations.offsets[v], observations.offsets[v + 1])
        expected = fit_homography(BOARD[observations.rows[rows], :2].copy(), observations.points2D[rows])
        H = found.matrices[v]
        # One fixes h33 at the centre, the other the norm: with noise they differ by a part of the noise.
        points = np.c_[BOARD[:, :2], np.ones(len(BOARD))]
        by_both = [(points @ m.T)[:, :2] / (points @ m.T)[:, 2:] for m in (H, expected)]
        assert np.abs(by_both[0] - by_both[1]).max() < 0.05
        assert 0.3 < found.errors[v] < 1.0
        assert np.all((points @ H.T)[:, 2] > 0)


def test_robust_homographies_ignore_corners_that_are_far_off(rng):
    poses = poses_before(PINHOLE, 4, rng, reach=0.1)
    views = seen(PINHOLE, BOARD, poses, rng, 0.0)
    spoilt = []
    for view in views:
        points2D = np.array(view.points2D)
        points2D[rng.permutation(len(points2D))[:6]] += rng.uniform(50, 200, (6, 2))
        spoilt.append(dataclasses.replace(view, points2D=points2D))
    clean = fit_view_homographies(gather(BOARD, views)).matrices
    points = np.c_[BOARD[:, :2], np.ones(len(BOARD))]
    for robust, limit in ((True, 1.0), (False, np.inf)):
        found = fit_view_homographies(gather(BOARD, spoilt), robust=robust).matrices
        off = [
            np.abs((points @ a.T)[:, :2] / (points @ a.T)[:, 2:] - (points @ b.T)[:, :2] / (points @ b.T)[:, 2:]).max()
            for a, b in zip(found, clean, strict=True)
        ]
        assert max(off) < limit
        assert robust or max(off) > 10.0


def test_corners_on_a_line_have_no_homography():
    ids = np.arange(9)
    view = BoardView("line", 640, 480, ids, BOARD[ids, :2] * 1000 + 300)
    assert np.isnan(fit_view_homographies(gather(BOARD, [view])).errors[0])


def test_the_closed_form_is_exact_without_noise_and_distortion(rng):
    _, observations = made(PINHOLE, rng)
    found = intrinsics_from_homographies(fit_view_homographies(observations).matrices, 1280, 960)
    assert not isinstance(found, Rejected)
    np.testing.assert_allclose(found[0], PINHOLE.params, rtol=1e-8)
    assert found[1] == "closed_form"


def test_focal_lengths_with_a_known_principal_point_are_exact_without_noise_and_distortion(rng):
    centred = PINHOLE.with_params(np.array([1050.0, 1043.0, 640.0, 480.0]))
    _, observations = made(centred, rng)
    found = centred_focal_lengths(fit_view_homographies(observations).matrices, 1280, 960)
    assert found is not None
    np.testing.assert_allclose(found, [1050.0, 1043.0], rtol=1e-8)


def test_boards_parallel_to_the_image_tell_no_focal_lengths(rng):
    poses = [Rigid3(Rotation3.identity(), np.append(rng.uniform(-0.1, 0.1, 2), 0.5)) for _ in range(5)]
    observations = gather(BOARD, seen(PINHOLE, BOARD, poses, rng, 0.0))
    assert centred_focal_lengths(fit_view_homographies(observations).matrices, 1280, 960) is None


def test_parallel_boards_climb_down_the_ladder(rng):
    pose = Rigid3(Rotation3.exp(np.array([0.5, 0.3, 0.0])), np.array([0.0, 0.0, 0.5]))
    poses = [Rigid3(pose.rotation, np.append(rng.uniform(-0.1, 0.1, 2), rng.uniform(0.4, 0.8))) for _ in range(8)]
    observations = gather(BOARD, seen(PINHOLE, BOARD, poses, rng, 0.0))
    (fx, fy, cx, cy), rung, detail = intrinsics_from_homographies(
        fit_view_homographies(observations).matrices, 1280, 960
    )
    assert rung == "centred"
    assert "parallel" in detail
    assert (cx, cy) == (640.0, 480.0)
    assert abs(fx / 1050 - 1) < 0.1
    assert abs(fy / 1043 - 1) < 0.1


def test_boards_parallel_to_the_image_determine_no_focal_length(rng):
    poses = [Rigid3(Rotation3.identity(), np.append(rng.uniform(-0.1, 0.1, 2), 0.5)) for _ in range(5)]
    observations = gather(BOARD, seen(PINHOLE, BOARD, poses, rng, 0.0))
    found = intrinsics_from_homographies(fit_view_homographies(observations).matrices, 1280, 960)
    assert isinstance(found, Rejected)
    assert found.reason == "undetermined_focal"


@pytest.mark.parametrize("camera", [PINHOLE, LENS, FISHEYE], ids=lambda camera: camera.model)
def test_first_poses_with_the_true_camera_are_the_true_ones(camera, rng):
    poses, observations = made(camera, rng, reach=0.4)
    R, t, errors = poses_of_views(observations, camera)
    for v, pose in enumerate(poses):
        np.testing.assert_allclose(R[v], pose.rotation.matrix, atol=1e-8)
        np.testing.assert_allclose(t[v], pose.translation, atol=1e-8)
    assert errors.max() < 1e-8


def test_poses_are_found_where_rays_come_from_behind_the_image_plane(rng):
    wide = dataclasses.replace(FISHEYE, params=FISHEYE.params * np.array([0.8, 0.8, 1, 1, 0, 0, 0, 0]))
    ray = np.array([np.sin(1.6), 0.0, np.cos(1.6)])
    turn = Rotation3.exp(np.array([0.0, 1.6, 0.0])) @ Rotation3.exp(np.array([0.3, -0.2, 0.1]))
    pose = Rigid3(turn, 0.5 * ray)
    assert np.any((pose @ BOARD)[:, 2] < 0)
    pixels, valid = wide.project(pose @ BOARD)
    view = BoardView("behind", 1280, 960, np.flatnonzero(valid), pixels[valid])
    R, t, _ = poses_of_views(gather(BOARD, [view]), wide)
    np.testing.assert_allclose(R[0], pose.rotation.matrix, atol=1e-8)
    np.testing.assert_allclose(t[0], pose.translation, atol=1e-8)


def test_a_wide_lens_starts_from_the_best_of_the_focal_lengths_that_are_tried(rng):
    _, observations = made(FISHEYE, rng, count=12, noise_px=0.2)
    start = find_start(observations, fit_view_homographies(observations), lens_by_name("fisheye"))
    assert not isinstance(start, Rejected)
    assert start.rung == "tried"
    assert abs(np.log(start.camera.mean_focal_length / FISHEYE.mean_focal_length)) < 0.2


def test_a_focal_length_that_is_given_is_taken(rng):
    _, observations = made(PINHOLE, rng)
    start = find_start(observations, fit_view_homographies(observations), lens_by_name("opencv5"), 900.0)
    assert not isinstance(start, Rejected)
    assert start.rung == "given"
    assert start.camera.focal_lengths == (900.0, 900.0)
