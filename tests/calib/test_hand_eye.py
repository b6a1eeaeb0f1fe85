"""A camera on a robot: what is found, how sure it is, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.board_turns import board_turns
from calib.boards import chessboard
from calib.hand_eye import HandEyeCalibration, HandEyeConfig, calibrate_hand_eye
from calib.hand_eye_start import axis_spread, closed_form
from calib.hand_eye_system import HandEyeEstimate, HandEyeSystem
from calib.refine_views import BoardView, gather
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen

BOARD = flat_board()
MOUNT_FROM_CAM = Rigid3.exp(np.array([0.05, -0.4, 1.2, 0.03, -0.06, 0.11]))
WORLD_FROM_BOARD = Rigid3.exp(np.array([2.9, 0.2, -0.1, 0.6, 0.1, 0.02]))


def robot_before(cams_from_board: list[Rigid3], rng, sigma=(0.0, 0.0), setup="eye_in_hand") -> Rigid3:
    """base_from_hand of views, off by chance in the frame of the hand: radians and metres on each axis."""
    hands = []
    for pose in cams_from_board:
        mount_from_world = MOUNT_FROM_CAM @ pose @ WORLD_FROM_BOARD.inverse()
        hand = mount_from_world.inverse() if setup == "eye_in_hand" else mount_from_world
        hands.append(hand @ Rigid3(Rotation3.exp(sigma[0] * rng.normal(size=3)), sigma[1] * rng.normal(size=3)))
    return Rigid3.stack(hands)


def scene(rng, count=15, noise_px=0.1, sigma=(0.0, 0.0), setup="eye_in_hand") -> tuple[list[BoardView], Rigid3]:
    poses = poses_before(LENS, count, rng)
    return seen(LENS, BOARD, poses, rng, noise_px), robot_before(poses, rng, sigma, setup)


def calibrated(views, hands, board=BOARD, turns=(), **how) -> HandEyeCalibration:
    found = calibrate_hand_eye(board, views, hands, LENS, HandEyeConfig(**how), turns=turns)
    assert not isinstance(found, Rejected), found
    return found


def refused(views, hands, **how) -> Rejected:
    found = calibrate_hand_eye(BOARD, views, hands, LENS, HandEyeConfig(**how))
    assert isinstance(found, Rejected)
    return found


def errors_of(found: HandEyeCalibration) -> np.ndarray:
    """Turns about the camera's axes, then its place in the frame of the mount."""
    turn = (found.mount_from_cam.rotation.inverse() @ MOUNT_FROM_CAM.rotation).log()
    return np.append(turn, found.mount_from_cam.translation - MOUNT_FROM_CAM.translation)


# --- what is found ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("setup", ["eye_in_hand", "eye_to_hand"])
def test_without_noise_camera_and_board_are_where_they_are(setup, rng):
    found = calibrated(*scene(rng, noise_px=0.0, setup=setup), setup=setup)
    assert found.converged
    np.testing.assert_allclose(found.mount_from_cam.matrix, MOUNT_FROM_CAM.matrix, atol=1e-8)
    np.testing.assert_allclose(found.world_from_board.matrix, WORLD_FROM_BOARD.matrix, atol=1e-8)
    assert found.strict_rms_px < 1e-5


def test_the_closed_form_is_exact_without_noise(rng):
    poses = poses_before(LENS, 6, rng)
    mounts = robot_before(poses, rng).inverse()
    X, Z = closed_form(mounts, Rigid3.stack(poses))
    np.testing.assert_allclose(X.matrix, MOUNT_FROM_CAM.inverse().matrix, atol=1e-10)
    np.testing.assert_allclose(Z.matrix, WORLD_FROM_BOARD.matrix, atol=1e-10)


@pytest.mark.parametrize("setup", ["eye_in_hand", "eye_to_hand"])
def test_derivatives_are_numeric_ones(setup, rng):
    """The promised decrease of a small step and the real one agree only if gradient and normal matrix are right."""
    views, hands = scene(rng, count=6, noise_px=0.3, setup=setup)
    in_hand = setup == "eye_in_hand"
    mounts = hands.inverse() if in_hand else hands
    start = HandEyeEstimate(
        Rigid3.exp(1e-3 * rng.normal(size=6)) @ MOUNT_FROM_CAM.inverse(),
        Rigid3.exp(1e-3 * rng.normal(size=6)) @ WORLD_FROM_BOARD,
        Rigid3.exp(1e-4 * rng.normal(size=(6, 6))),
    )
    system = HandEyeSystem(gather(BOARD, views), LENS, BOARD, mounts, start, hand_is_mount=in_hand,
                           robot_information=np.full(6, 1e5))  # fmt: skip
    before, _ = system.linearize()
    for damping in (1e2, 1e3):
        trial = system.try_step(damping)
        assert trial is not None
        assert before - trial.cost == pytest.approx(trial.predicted_decrease, rel=0.02)


