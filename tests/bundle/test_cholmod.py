"""Adjustments by CHOLMOD, where it is installed, against those by our own sparse factor."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance
from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior
from sfm.core.errors import MissingDependencyError
from sfm.core.optional import import_cholmod
from tests.bundle.conftest import build, perturb
from tests.bundle.test_rigs import build_rig, disturbed

try:
    import_cholmod()
except MissingDependencyError:
    pytest.skip("scikit-sparse 0.4 is not installed", allow_module_level=True)

OURS, THEIRS = (BundleConfig(solver="sparse"), BundleConfig(solver="cholmod"))


def plain(rng: np.random.Generator) -> BundleProblem:
    return perturb(build(rng, images=8, points=120, noise_px=0.5, free_params=(0, 1)), rng)


def with_bounds(rng: np.random.Generator) -> BundleProblem:
    """One focal length that wants to leave its interval, and one that need not."""
    problem = build(rng, images=6, points=80, model="SIMPLE_RADIAL", cameras=2, noise_px=0.5, free_params=(0, 3))
    lower = np.full(problem.camera_params.shape, -np.inf)
    lower[0, 0], lower[1, 0] = 805.0, 700.0
    params = problem.camera_params.copy()
    params[0, 0] = 806.0
    fixed = np.arange(6) >= 2
    problem = dataclasses.replace(problem, camera_params=params, lower_params=lower, free_poses=fixed)
    return dataclasses.replace(problem, upper_params=np.where(np.isfinite(lower), 900.0, np.inf))


def with_a_rig(rng: np.random.Generator) -> BundleProblem:
    return disturbed(build_rig(rng, free_sensors=True, free_params=(0,)), rng)


def with_priors(rng: np.random.Generator) -> BundleProblem:
    """One of each kind; positions have a bias, the focal length is known."""
    problem = build(rng, images=6, points=60, noise_px=0.5, model="SIMPLE_RADIAL", free_params=(0, 3))
    images, centers = np.arange(6, dtype=np.int32), problem.cams_from_world.center
    down = np.array([0.0, 1.0, 0.0])
    sigmas = np.full(problem.camera_params.shape, np.inf)
    sigmas[0, 0] = 2.0
    priors = (
        PositionPrior.of_sigmas(images, centers + 0.01, 0.02, bias_sigma=0.5),
        GravityPrior(images[1:3], problem.cams_from_world.rotation.matrix[1:3] @ down, np.full(2, 0.01), down),
        DistancePrior(images[:1], images[3:4], np.linalg.norm(centers[:1] - centers[3:4], axis=1), np.array([0.01])),
        PointPrior.of_sigmas(np.array([2, 5], np.int32), problem.points3D[[2, 5]] + 0.003, 0.01),
    )
    problem = dataclasses.replace(problem, prior_params=problem.camera_params, prior_sigmas=sigmas, priors=priors)
    return perturb(problem, rng, 0.01)


@pytest.mark.parametrize("make", [plain, with_bounds, with_a_rig, with_priors])
def test_cholmod_takes_the_same_steps_as_our_sparse_factor(make: Callable[[np.random.Generator], BundleProblem], rng):
    problem = make(rng)
    ours, theirs = adjust(problem, OURS), adjust(problem, THEIRS)
    assert theirs.iterations == ours.iterations
    assert theirs.final_cost == pytest.approx(ours.final_cost, rel=1e-9)
    assert theirs.at_bounds == ours.at_bounds
    assert bool(ours.at_bounds) == (make is with_bounds)
    np.testing.assert_allclose(theirs.problem.points3D, ours.problem.points3D, atol=1e-6)
    np.testing.assert_allclose(theirs.biases, ours.biases, atol=1e-6)
    # Its covariance is that of a factor of our own, since CHOLMOD gives no inverse.
    found, expected = covariance(theirs.problem, THEIRS), covariance(ours.problem, OURS)
    assert isinstance(found, BundleCovariance)
    assert isinstance(expected, BundleCovariance)
    np.testing.assert_allclose(found.params, expected.params, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(found.centers, expected.centers, rtol=1e-4, atol=1e-9)
