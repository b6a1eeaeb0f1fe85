"""Rigs from corners: what is found, what is left out, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.board_turns import board_turns
from calib.boards import chessboard
from calib.refine_views import BoardView
from calib.rig import RigCalibration, RigConfig, calibrate_rig
from calib.rig_epipolar import distances_from_curves, epipolar_errors
from calib.rig_shapes import choose_rig_shape
from calib.rig_views import RigCamera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.calib.boards_in_space import FISHEYE, LENS, flat_board
from tests.calib.rigs_in_space import BESIDE, PAIR, RIGHT, THREE, photographed, poses_before_rig

BOARD = flat_board()
PLAIN = RigConfig(reject=False)


def stereo(rng, count=14, noise_px=0.1, board=BOARD) -> list[RigCamera]:
    return photographed(*PAIR, board, poses_before_rig(count, rng), rng, noise_px)


def calibrated(cameras, config=PLAIN, board=BOARD, **how) -> RigCalibration:
    found = calibrate_rig(board, cameras, config, **how)
    assert not isinstance(found, Rejected), found
    return found


def refused(cameras, config=PLAIN, board=BOARD) -> Rejected:
    found = calibrate_rig(board, cameras, config)
    assert isinstance(found, Rejected)
    return found


def with_views(camera: RigCamera, kept) -> RigCamera:
    return dataclasses.replace(
        camera, views=tuple(camera.views[k] for k in kept), frames=tuple(camera.frames[k] for k in kept)
    )


def in_frames(camera: RigCamera, frames) -> RigCamera:
    return with_views(camera, [k for k, frame in enumerate(camera.frames) if int(frame) in frames])


def off(found: RigCalibration, c: int, mount: Rigid3) -> tuple[float, float]:
    """Radians and metres."""
    apart = found.cams_from_rig[c] @ mount.inverse()
    return float(apart.rotation.angle), float(np.linalg.norm(apart.translation))


# --- what is found ------------------------------------------------------------------------------------------------


def test_without_noise_the_rig_is_the_true_one(rng):
    poses = poses_before_rig(12, rng)
    found = calibrated(photographed(*THREE, BOARD, poses, rng, 0.0))
    assert found.converged
    assert found.rms_px < 1e-8
    for c, (camera, mount) in enumerate(zip(*THREE, strict=True)):
        np.testing.assert_allclose(found.cameras[c].params, camera.params, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(found.cams_from_rig[c].matrix, mount.matrix, atol=1e-8)
    frames = [int(frame) for frame in found.observations.frames]
    np.testing.assert_allclose(found.rigs_from_board.translation, [poses[f].translation for f in frames], atol=1e-7)


def test_cameras_that_never_meet_are_connected_by_one_that_meets_both(rng):
    one, two, three = photographed(*THREE, BOARD, poses_before_rig(24, rng), rng, 0.0)
    cameras = [in_frames(one, range(12)), in_frames(two, range(24)), in_frames(three, range(12, 24))]
    found = calibrated(cameras)
    assert epipolar_errors(found, 0, 2) is None
    for c, mount in enumerate(THREE[1]):
        np.testing.assert_allclose(found.cams_from_rig[c].matrix, mount.matrix, atol=1e-7)


def test_the_order_of_cameras_and_views_does_not_matter(rng):
    cameras = photographed(*THREE, BOARD, poses_before_rig(14, rng), rng)
    found = calibrated(cameras)
    shuffled = [
        with_views(camera, rng.permutation(len(camera.views))) for camera in (cameras[1], cameras[2], cameras[0])
    ]
    other = calibrated(shuffled)
    assert other.cost == pytest.approx(found.cost, rel=1e-9)
    again = found.cams_from_rig[2] @ found.cams_from_rig[1].inverse()
    np.testing.assert_allclose(other.cams_from_rig[1].matrix, again.matrix, atol=1e-7)


def test_the_same_views_give_the_same_bits(rng):
    cameras = photographed(*THREE, BOARD, poses_before_rig(14, rng), rng)
    one, two = calibrated(cameras, RigConfig()), calibrated(cameras, RigConfig())
    np.testing.assert_array_equal(one.cams_from_rig.matrix, two.cams_from_rig.matrix)
    for params, others in zip(one.cameras, two.cameras, strict=True):
        np.testing.assert_array_equal(params.params, others.params)


def test_known_cameras_are_held_and_refined_only_if_asked_for(rng):
    known = [dataclasses.replace(one, camera=camera) for one, camera in zip(stereo(rng), PAIR[0], strict=True)]
    held = calibrated(known)
    for camera, given in zip(held.cameras, PAIR[0], strict=True):
        np.testing.assert_array_equal(camera.params, given.params)
    assert held.free_names == ((), ())
    refined = calibrated(known, dataclasses.replace(PLAIN, refine_known=True))
    assert refined.cost < held.cost
    assert refined.free_names[0][:2] == ("fx", "fy")
    assert off(held, 1, BESIDE) < (0.001, 0.0002)


def test_two_photos_of_a_known_camera_are_enough_beside_others(rng):
    cameras = stereo(rng, count=12)
    few = dataclasses.replace(in_frames(cameras[1], range(3)), camera=RIGHT)
    assert off(calibrated([cameras[0], few]), 1, BESIDE)[1] < 0.001


def test_cameras_as_each_is_alone_may_be_held(rng):
    found = calibrated(stereo(rng), dataclasses.replace(PLAIN, refine_intrinsics=False))
    for camera, alone in zip(found.cameras, found.calibrations, strict=True):
        assert alone is not None
        np.testing.assert_array_equal(camera.params, alone.camera.params)


def test_a_noisy_camera_weighs_less(rng):
    def both(weigh):
        errors = []
        for seed in range(6):
            rng = np.random.default_rng(seed)
            poses = poses_before_rig(12, rng)
            sharp = photographed(*PAIR, BOARD, poses, rng, 0.05)
            blurred = photographed(*PAIR, BOARD, poses, rng, 1.0)
            errors.append(
                off(calibrated([sharp[0], blurred[1]], dataclasses.replace(PLAIN, weigh_cameras=weigh)), 1, BESIDE)
            )
        return np.mean(np.square(errors), axis=0)

    assert np.all(both(True) < both(False))


def test_a_bent_board_is_told_by_held_out_frames(rng):
    x = BOARD[:, 0] / 0.12
    bent = BOARD + np.stack([0 * x, 0 * x, 0.0008 * (1 - x**2)], 1)
    ranked = choose_rig_shape(BOARD, stereo(rng, count=14, board=bent), PLAIN)
    assert not isinstance(ranked, Rejected)
    assert ranked[0].kind == "paraboloid"
    assert ranked[0].found is not None
    assert ranked[0].found.shape.bend == pytest.approx(0.0008, rel=0.1)
    flat = choose_rig_shape(BOARD, stereo(rng, count=14), PLAIN)
    assert not isinstance(flat, Rejected)
    assert flat[0].kind == "flat"


def test_a_rig_s_board_of_too_many_numbers_for_the_frames_is_told_and_not_taken(rng):
    rough = BOARD + rng.normal(0, 2e-4, BOARD.shape)
    ranked = choose_rig_shape(BOARD, stereo(rng, count=12, board=rough), PLAIN)
    assert not isinstance(ranked, Rejected)
    free = next(row for row in ranked if row.kind == "free")
    assert ranked[0].kind != "free"
    assert ranked[0].ratio < 1.05 < free.ratio
    assert free.held_out_rms_px < 0.5 * ranked[0].held_out_rms_px
    assert free.would_bring.endswith("frames like these, or --shape free")
    many = choose_rig_shape(BOARD, stereo(rng, count=30, board=rough), PLAIN)
    assert not isinstance(many, Rejected)
    assert many[0].kind == "free"


def test_partners_lie_on_each_other_s_epipolar_curves(rng):
    exact = epipolar_errors(calibrated(stereo(rng, noise_px=0.0)), 0, 1)
    noisy = epipolar_errors(calibrated(stereo(rng, count=20, noise_px=0.2)), 0, 1)
    assert exact is not None
    assert noisy is not None
    assert exact.rms_px < 1e-7
    assert exact.vertical_px < 1e-7
    assert noisy.rms_px == pytest.approx(0.2 * np.sqrt(2), rel=0.1)  # noise of both partners
    assert noisy.vertical_px == pytest.approx(0.2 * np.sqrt(2), rel=0.2)


@pytest.mark.parametrize("camera", [LENS, FISHEYE], ids=["distorted", "fisheye"])
def test_a_pixel_that_is_moved_off_its_curve_is_off_by_as_much(camera, rng):
    points = rng.uniform([-0.3, -0.3, 1.0], [0.3, 0.3, 2.0], (20, 3))
    rays1 = points / np.linalg.norm(points, axis=1, keepdims=True)
    pixels, _ = camera.project(BESIDE @ points)
    far, _ = camera.project(BESIDE @ (1.001 * points))
    along = (far - pixels) / np.linalg.norm(far - pixels, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    rays2, _ = camera.unproject(pixels + 0.5 * across + 3.0 * along)
    np.testing.assert_allclose(np.abs(distances_from_curves(camera, rays1, rays2, BESIDE)), 0.5, rtol=0.03)


# --- the ends of the board ----------------------------------------------------------------------------------------

EVEN = chessboard(8, 6, 0.03)
EVEN_POINTS = np.asarray(EVEN.points3D)
MIDDLE = Rigid3(Rotation3.identity(), -EVEN_POINTS.mean(0))


@pytest.mark.parametrize("upside_down", [False, True], ids=["upright", "upside down"])
def test_views_that_start_at_the_other_end_of_the_board_are_turned(upside_down, rng):
    mount = Rigid3.exp(np.array([0, 0, np.pi, 0, 0, 0])) @ BESIDE if upside_down else BESIDE
    poses = [pose @ MIDDLE for pose in poses_before_rig(12, rng)]
    one, two = photographed(PAIR[0], (Rigid3.identity(), mount), EVEN_POINTS, poses, rng)
    wrong = rng.random(len(two.views)) < 0.5
    views = [
        dataclasses.replace(view, corner_ids=47 - view.corner_ids) if bad else view
        for view, bad in zip(two.views, wrong, strict=True)
    ]
    found = calibrated([one, dataclasses.replace(two, views=tuple(views))], board=EVEN_POINTS, turns=board_turns(EVEN))
    assert off(found, 1, mount) < (0.002, 0.0003)
    assert found.sigma_px == pytest.approx(0.1, rel=0.1)
    # A turn is relative: of a frame either camera's view may be the one that is turned.
    turned = {*found.turned[0]} ^ {*found.turned[1]}
    assert turned == {frame for frame, bad in zip(two.frames, wrong, strict=True) if bad}
    assert found.fallbacks == ()


def test_boards_look_alike_after_the_turns_that_their_squares_allow():
    assert len(board_turns(chessboard(9, 6, 0.03))) == 1
    assert len(board_turns(chessboard(8, 6, 0.03))) == 2
    assert len(board_turns(chessboard(7, 7, 0.03))) == 4
    for turn in board_turns(chessboard(7, 7, 0.03)):
        points = np.asarray(chessboard(7, 7, 0.03).points3D)
        np.testing.assert_allclose(turn.motion @ points, points[turn.rows], atol=1e-12)


# --- what is left out ---------------------------------------------------------------------------------------------


def moved(view: BoardView, by) -> BoardView:
    return dataclasses.replace(view, points2D=view.points2D + by)


def test_a_frame_of_two_moments_is_left_out_and_named(rng):
    one, two = stereo(rng)
    views = list(two.views)
    views[4], views[5] = views[5], views[4]
    found = calibrated([one, dataclasses.replace(two, views=tuple(views))], RigConfig())
    named = {view.name for part in found.rejected_views for view in part if view.reason == "disagrees"}
    assert {name[-2:] for name in named} == {"04", "05"}
    assert off(found, 1, BESIDE) < (0.002, 0.0003)


@pytest.mark.parametrize("mount", [BESIDE, THREE[1][2]], ids=["beside", "above"])
def test_two_swapped_frames_do_not_cost_all_others(mount):
    """Least squares ends so far away that by the noise of sharp photos nothing fits there."""
    for seed, (i, j) in ((1, (0, 5)), (0, (3, 4) if mount is not BESIDE else (0, 5))):
        rng = np.random.default_rng(seed)
        cameras, mounts = (LENS, FISHEYE), (Rigid3.identity(), mount)
        one, two = photographed(cameras, mounts, BOARD, poses_before_rig(7, rng), rng, 0.01)
        views = list(two.views)
        views[i], views[j] = views[j], views[i]
        found = calibrated([one, dataclasses.replace(two, views=tuple(views))], RigConfig())
        named = {view.name[-2:] for part in found.rejected_views for view in part if view.reason == "disagrees"}
        assert {int(name) for name in named} == {i, j}
        assert off(found, 1, mount) < (0.001, 0.0002)
        assert found.rms_px == pytest.approx(0.01 * np.sqrt(2), rel=0.1)


def test_single_corners_are_left_out(rng):
    one, two = stereo(rng)
    views = list(two.views)
    for k in (2, 7):
        points = np.array(views[k].points2D)
        points[:2] += 9.0
        views[k] = dataclasses.replace(views[k], points2D=points)
    found = calibrated([one, dataclasses.replace(two, views=tuple(views))], RigConfig())
    assert {name for name, _ in found.rejected_corners[1]} == {two.views[2].name, two.views[7].name}
    assert 4 <= len(found.rejected_corners[1]) <= 6
    assert found.rejected_views == ((), ())


def test_nothing_is_left_out_of_good_views(rng):
    found = calibrated(stereo(rng, count=20), RigConfig())
    assert found.rejected_views == ((), ())
    assert sum(map(len, found.rejected_corners)) <= 1


def test_a_photo_that_is_there_twice_counts_once(rng):
    one, two = stereo(rng)
    copy = dataclasses.replace(one.views[0], name="copy")
    twice = dataclasses.replace(one, views=(*one.views, copy), frames=(*one.frames, "99"))
    found = calibrated([twice, two])
    assert [(view.name, view.reason) for view in found.rejected_views[0]] == [("copy", f"copy_of {one.views[0].name}")]
    assert found.cost == calibrated([one, two]).cost


def test_photos_of_another_size_are_named(rng):
    one, two = stereo(rng)
    views = (*two.views[:-1], dataclasses.replace(two.views[-1], width=960, height=1280))
    for known in (None, RIGHT):
        found = calibrated([one, dataclasses.replace(two, views=views, camera=known)])
        assert [(view.name, view.reason) for view in found.rejected_views[1]] == [(views[-1].name, "other_size")]


# --- what is refused ----------------------------------------------------------------------------------------------


def test_cameras_without_a_common_frame_are_refused(rng):
    one, two, three = photographed(*THREE, BOARD, poses_before_rig(24, rng), rng)
    reason = refused([in_frames(one, range(12)), in_frames(two, range(12)), in_frames(three, range(12, 24))])
    assert reason.reason == "cameras_not_connected"
    assert "cam0, cam1 | cam2" in reason.detail


def test_one_common_frame_is_refused(rng):
    one, two = stereo(rng, count=24)
    reason = refused([in_frames(one, range(12)), in_frames(two, range(11, 24))])
    assert reason.reason == "cameras_not_connected"
    assert "cam0 and cam1 share 1" in reason.detail


def test_a_camera_that_never_sees_the_board_is_named(rng):
    one, two = stereo(rng)
    reason = refused([one, dataclasses.replace(two, views=(), frames=())])
    assert reason.reason == "camera_without_board"
    assert "cam1" in reason.detail


def test_boards_that_are_parallel_to_the_image_are_refused_with_the_camera_s_name(rng):
    poses = [Rigid3(Rotation3.exp(np.array([0, 0, a])), np.array([x, 0.0, 0.5])) for a, x in rng.normal(0, 0.1, (9, 2))]
    reason = refused(
        photographed((LENS, LENS), (Rigid3.identity(), Rigid3.exp(np.array([0, 0, 0, -0.1, 0, 0]))), BOARD, poses, rng)
    )
    assert reason.reason == "undetermined_focal"
    assert reason.detail.startswith("cam0: ")


def test_the_same_photos_for_two_cameras_are_refused(rng):
    one, _ = stereo(rng)
    saved_anew = tuple(
        dataclasses.replace(v, points2D=v.points2D + rng.normal(0, 0.03, v.points2D.shape)) for v in one.views
    )
    for views in (one.views, saved_anew):
        reason = refused([one, dataclasses.replace(one, name="other", views=views)])
        assert reason.reason == "same_photos"
        assert "cam0 and other" in reason.detail


def test_frames_that_are_paired_wrongly_throughout_are_refused(rng):
    one, two = stereo(rng)
    reason = refused([one, dataclasses.replace(two, views=(*two.views[3:], *two.views[:3]))], RigConfig())
    assert reason.reason in ("cameras_disagree", "nothing_fits")


def test_a_known_camera_of_another_size_is_refused(rng):
    one, two = stereo(rng)
    reason = refused([one, dataclasses.replace(two, camera=RIGHT.scaled(640, 480))])
    assert reason.reason == "other_size"
    assert "1280x960" in reason.detail
    assert "640x480" in reason.detail


def test_mistakes_of_the_caller_are_told(rng):
    one, two = stereo(rng, count=4)
    with pytest.raises(ValueError, match="two or more cameras"):
        calibrate_rig(BOARD, [one])
    with pytest.raises(ValueError, match="different names"):
        calibrate_rig(BOARD, [one, dataclasses.replace(two, name="cam0")])
    with pytest.raises(ValueError, match="two views of the frame '00'"):
        RigCamera("a", one.views[:2], ("00", "00"))