def test_predicted_deviations_are_those_of_repetitions():
    """Of the camera's place and of the robot, which is off by 0.06° and 0.3 mm."""
    sigma, errors, predicted, robots = (1e-3, 3e-4), [], [], []
    for seed in range(80):
        found = calibrated(*scene(np.random.default_rng(seed), sigma=sigma))
        errors.append(errors_of(found))
        predicted.append(np.append(found.sigma_rotation, found.sigma_position))
        robots.append(found.robot_sigma)
    errors, predicted = np.array(errors), np.array(predicted)
    assert np.mean(np.abs(errors) < 3 * predicted) > 0.985
    ratios = np.sqrt(np.mean(predicted**2, axis=0) / np.mean(errors**2, axis=0))
    assert np.all((ratios > 0.75) & (ratios < 1.3))  # 80 repetitions know a deviation to 8 %
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(robots), axis=0)), sigma, rtol=0.1)


def test_an_exact_robot_is_found_to_be_exact(rng):
    found = calibrated(*scene(rng, count=20))
    assert found.robot_sigma[0] < 2e-5
    assert found.robot_sigma[1] < 2e-5
    assert found.strict_rms_px == pytest.approx(found.rms_px, rel=0.05)


def test_the_robot_s_error_may_be_given(rng):
    views, hands = scene(rng, sigma=(1e-3, 3e-4))
    assert calibrated(views, hands, robot_sigma=(2e-3, 1e-3)).robot_sigma == pytest.approx((2e-3, 1e-3))


def test_a_pose_that_belongs_to_another_photo_is_left_out(rng):
    views, hands = scene(rng, count=16, sigma=(1e-3, 3e-4))
    order = np.arange(16)
    order[[3, 9]] = 9, 3
    found = calibrated(views, hands[order])
    assert {view.name for view in found.rejected} == {"view03", "view09"}
    assert np.all(np.abs(errors_of(found)) < 0.003)


def test_boards_that_were_read_from_the_other_end_are_turned(rng):
    even = chessboard(8, 6, 0.03)
    board = np.asarray(even.points3D)
    middle = Rigid3(Rotation3.identity(), -board.mean(0))
    poses = [pose @ middle for pose in poses_before(LENS, 12, rng)]
    views = seen(LENS, board, poses, rng)
    wrong = [1, 4, 5]
    for k in wrong:
        views[k] = dataclasses.replace(views[k], corner_ids=47 - views[k].corner_ids)
    found = calibrated(views, robot_before(poses, rng), board=board, turns=board_turns(even))
    assert found.turned == tuple(f"view{k:02d}" for k in wrong)
    assert np.all(np.abs(errors_of(found)) < 0.001)


def test_few_poses_are_told(rng):
    assert "5 poses only" in calibrated(*scene(rng, count=5)).fallbacks[0]


# --- what is refused ----------------------------------------------------------------------------------------------


def turned_by(turns, rng) -> tuple[list[BoardView], Rigid3]:
    first = Rigid3(Rotation3.exp(np.array([0.3, 0.1, 0.0])), np.array([0.0, 0.0, 0.6]))
    poses = [
        Rigid3(Rotation3.exp(np.array(turn)) @ first.rotation, np.append(rng.uniform(-0.06, 0.06, 2), 0.6))
        for turn in turns
    ]
    return seen(LENS, BOARD, poses, rng), robot_before(poses, rng)


def test_a_robot_that_turns_about_one_axis_is_refused(rng):
    reason = refused(*turned_by([(0.0, 0.0, a) for a in np.linspace(-0.8, 0.8, 10)], rng))
    assert reason.reason == "one_axis"
    assert "about one axis only" in reason.detail


def test_a_robot_that_does_not_turn_is_refused(rng):
    assert refused(*turned_by([(0.0, 0.0, 0.0)] * 8, rng)).reason == "no_rotation"


def test_too_few_poses_are_refused(rng):
    reason = refused(*scene(rng, count=3))
    assert (reason.reason, reason.detail) == ("too_few_poses", "3 of 4 needed")


def test_quaternions_in_another_order_are_told(rng):
    views, hands = scene(rng)
    xyzw = Rotation3(np.roll(hands.rotation.wxyz, -1, axis=1))
    reason = refused(views, Rigid3(xyzw, hands.translation))
    assert reason.reason == "quaternion_order"


def test_millimetres_are_told(rng):
    views, hands = scene(rng)
    reason = refused(views, Rigid3(hands.rotation, 1000 * hands.translation))
    assert reason.reason == "other_unit"
    assert "multiplied by 0.001" in reason.detail


def test_poses_of_other_photos_are_told(rng):
    views, hands = scene(rng)
    assert refused(views, hands[rng.permutation(15)]).reason == "motions_disagree"


def test_mistakes_of_the_caller_are_told(rng):
    views, hands = scene(rng, count=5)
    with pytest.raises(ValueError, match="5 views with poses of shape"):
        calibrate_hand_eye(BOARD, views, hands[:4], LENS)
    with pytest.raises(ValueError, match="two views have one name"):
        calibrate_hand_eye(BOARD, [*views[:4], views[0]], hands, LENS)


def test_orientations_about_one_axis_have_no_spread_about_others(rng):
    axis = np.array([0.3, -0.2, 0.9])
    spread = axis_spread(Rotation3.exp(rng.uniform(-1, 1, (20, 1)) * axis))
    assert spread[0] > 0.3
    assert spread[1] < 1e-7


def test_inverse_poses_are_told(rng):
    views, hands = scene(rng)
    assert refused(views, hands.inverse()).reason == "inverse_poses"
    assert refused(views, hands, setup="eye_to_hand").reason == "inverse_poses"
