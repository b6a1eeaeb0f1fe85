"""The joint problem of a rig: derivatives, elimination, covariance."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.refine_board import board_shape
from calib.refine_views import gather
from calib.rig import RigCalibration, RigConfig, calibrate_rig
from calib.rig_system import RigEstimate, RigSystem
from calib.rig_uncertainty import hold_out_frames, relative_uncertainty, rig_covariance
from calib.rig_views import RigObservations
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.calib.boards_in_space import flat_board, with_corners
from tests.calib.rigs_in_space import BESIDE, PAIR, THREE, photographed, poses_before_rig

BOARD = flat_board(5, 4, 0.05)
COLUMNS = [np.array([0, 1, 2, 3, 4]), np.array([0, 1, 2, 3]), np.array([0, 1, 4])]


def problem(rng, frames=3, **how):
    """Three cameras that do not all see every frame, somewhere off the minimum, with a board that bends."""
    poses = poses_before_rig(frames, rng)
    seen = photographed(*THREE, BOARD, poses, rng, 0.5, least=4)
    cameras, frame_of = [], []
    for c, one in enumerate(seen):
        kept = [k for k, frame in enumerate(one.frames) if int(frame) != c]
        cameras.append(gather(BOARD, [one.views[k] for k in kept]))
        frame_of.append(np.array([int(one.frames[k]) for k in kept]))
    shape = board_shape("paraboloid", BOARD)
    observations = RigObservations(tuple("abcdef"[:frames]), tuple(cameras), tuple(frame_of))
    estimate = RigEstimate(
        THREE[0],
        np.stack([mount.rotation.matrix for mount in THREE[1]]),
        np.stack([mount.translation for mount in THREE[1]]),
        np.stack([pose.rotation.matrix for pose in poses]),
        np.stack([pose.translation for pose in poses]),
        shape,
    )
    return RigSystem(observations, estimate, COLUMNS, free_shape=True, **how), observations, estimate


def moved(estimate: RigEstimate, system: RigSystem, by_frame, by_shared, columns_of=COLUMNS) -> RigEstimate:
    """Another estimate, by the book: rigid motions on the left."""

    def turned(R, t, step):
        E = Rotation3.exp(step[:3]).matrix
        return E @ R, E @ t + step[3:]

    mounts = [
        turned(R, t, by_shared[at] if at.stop > at.start else np.zeros(6))
        for R, t, at in zip(estimate.mount_rotations, estimate.mount_translations, system.mount_slices, strict=True)
    ]
    frames = [turned(R, t, step) for R, t, step in zip(
        estimate.frame_rotations, estimate.frame_translations, by_frame, strict=True)]  # fmt: skip
    cameras = []
    for camera, columns, at in zip(estimate.cameras, columns_of, system.param_slices, strict=True):
        params = camera.params.copy()
        params[columns] += by_shared[at]
        cameras.append(camera.with_params(params))
    coefficients = estimate.shape.coefficients + by_shared[system.param_slices[-1].stop :]
    (mount_R, mount_t), (frame_R, frame_t) = (
        tuple(map(np.stack, zip(*part, strict=True))) for part in (mounts, frames)
    )
    shape = dataclasses.replace(estimate.shape, coefficients=coefficients)
    return RigEstimate(tuple(cameras), mount_R, mount_t, frame_R, frame_t, shape)


def residuals_of(observations: RigObservations, estimate: RigEstimate) -> np.ndarray:
    """By the book, with the public functions of cameras."""
    out = []
    points = estimate.shape.points3D
    for c, (o, frames) in enumerate(zip(observations.cameras, observations.frame_of, strict=True)):
        f = frames[o.view_of]
        in_rig = np.einsum("nij,nj->ni", estimate.frame_rotations[f], points[o.rows]) + estimate.frame_translations[f]
        in_cam = in_rig @ estimate.mount_rotations[c].T + estimate.mount_translations[c]
        out.append(estimate.cameras[c].project(in_cam)[0] - o.points2D)
    return np.concatenate(out).ravel()


def jacobian(system: RigSystem, observations: RigObservations, estimate: RigEstimate) -> np.ndarray:
    """Central differences by frames, then by what they share."""
    frames, columns = len(observations.frames), []
    for k in range(6 * frames + system.shared_count):
        ends = []
        for sign in (1, -1):
            step = np.zeros(6 * frames + system.shared_count)
            step[k] = sign * 1e-6
            ends.append(residuals_of(observations, moved(
                estimate, system, step[: 6 * frames].reshape(frames, 6), step[6 * frames :])))  # fmt: skip
        columns.append((ends[0] - ends[1]) / 2e-6)
    return np.stack(columns, 1)


def test_residuals_and_cost_are_those_by_the_book(rng):
    system, observations, estimate = problem(rng)
    expected = residuals_of(observations, estimate)
    np.testing.assert_allclose(np.concatenate([r.ravel() for r in system.residuals()]), expected, atol=1e-10)
    assert system.linearize()[0] == pytest.approx(0.5 * expected @ expected, rel=1e-12)


def test_normal_equations_are_those_of_numeric_derivatives(rng):
    system, observations, estimate = problem(rng)
    J, r = jacobian(system, observations, estimate), residuals_of(observations, estimate)
    frames, K = 6 * len(observations.frames), system.shared_count
    H, g = J.T @ J, J.T @ r
    got = system.normal_equations()
    whole = np.zeros((frames + K, frames + K))
    for f in range(len(observations.frames)):
        part = slice(6 * f, 6 * f + 6)
        whole[part, part], whole[part, frames:] = got.H[f], got.W[f][:, :K]
        whole[frames:, part] = got.W[f][:, :K].T
    whole[frames:, frames:] = got.A[:K, :K]
    scale = np.sqrt(np.diag(H))
    np.testing.assert_allclose(whole / np.outer(scale, scale), H / np.outer(scale, scale), atol=1e-6)
    gradient = np.concatenate([got.W[:, :, K].ravel(), got.A[:K, K]])
    np.testing.assert_allclose(gradient / scale, g / scale, atol=1e-5 * float(np.linalg.norm(r)))


def test_a_step_solves_the_whole_system(rng):
    system, observations, estimate = problem(rng, frames=4)
    J, r = jacobian(system, observations, estimate), residuals_of(observations, estimate)
    system.linearize()
    trial = system.try_step(0.1)
    assert trial is not None
    H = J.T @ J
    step = -np.linalg.solve(H + 0.1 * np.diag(np.diag(H)), J.T @ r)
    frames = 6 * len(observations.frames)
    expected = residuals_of(observations, moved(
        estimate, system, step[:frames].reshape(-1, 6), step[frames:]))  # fmt: skip
    assert trial.cost == pytest.approx(0.5 * expected @ expected, rel=1e-5)
    promised = -(step @ J.T @ r + 0.5 * step @ H @ step)
    assert trial.predicted_decrease == pytest.approx(promised, rel=1e-4)


def test_the_inverse_of_what_is_shared_is_a_block_of_the_whole_inverse(rng):
    system, observations, estimate = problem(rng, frames=5)
    J = jacobian(system, observations, estimate)
    inverse = np.linalg.inv(J.T @ J)[30:, 30:]
    got = system.shared_inverse()
    assert got is not None
    scale = np.sqrt(np.diag(inverse))
    np.testing.assert_allclose(got / np.outer(scale, scale), inverse / np.outer(scale, scale), atol=1e-3)


def test_frames_that_leave_something_open_have_no_inverse(rng):
    system, observations, estimate = problem(rng)
    lonely = [np.flatnonzero(observations.frame_of[0] >= 0).tolist(), [0], []]
    some, left = observations.of_views(lonely)
    bare = RigSystem(some, estimate.of_frames(left), COLUMNS)
    assert bare.shared_inverse() is None
    assert bare.newton_decrement() == np.inf
    assert system.shared_inverse() is not None


# --- uncertainty --------------------------------------------------------------------------------------------------


def test_predicted_deviations_are_those_of_repetitions():
    errors, sigmas, careful = [], [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        found = calibrate_rig(BOARD, photographed(*PAIR, BOARD, poses_before_rig(14, rng), rng, 0.1, least=6),
                              RigConfig(reject=False))  # fmt: skip
        assert isinstance(found, RigCalibration)
        known, by_frame = rig_covariance(found), rig_covariance(found, by_frame=True)
        assert not isinstance(known, Rejected)
        assert not isinstance(by_frame, Rejected)
        relative = relative_uncertainty(found, known, 0, 1)
        error = (relative.cam2_from_cam1 @ BESIDE.inverse()).log()
        errors.append([*error, relative.baseline - np.linalg.norm(BESIDE.translation), *(
            found.cams_from_rig[1].translation - BESIDE.translation)])  # fmt: skip
        sigmas.append([*np.sqrt(np.diag(relative.covariance)), relative.sigma_baseline, *relative.sigma_translation])
        careful.append(relative_uncertainty(found, by_frame, 0, 1).sigma_baseline)
    errors, sigmas = np.array(errors), np.array(sigmas)
    assert np.mean(np.abs(errors) < 3 * sigmas) > 0.99
    ratios = np.sqrt(np.mean(sigmas**2, axis=0) / np.mean(errors**2, axis=0))
    assert 0.9 < np.median(ratios) < 1.1
    assert np.all((ratios > 0.75) & (ratios < 1.35))  # 60 repetitions know a deviation to 9 %
    assert np.sqrt(np.mean(np.square(careful)) / np.mean(sigmas[:, 6] ** 2)) == pytest.approx(1, abs=0.35)


def test_the_pose_between_two_other_cameras_has_its_own_uncertainty(rng):
    found = calibrate_rig(
        BOARD, photographed(*THREE, BOARD, poses_before_rig(12, rng), rng, 0.1), RigConfig(reject=False)
    )
    assert isinstance(found, RigCalibration)
    known = rig_covariance(found)
    assert not isinstance(known, Rejected)
    draws = rng.multivariate_normal(np.zeros(12), known.shared[:12, :12], 4000)
    one, two = found.cams_from_rig[1], found.cams_from_rig[2]
    exact = two @ one.inverse()
    apart = [((Rigid3.exp(d[6:]) @ two) @ (Rigid3.exp(d[:6]) @ one).inverse() @ exact.inverse()).log() for d in draws]
    relative = relative_uncertainty(found, known, 1, 2)
    np.testing.assert_allclose(np.std(apart, axis=0), np.sqrt(np.diag(relative.covariance)), rtol=0.06)
    back = relative_uncertainty(found, known, 2, 1)
    assert back.sigma_baseline == pytest.approx(relative.sigma_baseline, rel=1e-9)


def test_frames_that_were_held_out_err_a_little_more(rng):
    found = calibrate_rig(BOARD, photographed(*PAIR, BOARD, poses_before_rig(16, rng), rng, 0.1, least=6),
                          RigConfig(reject=False))  # fmt: skip
    assert isinstance(found, RigCalibration)
    held = hold_out_frames(found, rng=rng)
    assert not isinstance(held, Rejected)
    assert 1.0 < held.rms_px / held.training_rms_px < 1.15
    assert len(held.squares) == len(held.frames) == 16


def test_deviations_hold_where_corners_are_unlike():
    """Corners at the border of the board, which say most of a rig, err three times as much as the others."""
    rng, board = np.random.default_rng(3), flat_board(8, 6, 0.03)
    exact = photographed(*PAIR, board, poses_before_rig(10, rng), rng, 0.0, least=6)
    noise = np.where((np.abs(board[:, :2]) >= np.abs(board[:, :2]).max(0)).any(axis=1), 0.15, 0.05)[:, None]
    errors, by_corner, alike = [], [], []
    for _ in range(60):
        noisy = [dataclasses.replace(one, views=tuple(
            with_corners(v, v.points2D + noise[v.corner_ids] * rng.normal(size=v.points2D.shape)) for v in one.views
        ), camera=camera) for one, camera in zip(exact, PAIR[0], strict=True)]  # fmt: skip
        found = calibrate_rig(board, noisy, RigConfig(reject=False, refine_known=True))
        assert isinstance(found, RigCalibration)
        apart = (found.cams_from_rig[1] @ BESIDE.inverse()).log()
        params = [one.params - camera.params for one, camera in zip(found.cameras, PAIR[0], strict=True)]
        errors.append(np.concatenate([apart, *params]))
        for told, how in ((by_corner, False), (alike, True)):
            known = rig_covariance(found, alike=how)
            assert not isinstance(known, Rejected)
            told.append(np.diag(known.shared))
    true = np.mean(np.square(errors), axis=0)
    # 60 trials know a deviation to 9 %, and several of them better.
    assert np.mean(np.sqrt(np.mean(by_corner, axis=0) / true)) == pytest.approx(1.0, abs=0.12)
    assert np.mean(np.sqrt(np.mean(alike, axis=0) / np.mean(by_corner, axis=0))) < 0.9


def test_scores_of_corners_are_those_of_the_whole_jacobian(rng):
    """Three cameras that do not all see every frame, two of a board's shape, and all in one dense matrix."""
    seen = photographed(*THREE, BOARD, poses_before_rig(9, rng), rng, 0.1, least=8)
    found = calibrate_rig(BOARD, seen, RigConfig(reject=False, shape="paraboloid", weigh_cameras=False))
    assert isinstance(found, RigCalibration)
    system, frames = found.system(), 6 * len(found.observations.frames)
    J = dense_jacobian(found, system)
    r = residuals_of(found.observations, found.estimate)
    scale = np.sqrt(np.sum(J**2, axis=0))
    inverse = np.linalg.inv(J.T @ J / np.outer(scale, scale)) / np.outer(scale, scale)
    meat = np.zeros_like(inverse)
    for n in range(len(r) // 2):
        part = J[2 * n : 2 * n + 2]
        values, vectors = np.linalg.eigh(np.eye(2) - part @ inverse @ part.T)
        score = part.T @ (vectors / np.sqrt(values)) @ vectors.T @ r[2 * n : 2 * n + 2]
        meat += np.outer(score, score)
    expected = (inverse @ meat @ inverse)[frames:, frames:]
    known = rig_covariance(found)
    assert not isinstance(known, Rejected)
    deviations = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(known.shared / np.outer(deviations, deviations), expected / np.outer(
        deviations, deviations), atol=2e-3)  # fmt: skip


def dense_jacobian(found: RigCalibration, system: RigSystem) -> np.ndarray:
    """Central differences by frames, then by what they share."""
    frames, columns = len(found.observations.frames), []
    curvature = np.sqrt(np.diag(system.normal_equations().A))[:-1]
    for k in range(6 * frames + system.shared_count):
        size = 1e-6 if k < 6 * frames else 1e-3 / max(curvature[k - 6 * frames], 1e-3)
        ends = []
        for sign in (1, -1):
            step = np.zeros(6 * frames + system.shared_count)
            step[k] = sign * size
            ends.append(residuals_of(found.observations, moved(
                found.estimate, system, step[: 6 * frames].reshape(frames, 6), step[6 * frames :], found.columns
            )))  # fmt: skip
        columns.append((ends[0] - ends[1]) / (2 * size))
    return np.stack(columns, 1)
