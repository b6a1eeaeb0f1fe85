"""Adjustment with priors of poses and points: solutions, against differences of the whole cost."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, adjust, squared_errors
from sfm.bundle.prior_terms import point_prior_cost, prior_cost
from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.bundle.conftest import build, perturb
from tests.bundle.test_rigs import FRAMES, SENSORS, build_rig, disturbed, moved

CONVERGED = BundleConfig(relative_cost_tolerance=1e-13, max_iterations=300)


def rows(*numbers):
    return np.array(numbers, np.int32)


def measured(problem, rng, *, bias=None, sigma=0.05):
    """Positions of all images, as far off as they claim."""
    centers = problem.cams_from_world.center
    off = sigma * rng.normal(size=centers.shape)
    shift = 0.0 if bias is None else np.array([0.3, -0.2, 0.1])
    return PositionPrior.of_sigmas(
        np.arange(len(centers), dtype=np.int32), centers + off - shift, sigma, bias_sigma=bias
    )


def down_in_cameras(problem, down=(0.0, 0.0, -1.0)):
    R = problem.cams_from_world.rotation.matrix
    return GravityPrior(np.arange(len(R), dtype=np.int32), R @ np.array(down), np.full(len(R), 0.01), np.array(down))


def whole_cost(problem, biases):
    poses = problem.cams_from_world
    cost = 0.5 * squared_errors(problem).sum()
    cost += prior_cost(problem.pose_priors, poses.rotation.matrix, poses.center, biases)
    return cost + point_prior_cost(problem.point_priors, problem.points3D)


def shifted(problem, biases, direction, step):
    """All free parameters moved along a direction."""
    pose, point, bias = direction
    rotation = problem.cams_from_world.rotation @ Rotation3.exp(step * pose[:, :3])
    center = problem.cams_from_world.center - step * pose[:, 3:]
    return dataclasses.replace(
        problem,
        cams_from_world=Rigid3(rotation, -(rotation @ center)),
        points3D=problem.points3D + step * point,
    ), biases + step * bias


def could_fall_by(result, rng, tries=25):
    """The part of the cost that a step along any of some random directions would save, by its quadratic model."""
    problem, biases = result.problem, result.biases
    cost, most = whole_cost(problem, biases), 0.0
    for _ in range(tries):
        shapes = ((len(problem.free_poses), 6), problem.points3D.shape, biases.shape)
        direction = [rng.normal(size=shape) * (rng.random(shape) < 0.5) for shape in shapes]
        step = 1e-5
        up, down = (whole_cost(*shifted(problem, biases, direction, s * step)) for s in (1, -1))
        slope, curvature = (up - down) / (2 * step), (up - 2 * cost + down) / step**2
        most = max(most, slope**2 / (2 * curvature) / cost)
    return most


PRIORS = {
    "positions": lambda problem, rng: (measured(problem, rng),),
    "positions with a bias": lambda problem, rng: (measured(problem, rng, bias=1.0), down_in_cameras(problem)),
    "two groups": lambda problem, rng: (measured(problem, rng, bias=0.5), measured(problem, rng, bias=2.0)),
    "gravity and distances": lambda problem, rng: (
        down_in_cameras(problem),
        DistancePrior(rows(0, 1), rows(3, 5), np.array([5.0, 7.0]), np.array([0.1, 0.2])),
    ),
    "robust": lambda problem, rng: (dataclasses.replace(measured(problem, rng), loss="cauchy", loss_scale=1.5),),
}


@pytest.mark.parametrize("kind", PRIORS)
def test_the_solution_is_a_minimum_of_the_whole_cost(rng, kind):
    problem = build(rng, noise_px=0.5)
    problem = dataclasses.replace(perturb(problem, rng), priors=PRIORS[kind](problem, rng))
    result = adjust(problem, CONVERGED)
    assert result.final_cost == pytest.approx(whole_cost(result.problem, result.biases), rel=1e-9)
    assert could_fall_by(result, rng) < 1e-8


def test_control_points_are_part_of_the_minimum(rng):
    problem = build(rng, noise_px=0.5)
    control = PointPrior.of_sigmas(rows(0, 5, 9), problem.points3D[[0, 5, 9]] + 0.1 * rng.normal(size=(3, 3)), 0.05)
    problem = dataclasses.replace(perturb(problem, rng), priors=(control,))
    result = adjust(problem, CONVERGED)
    assert result.final_cost == pytest.approx(whole_cost(result.problem, result.biases), rel=1e-9)
    assert could_fall_by(result, rng) < 1e-8


@pytest.mark.parametrize("kind", PRIORS)
def test_rigs_move_to_a_minimum_of_the_whole_cost(rng, kind):
    """In steps of the frames; how sensors are mounted is constant."""
    problem = build_rig(rng)
    problem = dataclasses.replace(disturbed(problem, rng), priors=PRIORS[kind](problem, rng))
    result = adjust(problem, CONVERGED)
    cost = whole_cost(result.problem, result.biases)
    assert result.final_cost == pytest.approx(cost, rel=1e-9)
    for _ in range(25):
        frames = rng.normal(size=(FRAMES, 6)) * (rng.random((FRAMES, 6)) < 0.5)
        bias, costs = rng.normal(size=result.biases.shape), []
        for step in (1e-5, -1e-5):
            there = moved(result.problem, step * frames, np.zeros((SENSORS - 1, 6)))
            costs.append(whole_cost(there, result.biases + step * bias))
        slope, curvature = (costs[0] - costs[1]) / 2e-5, (costs[0] - 2 * cost + costs[1]) / 1e-10
        assert slope**2 / (2 * curvature) < 1e-8 * cost


def test_the_result_is_the_same_for_any_number_of_threads(rng):
    problem = build(rng, noise_px=0.5)
    problem = dataclasses.replace(perturb(problem, rng), priors=PRIORS["two groups"](problem, rng))
    one, many = (adjust(problem, threads=threads) for threads in (1, 3))
    np.testing.assert_array_equal(one.problem.cams_from_world.matrix, many.problem.cams_from_world.matrix)
    np.testing.assert_array_equal(one.biases, many.biases)


def test_an_image_that_sees_nothing_stays_though_it_has_a_prior(rng):
    problem = build(rng)
    keep = problem.obs_images != 2
    problem = dataclasses.replace(
        problem,
        obs_images=problem.obs_images[keep],
        obs_points=problem.obs_points[keep],
        obs_points2D=problem.obs_points2D[keep],
        priors=(measured(problem, rng),),
    )
    result = adjust(problem, CONVERGED)
    assert np.isfinite(result.problem.cams_from_world.matrix).all()
