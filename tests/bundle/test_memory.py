"""What is said of memory before it is taken, against what is taken."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance, covariance_bytes
from sfm.bundle.priors import PositionPrior
from sfm.bundle.problem import SolverChoice
from sfm.core.events import BundlePlanned
from tests.bundle.conftest import build, perturb

IMAGES, POINTS = 30, 6000
KINDS = {
    "fixed": ("SIMPLE_RADIAL", 1, (), "auto"),
    "shared": ("SIMPLE_RADIAL", 1, (0, 3), "auto"),
    "own": ("SIMPLE_RADIAL", IMAGES, (0, 3), "auto"),
    "own and wide": ("OPENCV", IMAGES, tuple(range(8)), "auto"),
    "sparse": ("SIMPLE_RADIAL", 1, (0, 3), "sparse"),
    "iterative": ("SIMPLE_RADIAL", 1, (0, 3), "iterative"),
}


def peak_of(run: Callable[[], object]) -> int:
    """Bytes that `run` takes at most beyond what was taken before."""
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    run()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak - before


@pytest.fixture(params=KINDS)
def case(request, rng) -> tuple[BundleProblem, BundleConfig]:
    """A problem of 90,000 observations; one of its kind was solved before, so that no kernel is loaded any more."""
    model, cameras, free, solver = KINDS[request.param]
    choice: SolverChoice = solver
    config = BundleConfig(max_iterations=2, solver=choice)
    kind = {"images": IMAGES, "model": model, "cameras": cameras, "free_params": free, "noise_px": 0.3, "seen": 0.5}
    small, large = (perturb(build(rng, points=points, **kind), rng, 1e-3) for points in (100, POINTS))
    adjust(small, config)
    covariance(small, config)
    return large, config


def test_an_adjustment_takes_the_memory_that_was_announced(case):
    problem, config = case
    events = []
    peak = peak_of(lambda: adjust(problem, config, observer=events.append))
    (plan,) = (event for event in events if isinstance(event, BundlePlanned))
    assert 0.95 < peak / plan.memory_bytes < 1.15


def test_a_covariance_takes_the_memory_that_is_forecast(case):
    problem, config = case
    found = []
    peak = peak_of(lambda: found.append(covariance(problem, config)))
    assert isinstance(found[0], BundleCovariance)
    assert 0.85 < peak / covariance_bytes(problem, config) < 1.1


def test_a_bias_that_is_held_does_not_make_two_systems_at_once(rng):
    problem = build(rng, images=IMAGES, points=POINTS, seen=0.5)
    images = np.arange(IMAGES, dtype=np.int32)
    prior = PositionPrior.of_sigmas(images, problem.cams_from_world.center, 0.1, bias_sigma=1.0)
    problem = dataclasses.replace(problem, priors=(prior,))
    covariance(problem)
    assert peak_of(lambda: covariance(problem)) < 1.1 * covariance_bytes(problem)
