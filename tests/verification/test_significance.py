from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.robust import RansacConfig
from sfm.core.robust.fundamental import estimate_fundamental
from sfm.verification.significance import log10_false_alarms

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, np.array([560.0, 320, 240]), True)
SMALL = CAMERA.scaled(160, 120)


@pytest.mark.parametrize("count", [30, 100, 400])
def test_what_fits_random_matches_best_is_not_significant(count):
    """The bound is on the expected number of such models, hence a safe one."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        points1, points2 = rng.uniform(0, 1, (2, count, 2)) * [640, 480]
        config = RansacConfig(max_iterations=500, min_inliers=8)
        found = estimate_fundamental(points1, points2, config, rng=rng)
        assert not isinstance(found, Rejected)
        assert log10_false_alarms(int(found.inliers.sum()), count, CAMERA, CAMERA, 4.0, planar=False) > -3


def test_it_is_the_formula():
    """10 (20 − 4) C(20, 12) C(12, 4) (π 16 / 307200)⁸ in logarithms."""
    exact = np.log10(10.0 * 16 * 125970 * 495) + 8 * np.log10(np.pi * 16 / 307200)
    assert log10_false_alarms(12, 20, CAMERA, CAMERA, 4.0, planar=True) == pytest.approx(exact)


def test_more_inliers_fewer_matches_and_larger_images_are_less_by_chance():
    def value(inliers=20, count=60, camera=CAMERA, error=4.0, planar=False):
        return log10_false_alarms(inliers, count, camera, CAMERA, error, planar=planar)

    assert value(inliers=25) < value()
    assert value(count=40) < value()
    assert value(error=2.0) < value()
    assert value(planar=True) < value()
    assert value(camera=SMALL) > value()
    assert value(inliers=7) == np.inf
