"""Covariances of scenes that only positions with a common bias place in the world."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance
from sfm.bundle.adjustment import system_of
from sfm.bundle.drift import drift_of
from sfm.bundle.priors import PointPrior, PositionPrior
from sfm.core.errors import Rejected
from tests.bundle.conftest import build

TIGHT = BundleConfig(relative_cost_tolerance=1e-12)


def placed(rng, sigma: float, bias_sigma: float, **kind) -> BundleProblem:
    """Six images whose positions are measured, with a bias that they have in common."""
    problem = build(rng, images=6, points=40, model="SIMPLE_RADIAL", free_params=(0,), noise_px=0.3)
    centers = problem.cams_from_world.center
    images = np.arange(6, dtype=np.int32)
    return dataclasses.replace(
        problem, priors=(PositionPrior.of_sigmas(images, centers, sigma, bias_sigma=bias_sigma, **kind),)
    )


def prior_of(problem: BundleProblem) -> PositionPrior:
    (prior,) = problem.priors
    assert isinstance(prior, PositionPrior)
    return prior


def drifts(problem: BundleProblem, config: BundleConfig = BundleConfig()) -> bool:
    return drift_of(problem, system_of(problem, config, 1)[0]) is not None


def known(problem: BundleProblem, config: BundleConfig = BundleConfig(), **kind) -> BundleCovariance:
    found = covariance(problem, config, **kind)
    assert isinstance(found, BundleCovariance)
    return found


@pytest.mark.parametrize("gauge", ["two_cameras", "free"])
def test_the_covariance_is_that_of_the_whole_normal_matrix(rng, gauge):
    """A control point that is hardly known changes nothing, but the bias is then one of the unknowns."""
    problem, config = placed(rng, 0.05, 0.5), BundleConfig(gauge=gauge)
    vague = PointPrior.of_sigmas(np.array([3], np.int32), problem.points3D[[3]], 1e5)
    whole = dataclasses.replace(problem, priors=(*problem.priors, vague))
    assert drifts(problem)
    assert not drifts(whole)
    ours, theirs = known(problem, config), known(whole, config)
    for name in ("poses", "centers", "params", "points3D"):
        one, two = getattr(ours, name), getattr(theirs, name)
        np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-9 * np.abs(two).max())
    # Three residuals more, which are zero.
    freedom = 2 * len(problem.obs_images) + 18 + 3 - 36 - 1 - 120 - 3
    assert ours.variance_factor * freedom == pytest.approx(theirs.variance_factor * (freedom + 3), rel=1e-9)


@pytest.mark.parametrize("bias_sigma", [1e4, 1e9])
def test_a_bias_of_which_hardly_anything_is_known_makes_the_place_of_the_scene_as_uncertain(rng, bias_sigma):
    problem = placed(rng, 1e-3, bias_sigma)
    prior = prior_of(problem)
    still = known(dataclasses.replace(problem, priors=(dataclasses.replace(prior, bias_sigma=None),)))
    found = known(problem)
    np.testing.assert_allclose(np.einsum("iaa->ia", found.centers), bias_sigma**2, rtol=1e-6)
    np.testing.assert_allclose(found.poses[:, :3, :3], still.poses[:, :3, :3], rtol=1e-9)
    assert np.isfinite(found.points3D).all()


def test_the_bias_that_was_found_counts_where_deviations_have_a_robust_loss(rng):
    """Without it all positions would look wrong and count for little."""
    problem = placed(rng, 0.01, 5.0, loss="huber", loss_scale=3.0)
    shifted = dataclasses.replace(prior_of(problem), positions=prior_of(problem).positions + [1.0, -2.0, 0.5])
    result = adjust(dataclasses.replace(problem, priors=(shifted,)), TIGHT)
    without = adjust(problem, TIGHT)
    one, two = known(result.problem, biases=result.biases), known(without.problem)
    np.testing.assert_allclose(one.params, two.params, rtol=1e-2)
    np.testing.assert_allclose(one.centers, two.centers, rtol=1e-2)
    vague = PointPrior.of_sigmas(np.array([3], np.int32), result.problem.points3D[[3]], 1e3)
    whole = dataclasses.replace(result.problem, priors=(*result.problem.priors, vague))
    np.testing.assert_allclose(known(whole, biases=result.biases).params, one.params, rtol=1e-2)


def test_what_stands_still_or_lies_on_a_line_does_not_drift(rng):
    problem = placed(rng, 0.05, 0.5)
    poses, points = np.ones(6, bool), np.ones(40, bool)
    poses[2] = points[7] = False
    assert not drifts(dataclasses.replace(problem, free_poses=poses))
    assert not drifts(dataclasses.replace(problem, free_points=points))
    assert not drifts(dataclasses.replace(problem, priors=(*problem.priors, *problem.priors)))
    prior = prior_of(problem)
    two = PositionPrior(prior.images[:2], prior.positions[:2], prior.covariances[:2], prior.bias_sigma)
    assert not drifts(dataclasses.replace(problem, priors=(two,)))
    known(dataclasses.replace(problem, priors=(two,)), BundleConfig(gauge="free"))


def test_a_bias_that_is_left_open_is_named(rng):
    """One control point of a scene that is held says where it lies, 10¹¹ times less surely than the positions."""
    problem = placed(rng, 1e-6, 1e9)
    vague = PointPrior.of_sigmas(np.array([3], np.int32), problem.points3D[[3]], 1e9)
    found = covariance(dataclasses.replace(problem, priors=(*problem.priors, vague)))
    assert isinstance(found, Rejected)
    assert found.reason in ("undetermined_bias", "undetermined_pose")
