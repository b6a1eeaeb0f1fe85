from __future__ import annotations

import numpy as np

from calib.refine import CalibrationConfig
from calib.uncertainty_shapes import choose_shape
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen

BOARD = flat_board()
CONFIG = CalibrationConfig(lens="opencv4")


def test_a_flat_board_is_taken_for_flat(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 12, rng), rng)
    ranked = choose_shape(BOARD, views, CONFIG)
    assert ranked[0].kind == "flat"
    assert {row.kind for row in ranked} == {"flat", "paraboloid", "free"}


def test_a_bent_board_is_found_bent(rng):
    x, y = BOARD[:, 0] / 0.12, BOARD[:, 1] / 0.075
    bent = BOARD + np.column_stack([0 * x, 0 * x, 0.001 * (1 - x**2) + 0.0004 * (1 - y**2)])
    views = seen(LENS, bent, poses_before(LENS, 14, rng), rng)
    ranked = choose_shape(BOARD, views, CONFIG)
    assert ranked[0].kind == "paraboloid"
    assert ranked[0].held_out_rms_px < 0.5 * next(row for row in ranked if row.kind == "flat").held_out_rms_px


def test_corners_that_lie_anywhere_are_found_there(rng):
    rough = BOARD + rng.normal(0, 2e-4, BOARD.shape)
    views = seen(LENS, rough, poses_before(LENS, 16, rng), rng)
    chosen, *others = choose_shape(BOARD, views, CONFIG)
    assert chosen.kind == "free"
    assert chosen.calibration is not None
    assert all(row.held_out_rms_px > 1.3 * chosen.held_out_rms_px for row in others)


def test_a_shape_that_costs_the_camera_is_not_chosen(rng):
    """Boards that are all held alike, in a lens that is not quite the right one: a free board explains that better."""
    still = poses_before(LENS, 1, rng, tilt=0.5, reach=0.0)[0]
    poses = [
        Rigid3(Rotation3.exp(rng.normal(0, 0.03, 3)) @ still.rotation, still.translation + rng.normal(0, 0.02, 3))
        for _ in range(10)
    ]
    views = seen(LENS, BOARD, poses, rng)
    ranked = choose_shape(BOARD, views, CalibrationConfig(lens="radial"))
    told = [row.refused for row in ranked if row.kind == "free"]
    assert ranked[0].kind != "free"
    assert told[0].startswith("the camera would be uncertain by")


def test_too_few_views_to_judge_by_leave_the_simplest(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 3, rng), rng)
    ranked = choose_shape(BOARD, views, CONFIG)
    assert ranked[0].kind == "flat"
    assert "too_few_views" in ranked[0].refused
    assert ranked[0].calibration is not None
