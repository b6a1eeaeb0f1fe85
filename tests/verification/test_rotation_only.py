from __future__ import annotations

import numpy as np
import pytest

from sfm.core.geometry.homography import homography_from_pose
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.verification.rotation_only import focal_factor_of_rotation

TURN = Rotation3.exp(np.array([0.05, 0.3, 0.1]))


def calibration(focal: float) -> np.ndarray:
    return np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1.0]])


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.0, 1.4, 1.9])
def test_the_homography_of_a_rotation_tells_how_far_the_guess_is_off(factor):
    true, guess = calibration(600 * factor), calibration(600)
    h = true @ TURN.matrix @ np.linalg.inv(true)
    assert focal_factor_of_rotation(h, guess, guess, (True, True)) == pytest.approx(factor, rel=2e-3)
    assert focal_factor_of_rotation(-3 * h, guess, guess, (True, True)) == pytest.approx(factor, rel=2e-3)


@pytest.mark.parametrize("free", [(True, False), (False, True)])
def test_a_focal_length_that_is_known_stays(free):
    true = calibration(900), calibration(500)
    believed = tuple(k if not is_free else calibration(k[0, 0] / 1.3) for k, is_free in zip(true, free, strict=True))
    h = true[1] @ TURN.matrix @ np.linalg.inv(true[0])
    assert focal_factor_of_rotation(h, *believed, free) == pytest.approx(1.3, rel=2e-3)


def test_a_factor_is_found_for_any_homography_and_is_within_its_range():
    rng = np.random.default_rng(0)
    k = calibration(600)
    for _ in range(20):
        pose = Rigid3(Rotation3.exp(rng.normal(size=3)), rng.normal(size=3))
        h = k @ homography_from_pose(pose, np.array([0, 0, 1.0]), 2.0) @ np.linalg.inv(k)
        assert 0.3 < focal_factor_of_rotation(h, k, k, (True, True)) < 2.2
    assert focal_factor_of_rotation(np.zeros((3, 3)), k, k, (True, True)) == 1.0
