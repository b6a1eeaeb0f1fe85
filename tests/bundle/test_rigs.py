"""Images that move together, and sensors that move on their rig."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, RigArrays, adjust, covariance
from sfm.bundle.adjustment import system_of
from sfm.bundle.knowledge import Knowledge
from sfm.bundle.layout import lay_out
from sfm.bundle.prior_terms import prior_residuals
from sfm.bundle.priors import DistancePrior, GravityPrior, PositionPrior
from sfm.core.cameras import Camera
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.bundle.conftest import PARAMS, looking_inwards

TIGHT = BundleConfig(relative_cost_tolerance=1e-13)
SENSORS, FRAMES = 3, 5


def build_rig(rng, noise_px=0.3, points=60, free_sensors=False, free_params=()):
    """Five moments of a rig of three sensors, at the truth."""
    camera = Camera("SIMPLE_RADIAL", 1000, 760, np.array(PARAMS["SIMPLE_RADIAL"]))
    frames = looking_inwards(FRAMES, rng)
    mounts = Rigid3.exp(np.concatenate([0.1 * rng.normal(size=(2, 3)), rng.uniform(0.3, 0.6, (2, 3))], axis=1))
    rigs = RigArrays(
        np.repeat(np.arange(FRAMES), SENSORS).astype(np.int32), np.tile([-1, 0, 1], FRAMES).astype(np.int32),
        frames, mounts, np.full(2, free_sensors),
    )  # fmt: skip
    poses, points3D = rigs.cams_from_world, rng.uniform(-1.5, 1.5, (points, 3))
    rows = np.argwhere(rng.random((points, len(poses))) < 0.7)
    points2D, valid = camera.project(poses[rows[:, 1]] @ points3D[rows[:, 0]])
    params, free = np.zeros((1, MAX_PARAMS)), np.zeros((1, MAX_PARAMS), bool)
    params[0, :4], free[0, list(free_params)] = camera.params, True
    return BundleProblem(
        model_ids=np.array([camera.model_info.model_id], np.int32),
        camera_params=params,
        image_cameras=np.zeros(len(poses), np.int32),
        cams_from_world=poses,
        points3D=points3D,
        obs_images=rows[valid, 1].astype(np.int32),
        obs_points=rows[valid, 0].astype(np.int32),
        obs_points2D=points2D[valid] + noise_px * rng.normal(size=(int(valid.sum()), 2)),
        free_params=free,
        free_poses=np.ones(len(poses), bool),
        free_points=np.ones(points, bool),
        rigs=rigs,
    )


def moved(problem, frames, sensors):
    """The problem after steps of the frames in world axes and of the sensors on the left."""
    rigs = rigs_of(problem)
    rotation = rigs.rigs_from_world.rotation @ Rotation3.exp(frames[:, :3])
    center = rigs.rigs_from_world.center - frames[:, 3:]
    turn = Rotation3.exp(sensors[:, :3])
    mounted = rigs.sensors_from_rig
    rigs = dataclasses.replace(
        rigs,
        rigs_from_world=Rigid3(rotation, -(rotation @ center)),
        sensors_from_rig=Rigid3(turn @ mounted.rotation, turn @ mounted.translation + sensors[:, 3:]),
    )
    return dataclasses.replace(problem, rigs=rigs, cams_from_world=rigs.cams_from_world)


def rigs_of(problem):
    assert problem.rigs is not None
    return problem.rigs


def disturbed(problem, rng, size=0.01):
    frames = size * rng.normal(size=(FRAMES, 6))
    sensors = size * rng.normal(size=(SENSORS - 1, 6)) * rigs_of(problem).free_sensors[:, None]
    points3D = problem.points3D + size * rng.normal(size=problem.points3D.shape)
    return dataclasses.replace(moved(problem, frames, sensors), points3D=points3D)


def test_the_gradient_agrees_with_differences(rng):
    problem = disturbed(build_rig(rng, free_sensors=True, free_params=(0, 3)), rng)
    system, _ = system_of(problem, BundleConfig(gauge="free"), 1)
    system.linearize()
    gradient = system.gradient
    assert len(gradient) == FRAMES + 1 + 2
    for row, entry in [(0, 1), (2, 0), (3, 4), (4, 5), (6, 0), (6, 2), (7, 3), (7, 5)]:
        costs = []
        for sign in (1, -1):
            step = np.zeros((FRAMES + 3, 6))
            step[row, entry] = sign * 1e-6
            near = moved(problem, step[:FRAMES], step[FRAMES + 1 :])
            costs.append(system_of(near, BundleConfig(), 1)[0].linearize()[0])
        assert (costs[0] - costs[1]) / 2e-6 == pytest.approx(gradient[row, entry], rel=1e-5, abs=1e-3)


@pytest.mark.parametrize("solver", ["dense", "sparse", "iterative"])
@pytest.mark.parametrize("free_sensors", [True, False])
def test_a_rig_finds_back_to_the_truth(rng, solver, free_sensors):
    truth = build_rig(rng, noise_px=0.0, free_sensors=free_sensors, free_params=(0,))
    result = adjust(disturbed(truth, rng), dataclasses.replace(TIGHT, solver=solver))
    assert result.final_cost < 1e-12
    found, expected = rigs_of(result.problem).sensors_from_rig, rigs_of(truth).sensors_from_rig
    if free_sensors:
        ratio = np.linalg.norm(found.translation[0]) / np.linalg.norm(expected.translation[0])
        np.testing.assert_allclose(found.translation, ratio * expected.translation, atol=1e-5)
    else:
        assert np.array_equal(found.matrix, expected.matrix)
        first, second = found_distance(result.problem), found_distance(truth)
        assert first == pytest.approx(second, rel=1e-6)  # the rig sets the scale
    composed = rigs_of(result.problem).cams_from_world
    np.testing.assert_allclose(result.problem.cams_from_world.matrix, composed.matrix, atol=1e-12)


def found_distance(problem):
    centers = rigs_of(problem).rigs_from_world.center
    return np.linalg.norm(centers[0] - centers[-1])


def test_the_minimum_does_not_depend_on_threads(rng):
    start = disturbed(build_rig(rng, free_sensors=True, points=400), rng)
    first, second = adjust(start, threads=1), adjust(start, threads=3)
    assert first.table == second.table
    assert np.array_equal(first.problem.points3D, second.problem.points3D)


def test_a_moment_with_a_constant_image_does_not_move(rng):
    start = disturbed(build_rig(rng), rng)
    free = np.ones(FRAMES * SENSORS, bool)
    free[4] = False
    found = adjust(dataclasses.replace(start, free_poses=free)).problem
    frames, before = rigs_of(found).rigs_from_world, rigs_of(start).rigs_from_world
    assert np.array_equal(frames[1].matrix, before[1].matrix)
    assert np.abs(frames[2].matrix - before[2].matrix).max() > 1e-5


def test_covariances_of_a_rig_are_those_of_repeated_adjustments(rng):
    truth, noise = build_rig(rng, noise_px=0.0, free_sensors=True, points=50), 0.3
    sigmas = np.full(len(truth.obs_images), noise)
    predicted = covariance(dataclasses.replace(truth, obs_sigmas=sigmas))
    assert isinstance(predicted, BundleCovariance)
    tangents = []
    for _ in range(200):
        measured = truth.obs_points2D + noise * rng.normal(size=truth.obs_points2D.shape)
        found = adjust(dataclasses.replace(truth, obs_points2D=measured)).problem
        tangents.append((found.cams_from_world @ truth.cams_from_world.inverse()).log())
    expected = np.einsum("iaa->ia", predicted.poses)
    free = expected > 1e-6 * expected.max()
    ratio = np.sqrt(np.mean(np.square(tangents), axis=0)[free] / expected[free])
    assert 0.9 < np.median(ratio) < 1.1
    free_gauge = covariance(dataclasses.replace(truth, obs_sigmas=sigmas), BundleConfig(gauge="free"))
    assert isinstance(free_gauge, BundleCovariance)
    assert np.trace(free_gauge.centers, axis1=1, axis2=2).sum() < np.trace(predicted.centers, axis1=1, axis2=2).sum()


def test_a_sensor_that_nothing_determines_is_named(rng):
    problem = build_rig(rng, free_sensors=True)
    sensor = rigs_of(problem).image_sensors[problem.obs_images]
    few = (sensor != 1) | ((problem.obs_points < 2) & (problem.obs_images == 2))
    found = covariance(
        dataclasses.replace(
            problem,
            obs_images=problem.obs_images[few],
            obs_points=problem.obs_points[few],
            obs_points2D=problem.obs_points2D[few],
        )
    )
    assert isinstance(found, Rejected)
    assert (found.reason, found.detail) == ("undetermined_sensor", "1")


def test_poses_that_are_not_those_of_the_rig_are_refused(rng):
    problem = build_rig(rng)
    poses = Rigid3(problem.cams_from_world.rotation, problem.cams_from_world.translation + 0.1)
    with pytest.raises(ValueError, match="rigs"):
        dataclasses.replace(problem, cams_from_world=poses)


def priors_of(problem, rng):
    """Positions with a bias, gravity, distances: within a rig, by one sensor at two moments, and across."""
    poses, down = problem.cams_from_world, np.array([0.0, 1.0, 0.0])
    images = np.arange(len(problem.free_poses), dtype=np.int32)
    sensors, frames = rigs_of(problem).image_sensors, rigs_of(problem).image_frames
    same_sensor, same_rig = np.flatnonzero(sensors == 1)[:2], np.flatnonzero(frames == 2)[:2]
    across = np.array([np.flatnonzero(sensors == 0)[0], np.flatnonzero(sensors == 1)[3]])
    first, second = (np.array([pair[k] for pair in (same_sensor, same_rig, across)], np.int32) for k in (0, 1))
    centers = poses.center + 0.05 * rng.normal(size=(len(images), 3))
    return (
        PositionPrior.of_sigmas(images, centers, 0.1, bias_sigma=0.5),
        GravityPrior(images[::2], poses[images[::2]].rotation @ down, np.full(len(images[::2]), 0.02), down),
        DistancePrior(first, second, np.array([0.5, 1.0, 2.0]), np.array([0.1, 0.2, 0.1])),
    )


def prior_residuals_of(problem, bias):
    poses = problem.cams_from_world
    found = [prior_residuals(prior, poses.rotation.matrix, poses.center, bias * isinstance(prior, PositionPrior))
             for prior in problem.pose_priors]  # fmt: skip
    return np.concatenate([*found, [bias / 0.5]]).ravel()


def test_priors_move_sensors_and_rigs_by_their_derivatives(rng):
    problem = disturbed(build_rig(rng, free_sensors=True), rng)
    problem = dataclasses.replace(problem, priors=priors_of(problem, rng))
    rows, bias = FRAMES + SENSORS, rng.normal(size=3)
    numeric = np.empty((len(prior_residuals_of(problem, bias)), 6 * rows))
    for column in range(6 * rows):
        ends = []
        for size in (1e-6, -1e-6):
            step = np.zeros((rows, 6))
            step.flat[column] = size
            near = moved(problem, step[:FRAMES], step[FRAMES:-1])
            ends.append(prior_residuals_of(near, bias + step[-1, :3]))
        numeric[:, column] = (ends[0] - ends[1]) / 2e-6
    layout = lay_out(problem, np.ones(len(problem.obs_images), bool))
    known, poses = Knowledge(problem, layout), problem.cams_from_world
    frames = rigs_of(problem).rigs_from_world.center
    _, blocks, gradient = known.linearize(
        poses.rotation.matrix, poses.center, frames, problem.camera_params, bias[None]
    )  # fmt: skip
    H = np.zeros((rows, rows, 6, 6))
    np.add.at(H, (known.targets.rows, known.targets.columns), blocks)
    assert np.all(known.targets.rows >= known.targets.columns)
    H = np.tril(H.transpose(0, 2, 1, 3).reshape(6 * rows, 6 * rows))
    H += np.tril(H, -1).T
    expected = numeric.T @ numeric
    scale = np.sqrt(np.diag(expected))[: 6 * rows - 3]
    difference = (H - expected)[: 6 * rows - 3, : 6 * rows - 3] / scale / scale[:, None]
    np.testing.assert_allclose(difference, 0, atol=1e-6)
    pull = numeric.T @ prior_residuals_of(problem, bias)
    np.testing.assert_allclose(gradient.ravel(), pull, rtol=0, atol=1e-6 * np.abs(pull).max())


def test_the_minimum_of_a_rig_with_priors_is_found_quickly_and_is_stationary(rng):
    truth = build_rig(rng, noise_px=0.3, free_sensors=True)
    problem = disturbed(dataclasses.replace(truth, priors=priors_of(truth, rng)), rng)
    result = adjust(problem, BundleConfig(relative_cost_tolerance=1e-12))
    assert result.reason in ("relative_cost", "gradient")
    assert result.iterations <= 15
    system, _ = system_of(result.problem, BundleConfig(gauge="free"), 1)
    system.biases[:] = result.biases
    assert system.linearize()[0] == pytest.approx(result.final_cost, rel=1e-9)
    for _ in range(10):
        near = disturbed(result.problem, rng, 1e-5)
        other, _ = system_of(near, BundleConfig(gauge="free"), 1)
        other.biases[:] = result.biases
        assert other.linearize()[0] >= result.final_cost * (1 - 1e-11)


def test_positions_of_cameras_measure_their_places_on_the_rig(rng):
    truth = build_rig(rng, noise_px=0.0, free_sensors=True)
    centers = truth.cams_from_world.center
    prior = PositionPrior.of_sigmas(np.arange(len(centers), dtype=np.int32), 1.5 * centers, 1e-4)
    result = adjust(dataclasses.replace(truth, priors=(prior,)), BundleConfig(relative_cost_tolerance=1e-13))
    before, after = (rigs_of(problem).sensors_from_rig for problem in (truth, result.problem))
    # All is half as large again, the rig too.
    np.testing.assert_allclose(after.translation, 1.5 * before.translation, atol=1e-4)
    np.testing.assert_allclose(result.problem.cams_from_world.center, 1.5 * centers, atol=1e-3)
