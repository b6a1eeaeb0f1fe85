"""Points move although nothing is to be gained by poses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, adjust
from tests.bundle.conftest import build


@pytest.mark.parametrize("solver", ["dense", "sparse", "iterative"])
def test_points_move_where_the_reduced_system_has_nothing_on_its_right(rng, solver):
    """The one free image is wrong by so much that a truncated loss gives it no weight: its gradient is exactly zero."""
    truth = build(rng, images=4, points=40, noise_px=0.5, seen=1.0)
    measured = truth.obs_points2D.copy()
    measured[truth.obs_images == 3] += 500
    start = dataclasses.replace(
        truth, free_poses=np.arange(4) == 3, obs_points2D=measured, points3D=truth.points3D + 0.003
    )
    config = BundleConfig(loss="truncated", loss_scale_px=50.0, solver=solver)
    result = adjust(start, config)
    assert result.reason == "relative_cost"
    assert result.final_cost < result.initial_cost - 10
