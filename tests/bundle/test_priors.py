import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleProblem, adjust
from sfm.bundle.gauge import held_by_two_cameras
from sfm.bundle.layout import lay_out
from sfm.bundle.system import BundleSystem
from sfm.core.cameras._kernels import MAX_PARAMS
from tests.bundle.conftest import build

CONVERGED = BundleConfig(relative_cost_tolerance=1e-12, max_iterations=200)


def _with_prior(problem: BundleProblem, column: int, value: float, sigma: float) -> BundleProblem:
    expected, sigmas = np.zeros((1, MAX_PARAMS)), np.full((1, MAX_PARAMS), np.inf)
    expected[0, column], sigmas[0, column] = value, sigma
    return dataclasses.replace(problem, prior_params=expected, prior_sigmas=sigmas)


def test_a_tight_prior_holds_a_parameter(rng):
    problem = build(rng, model="SIMPLE_RADIAL", free_params=(0, 3), noise_px=0.5)
    result = adjust(_with_prior(problem, 0, 805.0, 1e-6), CONVERGED)
    assert result.problem.camera_params[0, 0] == pytest.approx(805.0, abs=1e-3)


def test_a_loose_prior_changes_next_to_nothing(rng):
    problem = build(rng, model="SIMPLE_RADIAL", free_params=(0, 3), noise_px=0.5)
    free, held = adjust(problem, CONVERGED), adjust(_with_prior(problem, 0, 1000.0, 1e6), CONVERGED)
    assert held.problem.camera_params[0, 0] == pytest.approx(free.problem.camera_params[0, 0], abs=1e-2)


def test_the_cost_includes_the_prior(rng):
    problem = build(rng, model="SIMPLE_RADIAL", free_params=(0,))
    result = adjust(_with_prior(problem, 0, 810.0, 2.0), BundleConfig(max_iterations=0))
    assert result.initial_cost == pytest.approx(0.5 * (10.0 / 2.0) ** 2, rel=1e-9)


def test_the_gradient_of_the_prior_agrees_with_differences(rng):
    problem = _with_prior(build(rng, model="SIMPLE_RADIAL", free_params=(0, 3), noise_px=0.5), 0, 812.0, 3.0)

    def system(focal: float) -> tuple[float, float]:
        params = problem.camera_params.copy()
        params[0, 0] = focal
        moved = dataclasses.replace(problem, camera_params=params)
        layout = lay_out(moved, np.ones(len(moved.obs_images), bool))
        made = BundleSystem(moved, layout, held_by_two_cameras(moved, layout), BundleConfig(), 1)
        cost, _ = made.linearize()
        return cost, float(made.gradient[-1, 0])

    step = 1e-3
    numeric = (system(800.0 + step)[0] - system(800.0 - step)[0]) / (2 * step)
    assert system(800.0)[1] == pytest.approx(numeric, rel=1e-6)


def test_half_a_prior_is_refused(rng):
    with pytest.raises(ValueError, match="together"):
        dataclasses.replace(build(rng), prior_params=np.zeros((1, MAX_PARAMS)))
    with pytest.raises(ValueError, match="positive"):
        dataclasses.replace(build(rng), prior_params=np.zeros((1, MAX_PARAMS)), prior_sigmas=np.zeros((1, MAX_PARAMS)))
