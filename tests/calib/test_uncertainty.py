"""Predicted uncertainty against trials, against OpenCV's figures, and what it says of images and lenses."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from calib.refine import CalibrationConfig, calibrate
from calib.uncertainty import (
    covariance,
    pixel_grid,
    projection_covariances,
    projection_difference,
    uncertainty_map,
    worst_deviations,
)
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from tests.calib.boards_in_space import FISHEYE, LENS, flat_board, poses_before, seen, with_corners

BOARD = flat_board()
CONFIG = CalibrationConfig(lens="opencv4", reject=False)
TRIALS = 200


def calibrated(views, config=CONFIG):
    found = calibrate(BOARD, views, config)
    assert not isinstance(found, Rejected), found
    return found


def covered(found, **how):
    covariances = covariance(found, **how)
    assert not isinstance(covariances, Rejected), covariances
    return covariances


@pytest.fixture(scope="module")
def trials():
    """One set of views with many draws of noise: calibrations and their covariances."""
    rng = np.random.default_rng(5)
    poses = poses_before(LENS, 10, rng)
    exact = seen(LENS, BOARD, poses, rng, 0.0)
    found = []
    for _ in range(TRIALS):
        noisy = [with_corners(v, v.points2D + 0.1 * rng.normal(size=v.points2D.shape)) for v in exact]
        one = calibrated(noisy)
        found.append((one, covered(one)))
    return poses, found


def test_the_truth_is_within_three_sigma_of_nearly_all_trials(trials):
    _, found = trials
    off = np.array([(one.camera.params - LENS.params) / list(c.deviations.values()) for one, c in found])
    assert np.mean(np.abs(off) < 3) >= 0.99
    # Altogether, too: squared Mahalanobis distances of 8 parameters have mean 8.
    squares = [
        (one.camera.params - LENS.params) @ np.linalg.solve(c.shared, one.camera.params - LENS.params)
        for one, c in found
    ]
    assert np.mean(squares) == pytest.approx(8, rel=0.15)


def test_predicted_deviations_are_those_of_trials(trials):
    _, found = trials
    empirical = np.std([one.camera.params for one, _ in found], axis=0)
    predicted = np.sqrt(np.mean([list(np.diag(c.shared)) for _, c in found], axis=0))
    # 200 trials know a deviation to 5 %, of which eight correlated ones are taken together.
    assert np.all((predicted / empirical > 0.85) & (predicted / empirical < 1.15))
    assert np.mean(predicted / empirical) == pytest.approx(1.0, abs=0.08)


def test_predicted_deviations_of_poses_are_those_of_trials(trials):
    poses, found = trials
    truth = Rigid3.stack(poses)
    steps = np.array([(one.cams_from_board @ truth.inverse()).log() for one, _ in found])
    predicted = np.sqrt(np.mean([np.diagonal(c.poses, axis1=1, axis2=2) for _, c in found], axis=0))
    ratios = predicted / np.sqrt(np.mean(steps**2, axis=0))
    assert np.median(ratios) == pytest.approx(1.0, abs=0.1)
    assert np.all((ratios > 0.8) & (ratios < 1.25))


@pytest.mark.parametrize("distance", [np.inf, 0.5])
def test_the_predicted_movement_of_pixels_is_that_of_trials(trials, distance):
    """Against the same points of the boards' frames, carried by each trial's own poses as information weighs them."""
    poses, found = trials
    pixels, _ = pixel_grid(LENS, 8)
    rays, _ = LENS.unproject(pixels)
    truth = Rigid3.stack(poses)
    moved = []
    for one, _ in found:
        blocks = one.system().blocks
        H = np.tril(blocks[:, :6, :6]) + np.tril(blocks[:, :6, :6], -1).swapaxes(1, 2)
        steps = (one.cams_from_board @ truth.inverse()).log()
        motion = Rigid3.exp(np.linalg.solve(H.sum(0), np.einsum("vij,vj->i", H, steps)))
        points = motion.rotation @ rays if np.isinf(distance) else motion @ (distance * rays)
        moved.append(one.camera.project(points)[0] - pixels)
    empirical = np.sqrt(np.mean(np.square(moved), axis=0))
    one, c = found[0]
    predicted = np.sqrt(np.diagonal(projection_covariances(one, c, pixels, distance), axis1=1, axis2=2))
    ratios = predicted / empirical
    assert np.median(ratios) == pytest.approx(1.0, abs=0.1)
    assert np.all((ratios > 0.75) & (ratios < 1.3))


def test_deviations_are_those_of_opencv(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 12, rng), rng)
    found = calibrated(views, CalibrationConfig(lens="opencv5", reject=False))
    theirs = cv2.calibrateCameraExtended(
        [BOARD[view.corner_ids].astype(np.float32) for view in views],
        [(view.points2D - 0.5).astype(np.float32).reshape(-1, 1, 2) for view in views],
        (1280, 960), np.eye(3), np.zeros(5), flags=0,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-12),
    )  # fmt: skip
    deviations = list(covered(found, alike=True).deviations.values())
    np.testing.assert_allclose(deviations, theirs[5].ravel()[:9], rtol=1e-3)


def test_deviations_hold_where_corners_are_unlike():
    """Corners at the border of the board, which say most of the camera, err three times as much as the others."""
    rng = np.random.default_rng(11)
    exact = seen(LENS, BOARD, poses_before(LENS, 10, rng), rng, 0.0)
    outer = (BOARD[:, :2] == BOARD[:, :2].min(0)) | (BOARD[:, :2] == BOARD[:, :2].max(0))
    noise = np.where(outer.any(axis=1), 0.15, 0.05)[:, None]
    errors, by_corner, alike = [], [], []
    for _ in range(100):
        noisy = [with_corners(v, v.points2D + noise[v.corner_ids] * rng.normal(size=v.points2D.shape)) for v in exact]
        found = calibrated(noisy)
        errors.append(found.camera.params - LENS.params)
        by_corner.append(np.diag(covered(found).shared))
        alike.append(np.diag(covered(found, alike=True).shared))
    true = np.mean(np.square(errors), axis=0)
    # 100 trials know a deviation to 7 %.
    assert np.mean(np.sqrt(np.mean(by_corner, axis=0) / true)) == pytest.approx(1.0, abs=0.12)
    assert np.mean(np.sqrt(np.mean(alike, axis=0) / np.mean(by_corner, axis=0))) < 0.9


def test_scores_of_corners_are_those_of_the_whole_jacobian(rng):
    """With a board that is bent, corners of unlike covariances, and all poses in one dense matrix."""
    views = [
        dataclasses.replace(
            v, covariances=np.array([np.diag([0.01, 0.02]) * (1 + k % 3) for k in range(len(v.points2D))])
        )
        for v in seen(LENS, BOARD, poses_before(LENS, 6, rng), rng)
    ]
    found = calibrated(views, dataclasses.replace(CONFIG, shape="paraboloid"))
    J, r = dense_jacobian(found)
    inverse = np.linalg.inv(J.T @ J)
    meat = np.zeros_like(inverse)
    for n in range(len(r) // 2):
        part = J[2 * n : 2 * n + 2]
        values, vectors = np.linalg.eigh(np.eye(2) - part @ inverse @ part.T)
        score = part.T @ (vectors / np.sqrt(values)) @ vectors.T @ r[2 * n : 2 * n + 2]
        meat += np.outer(score, score)
    count = len(covered(found).names)
    expected = (inverse @ meat @ inverse)[:count, :count]
    np.testing.assert_allclose(covered(found).shared, expected, rtol=1e-3, atol=1e-4 * np.sqrt(
        np.outer(np.diag(expected), np.diag(expected))
    ).max() * 1e-3)  # fmt: skip


def dense_jacobian(found):
    """Numeric derivatives of all whitened residuals by camera, shape and poses, and the residuals."""
    shape, poses, observations = found.shape, found.cams_from_board, found.observations
    a, b, c = observations.roots.T

    def residuals(delta):
        camera = found.camera.with_params(found.camera.params + delta[:8])
        moved = dataclasses.replace(shape, coefficients=shape.coefficients + delta[8:-36])
        board = observations.board + moved.displacements
        out = []
        for v, step in enumerate(delta[-36:].reshape(6, 6)):
            at = observations.rows[observations.offsets[v] : observations.offsets[v + 1]]
            out.append(camera.project((Rigid3.exp(step) @ poses[v]) @ board[at])[0])
        du, dv = (np.concatenate(out) - observations.points2D).T
        return np.column_stack([a * du + b * dv, c * dv]).ravel()

    steps = np.concatenate(
        [found.camera.params * 1e-6 + 1e-8, np.full(len(shape.coefficients), 1e-7), np.full(36, 1e-6)]
    )
    J = np.column_stack(
        [(residuals(step) - residuals(-step)) / (2 * steps[k]) for k, step in enumerate(np.diag(steps))]
    )
    return J, residuals(np.zeros(len(steps)))


def test_deviations_hold_where_errors_have_heavy_tails_and_the_worst_are_rejected(rng):
    exact, errors, variances = seen(LENS, BOARD, poses_before(LENS, 8, rng), rng, 0.0), [], []
    for _ in range(80):
        noisy = [with_corners(v, v.points2D + 0.05 * rng.standard_t(3, v.points2D.shape)) for v in exact]
        found = calibrated(noisy, dataclasses.replace(CONFIG, reject=True))
        errors.append(found.camera.params - LENS.params)
        variances.append(np.diag(covered(found).shared))
    ratio = np.sqrt(np.mean(variances, axis=0) / np.mean(np.square(errors), axis=0))
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.12)


def test_a_corner_that_is_rejected_leaves_deviations_as_they_were_in_photos_of_unlike_sharpness(rng):
    exact = seen(LENS, BOARD, poses_before(LENS, 12, rng), rng, 0.0)
    noisy = [with_corners(v, v.points2D + (0.3 if k < 4 else 0.1) * rng.normal(size=v.points2D.shape))
             for k, v in enumerate(exact)]  # fmt: skip
    off = noisy[7].points2D.copy()
    off[5] += [6.0, 5.0]
    config = dataclasses.replace(CONFIG, reject=True)
    found = calibrated([*noisy[:7], with_corners(noisy[7], off), *noisy[8:]], config)
    assert len(found.rejected_corners) == 1
    without, as_it_was = covered(found).deviations, covered(calibrated(noisy, config)).deviations
    np.testing.assert_allclose(list(without.values()), list(as_it_was.values()), rtol=0.04)


def test_leaving_out_views_agrees_where_views_are_alike_and_many():
    rng = np.random.default_rng(3)
    found = calibrated(seen(LENS, BOARD, poses_before(LENS, 120, rng), rng))
    ratios = np.array(list(covered(found, by_view=True).deviations.values())) / list(covered(found).deviations.values())
    assert np.all((ratios > 0.7) & (ratios < 1.4))


def test_leaving_out_views_sees_errors_that_views_share_within(rng):
    """Corners of a view are all wrong alike, by a stretch: the views are independent, the corners are not."""
    views = [
        with_corners(v, v.points2D * (1 + 0.002 * rng.normal(size=2)))
        for v in seen(LENS, BOARD, poses_before(LENS, 30, rng), rng)
    ]
    found = calibrated(views)
    plain, by_view = covered(found), covered(found, by_view=True)
    assert by_view.deviations["fx"] > 1.5 * plain.deviations["fx"]


def test_the_step_without_a_view_is_the_calibration_without_it(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 20, rng), rng)
    found = calibrated(views)
    from calib.uncertainty import _parts

    parts = _parts(found)
    step = np.linalg.solve(parts.reduced.sum(0) - parts.reduced[3], parts.scores[3])
    actual = calibrated(views[:3] + views[4:]).camera.params - found.camera.params
    np.testing.assert_allclose(step, actual, rtol=0.1, atol=0.05 * np.sqrt(np.diag(covered(found).shared)).max() * 1e-2)


def test_the_map_is_least_where_boards_were(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 15, rng, reach=0.05), rng)
    found = calibrated(views)
    deviations, pixels = uncertainty_map(found, covered(found), across=16)
    assert deviations.shape == (12, 16)
    assert len(pixels) == 192
    assert deviations[5:7, 7:9].max() < 0.2 * deviations[0, 0]


def test_pixels_without_a_ray_have_no_uncertainty(rng):
    found = calibrated(
        seen(FISHEYE, BOARD, poses_before(FISHEYE, 15, rng), rng), CalibrationConfig(lens="fisheye", reject=False)
    )
    inside = projection_covariances(found, covered(found), np.array([[640.0, 480.0], [1e5, 1e5]]))
    assert np.isfinite(worst_deviations(inside))[0]
    assert np.isnan(inside[1]).all()


def test_worst_deviations_are_roots_of_largest_eigenvalues(rng):
    roots = rng.normal(size=(20, 2, 2))
    covariances = roots @ roots.swapaxes(1, 2)
    np.testing.assert_allclose(worst_deviations(covariances), np.sqrt(np.linalg.eigvalsh(covariances)[:, 1]))


def test_a_turned_camera_does_not_differ(rng):
    """A small turn about the axis is a shift of the frame; a longer lens is not."""
    pixels, _ = pixel_grid(LENS, 12)
    assert np.abs(projection_difference(LENS, LENS, pixels)).max() < 1e-9
    longer = dataclasses.replace(LENS, params=LENS.params * np.array([1.01, 1.01, 1, 1, 1, 1, 1, 1]))
    assert np.abs(projection_difference(LENS, longer, pixels)).max() > 3.0
    shifted = dataclasses.replace(LENS, params=LENS.params + np.array([0, 0, 2.0, 0, 0, 0, 0, 0]))
    aligned = np.abs(projection_difference(LENS, shifted, pixels)).max()
    assert aligned < 1.0
    assert np.abs(projection_difference(LENS, longer, pixels, 0.5)).max() < 3.0  # a step back, nearly


def test_parameters_that_views_leave_open_are_told(rng):
    found = calibrated(seen(LENS, BOARD, poses_before(LENS, 8, rng), rng))
    singular = dataclasses.replace(found, camera=found.camera.with_params(np.r_[LENS.params[:4], np.zeros(4)]))
    flat = dataclasses.replace(
        singular, observations=found.observations.of_views([]), cams_from_board=Rigid3.identity((0,))
    )
    result = covariance(flat)
    assert isinstance(result, Rejected)
    assert result.reason == "undetermined_parameters"
