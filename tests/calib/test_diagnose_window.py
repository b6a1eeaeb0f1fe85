"""Corners that the next squares shift, refined on rendered boards as the tutorial does; and what only looks so."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from calib.boards import chessboard
from calib.check import check_camera, known_shape
from calib.diagnose_window import crowding, stated_finding, window_finding
from calib.refine import CalibrationConfig, calibrate
from calib.refine_views import BoardView, gather
from calib.uncertainty_holdout import fit_poses
from datasets.synthetic.boards import PINHOLE, pose, render
from sfm.core.errors import Rejected
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen, with_corners

BOARD = chessboard(9, 6, 0.02)
FLAT = flat_board()
TUTORIAL = 11


@pytest.fixture(scope="module")
def photos():
    """Ten boards, tilted steeply, with squares of 11 to 40 px, and where their corners are."""
    rng = np.random.default_rng(3)
    shown = []
    for k, distance in enumerate(np.linspace(0.2, 0.3, 10)):
        held = pose(BOARD, distance, rng.uniform(50, 65), rng.uniform(0, 360), shift=rng.uniform(-0.02, 0.02, 2))
        shown.append(render(BOARD, PINHOLE, held, seed=k, texels_per_m=2000))
    return shown


def refined(photos, window):
    """Views of corners that OpenCV refined with a half-window, or with one for each photo."""
    views = []
    for k, (image, points2D) in enumerate(photos):
        inside = np.all((points2D > 3) & (points2D < [477, 357]), axis=1)
        ids, points = np.flatnonzero(inside), points2D[inside]
        apart = np.linalg.norm(points[:, None] - points[None], axis=2)
        np.fill_diagonal(apart, np.inf)
        half = window or max(2, int(0.35 * apart.min()))
        found = np.round(points - 0.5).astype(np.float32).reshape(-1, 1, 2)
        cv2.cornerSubPix(image, found, (half, half), (-1, -1), (3, 30, 0.01))
        views.append(BoardView(f"{k}", 480, 360, ids, found.reshape(-1, 2).astype(float) + 0.5))
    return views


def judged(views, board=BOARD.points3D, lens="opencv4"):
    """What is said of all corners with the camera that was calibrated from them."""
    found = calibrate(board, views, CalibrationConfig(lens=lens))
    assert not isinstance(found, Rejected), found
    system, _ = fit_poses(found.camera, found.shape, gather(board, views))
    return window_finding(system.observations, system.residuals())


def test_the_tutorial_s_window_is_named_where_squares_are_small(photos):
    finding = judged(refined(photos, TUTORIAL))
    assert finding is not None
    assert finding.cause == "window_too_large"
    smallest = min(
        np.linalg.norm(np.diff(points.reshape(6, 9, 2), axis=axis), axis=2).min()
        for _, points in photos
        for axis in (0, 1)
    )
    allowed = int(finding.remedy.split("no more than ")[1].split()[0])
    assert 0.25 * smallest < allowed < 0.45 * smallest


def test_a_window_that_fits_each_photo_is_not(photos):
    assert judged(refined(photos, 0)) is None


def test_a_check_of_a_true_camera_names_the_window_of_the_photos(photos):
    shape = known_shape(BOARD.points3D)
    bad = check_camera(PINHOLE, shape, refined(photos, TUTORIAL), limit_px=0.2)
    good = check_camera(PINHOLE, shape, refined(photos, 0), limit_px=0.2)
    assert not isinstance(bad, Rejected)
    assert not isinstance(good, Rejected)
    assert "window_too_large" in [finding.cause for finding in bad.findings]
    assert good.rms_px < 0.2 < bad.rms_px
    assert "window_too_large" not in [finding.cause for finding in good.findings]


def test_boards_that_are_far_and_blurred_are_no_window(rng):
    poses = poses_before(LENS, 14, rng)
    depths = np.array([pose.translation[2] for pose in poses])
    views = [
        seen(LENS, FLAT, [pose], rng, noise)[0]
        for pose, noise in zip(poses, 0.05 + 0.6 * (depths > np.median(depths)), strict=True)
    ]
    assert judged(views, FLAT) is None


def test_a_bent_board_and_a_lens_that_does_not_fit_are_no_window(rng):
    bent = FLAT + np.column_stack([0 * FLAT[:, :2], 0.003 * (1 - (FLAT[:, 0] / 0.12) ** 2)])
    assert judged(seen(LENS, bent, poses_before(LENS, 14, rng), rng), FLAT) is None
    assert judged(seen(LENS, FLAT, poses_before(LENS, 14, rng), rng), FLAT, lens="simple_radial") is None


def test_corners_at_the_rim_are_shifted_only_where_they_are_near_the_next(rng):
    views = []
    for view in seen(LENS, FLAT, poses_before(LENS, 14, rng), rng):
        rim = (np.abs(FLAT[view.corner_ids, 0]) > 0.11) | (np.abs(FLAT[view.corner_ids, 1]) > 0.07)
        views.append(with_corners(view, view.points2D + 0.8 * rim[:, None] * rng.normal(size=view.points2D.shape)))
    assert judged(views, FLAT) is None


def test_too_few_corners_tell_nothing(rng):
    observations = gather(FLAT, seen(LENS, FLAT, poses_before(LENS, 1, rng), rng))
    assert not crowding(observations, np.ones((len(observations.rows), 2))).is_shifted
    nothing = gather(FLAT, [])
    assert window_finding(nothing, np.zeros((0, 2))) is None


@pytest.mark.parametrize(
    ("stated_px", "is_ours", "cause"),
    [(0.41, False, "window_too_large"), (0.41, True, "worse_corners"), (0.2, False, None), (math.nan, False, None)],
)
def test_an_error_that_a_file_states_far_above_ours_is_put_down_to_its_corners(photos, stated_px, is_ours, cause, rng):
    views = refined(photos, 0)
    residuals = rng.normal(0, 0.12, (sum(len(view.corner_ids) for view in views), 2))
    finding = stated_finding(stated_px, gather(BOARD.points3D, views), residuals, is_ours=is_ours)
    assert (finding.cause if finding else None) == cause


def test_where_squares_are_large_it_is_not_put_down_to_the_window(rng):
    near = [pose for pose in poses_before(LENS, 20, rng) if pose.translation[2] < 0.5]
    observations = gather(FLAT, seen(LENS, FLAT, near, rng))
    finding = stated_finding(0.5, observations, rng.normal(0, 0.1, (len(observations.rows), 2)))
    assert finding is not None
    assert finding.cause == "worse_corners"
