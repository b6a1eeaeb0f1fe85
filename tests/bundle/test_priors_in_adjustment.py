"""Adjustments with priors on poses and points."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, adjust, covariance
from sfm.bundle.adjustment import system_of
from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior
from sfm.core.geometry.rigid import Rigid3
from tests.bundle.conftest import build, perturb

TIGHT = BundleConfig(relative_cost_tolerance=1e-13, max_iterations=100)
SOLVERS = ("dense", "sparse", "iterative")


def some_priors(problem, rng, bias=None):
    images = np.arange(len(problem.free_poses), dtype=np.int32)
    R, down = problem.cams_from_world.rotation.matrix, np.array([0.0, 0.0, 1.0])
    centers = problem.cams_from_world.center
    return (
        PositionPrior.of_sigmas(images, centers + 0.01 * rng.normal(size=centers.shape), 0.02, bias_sigma=bias),
        GravityPrior(images[1:3], R[1:3] @ down, np.array([0.01, 0.02]), down),
        DistancePrior(images[[0]], images[[3]], np.linalg.norm(centers[[0]] - centers[[3]], axis=1), np.array([0.01])),
        PointPrior.of_sigmas(np.array([2, 5], np.int32), problem.points3D[[2, 5]] + 0.003, 0.01),
    )


def cost_of(problem, biases=None):
    system, _ = system_of(problem, BundleConfig(), 1)
    if biases is not None:
        system.biases[:] = biases
    return system.linearize()[0]


@pytest.mark.parametrize("bias", [None, 0.5])
def test_the_minimum_with_priors_is_stationary(rng, bias):
    problem = build(rng, noise_px=0.5, model="SIMPLE_RADIAL", free_params=(0,))
    start = perturb(dataclasses.replace(problem, priors=some_priors(problem, rng, bias)), rng, 0.01)
    result = adjust(start, TIGHT)
    assert result.final_cost == pytest.approx(cost_of(result.problem, result.biases if bias else None), rel=1e-9)
    for _ in range(20):
        near = perturb(result.problem, rng, 1e-5)
        assert cost_of(near, result.biases if bias else None) >= result.final_cost * (1 - 1e-11)


@pytest.mark.parametrize("solver", SOLVERS)
def test_all_solvers_find_the_same_minimum(rng, solver):
    problem = build(rng, noise_px=0.5, model="SIMPLE_RADIAL", free_params=(0, 3))
    start = perturb(dataclasses.replace(problem, priors=some_priors(problem, rng, 0.5)), rng, 0.01)
    expected = adjust(start, TIGHT)
    found = adjust(start, dataclasses.replace(TIGHT, solver=solver))
    assert found.final_cost == pytest.approx(expected.final_cost, rel=1e-9)
    np.testing.assert_allclose(found.biases, expected.biases, atol=1e-6)


def test_positions_put_a_turned_and_scaled_model_back_in_its_frame(rng):
    truth = build(rng, noise_px=0.1)
    centers = truth.cams_from_world.center
    prior = PositionPrior.of_sigmas(np.arange(6, dtype=np.int32), centers, 0.001)
    turn = Rigid3.exp(np.array([0.05, -0.1, 0.08, 0.3, -0.2, 0.1]))
    poses = truth.cams_from_world @ Rigid3.stack([turn.inverse()] * 6)
    poses = Rigid3(poses.rotation, 1.1 * poses.translation)
    start = dataclasses.replace(truth, cams_from_world=poses, points3D=1.1 * (turn @ truth.points3D), priors=(prior,))
    found = adjust(start, TIGHT).problem
    np.testing.assert_allclose(found.cams_from_world.center, centers, atol=0.005)


def test_a_common_bias_is_found_where_control_points_fix_the_frame(rng):
    truth = build(rng, noise_px=0.1)
    bias = np.array([0.3, -0.2, 0.5])
    gps = PositionPrior.of_sigmas(
        np.arange(6, dtype=np.int32), truth.cams_from_world.center - bias, 0.01, bias_sigma=10.0
    )
    known = PointPrior.of_sigmas(np.arange(8, dtype=np.int32), truth.points3D[:8], 0.001)
    result = adjust(dataclasses.replace(truth, priors=(gps, known)), TIGHT)
    np.testing.assert_allclose(result.biases, [bias], atol=0.02)


def test_a_known_distance_sets_the_scale_and_nothing_else(rng):
    truth = build(rng, noise_px=0.1)
    centers = truth.cams_from_world.center
    length = float(np.linalg.norm(centers[0] - centers[4]))
    prior = DistancePrior(np.array([0], np.int32), np.array([4], np.int32), np.array([2 * length]), np.array([1e-3]))
    with_it, without = adjust(dataclasses.replace(truth, priors=(prior,)), TIGHT), adjust(truth, TIGHT)
    found = with_it.problem.cams_from_world.center
    assert np.linalg.norm(found[0] - found[4]) == pytest.approx(2 * length, rel=1e-5)
    assert with_it.final_cost == pytest.approx(without.final_cost, rel=1e-6)


def test_gravity_levels_the_scene(rng):
    truth = build(rng, noise_px=0.1)
    tilt = Rigid3.exp(np.array([0.2, 0.1, 0.0, 0, 0, 0]))
    images, down = np.arange(6, dtype=np.int32), np.array([0.0, 1.0, 0.0])
    prior = GravityPrior(images, truth.cams_from_world.rotation.matrix @ down, np.full(6, 0.01), down)
    start = dataclasses.replace(
        truth,
        cams_from_world=truth.cams_from_world @ Rigid3.stack([tilt.inverse()] * 6),
        points3D=tilt @ truth.points3D,
        priors=(prior,),
    )
    R = adjust(start, TIGHT).problem.cams_from_world.rotation.matrix
    np.testing.assert_allclose(R @ down, truth.cams_from_world.rotation.matrix @ down, atol=2e-3)


def test_covariances_with_priors_are_those_of_repeated_measurements(rng):
    truth = build(rng, images=5, points=40, seen=1.0)
    noise, count = 0.3, 300
    images, centers = np.arange(5, dtype=np.int32), truth.cams_from_world.center
    sigmas = np.full(len(truth.obs_images), noise)
    plain = dataclasses.replace(truth, obs_sigmas=sigmas, priors=(PositionPrior.of_sigmas(images, centers, 0.05),))
    predicted = covariance(plain)
    assert isinstance(predicted, BundleCovariance)
    found = []
    for _ in range(count):
        measured = truth.obs_points2D + noise * rng.normal(size=truth.obs_points2D.shape)
        prior = PositionPrior.of_sigmas(images, centers + 0.05 * rng.normal(size=centers.shape), 0.05)
        solved = adjust(dataclasses.replace(plain, obs_points2D=measured, priors=(prior,))).problem
        found.append(solved.cams_from_world.center - centers)
    ratio = np.sqrt(np.mean(np.square(found), axis=0) / np.einsum("iaa->ia", predicted.centers))
    assert 0.9 < np.median(ratio) < 1.1
    free = covariance(plain, BundleConfig(gauge="free"))
    assert isinstance(free, BundleCovariance)
    np.testing.assert_allclose(free.centers, predicted.centers, rtol=1e-5, atol=1e-12)


def test_a_prior_about_an_image_that_is_not_there_is_refused(rng):
    problem = build(rng)
    prior = PositionPrior.of_sigmas(np.array([9], np.int32), np.zeros((1, 3)), 1.0)
    with pytest.raises(ValueError, match="images"):
        dataclasses.replace(problem, priors=(prior,))


@pytest.mark.parametrize("what", ["pose", "point"])
def test_nothing_is_expected_of_what_is_not_finite(rng, what):
    """As if these measurements had not been made."""
    problem = build(rng, images=5, points=40, noise_px=0.5)
    images, points = np.arange(5, dtype=np.int32), np.arange(3, dtype=np.int32)
    centers, down = problem.cams_from_world.center, np.array([0.0, 1.0, 0.0])
    directions, ones = problem.cams_from_world.rotation.matrix @ down, np.ones(4)

    def priors(kept, placed):
        pairs = images[:4][kept[:4] & kept[1:]]
        return (
            PositionPrior.of_sigmas(images[kept], centers[kept] + 0.02, 0.05, bias_sigma=0.5),
            GravityPrior(images[kept], directions[kept], np.full(int(kept.sum()), 0.02), down),
            DistancePrior(pairs, pairs + 1, ones[: len(pairs)], ones[: len(pairs)]),
            PointPrior.of_sigmas(points[placed], problem.points3D[points[placed]] + 0.01, 0.02),
        )

    kept, placed = np.ones(5, bool), np.ones(3, bool)
    translation, points3D = problem.cams_from_world.translation.copy(), problem.points3D.copy()
    if what == "pose":
        translation[2], kept[2] = np.nan, False
    else:
        points3D[1], placed[1] = np.nan, False
    poses = Rigid3(problem.cams_from_world.rotation, translation)
    broken = dataclasses.replace(problem, cams_from_world=poses, points3D=points3D)
    config = BundleConfig(gauge="free")
    found = adjust(dataclasses.replace(broken, priors=priors(np.ones(5, bool), np.ones(3, bool))), config)
    expected = adjust(dataclasses.replace(broken, priors=priors(kept, placed)), config)
    assert found.table == expected.table
    assert found.final_cost < found.initial_cost
    assert np.array_equal(found.problem.points3D, expected.problem.points3D, equal_nan=True)
