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


def rough_board(rng):
    return BOARD + rng.normal(0, 2e-4, BOARD.shape)


def test_corners_that_lie_anywhere_are_found_there_by_many_photos(rng):
    views = seen(LENS, rough_board(rng), poses_before(LENS, 45, rng), rng)
    chosen, *others = choose_shape(BOARD, views, CONFIG)
    assert chosen.kind == "free"
    assert chosen.ratio < 1.05
    assert chosen.calibration is not None
    assert all(row.held_out_rms_px > 1.3 * chosen.held_out_rms_px for row in others)


def test_a_shape_with_too_many_numbers_for_the_photos_is_told_and_not_taken(rng):
    views = seen(LENS, rough_board(rng), poses_before(LENS, 16, rng), rng)
    chosen, *others = choose_shape(BOARD, views, CONFIG)
    assert chosen.kind != "free"
    assert chosen.ratio < 1.05
    free = next(row for row in others if row.kind == "free")
    assert free.held_out_rms_px < 0.5 * chosen.held_out_rms_px
    assert free.ratio > 1.05
    assert f"from {chosen.held_out_rms_px:.3f} to {free.held_out_rms_px:.3f} px" in free.would_bring
    assert free.would_bring.endswith("photos like these, or --shape free")
    needed = int(free.would_bring.split("about ")[1].split()[0])
    assert 30 < needed < 80


def test_a_shape_that_costs_the_camera_is_not_chosen(rng):
    """Boards that are all held alike: camera and bend may be exchanged for one another."""
    still = poses_before(LENS, 1, rng, tilt=0.5, reach=0.0)[0]
    poses = [
        Rigid3(Rotation3.exp(rng.normal(0, 0.06, 3)) @ still.rotation, still.translation + rng.normal(0, 0.03, 3))
        for _ in range(20)
    ]
    bend = 0.0003 * (1 - (BOARD[:, 0] / 0.12) ** 2)
    views = seen(LENS, BOARD + np.column_stack([0 * bend, 0 * bend, bend]), poses, rng)
    ranked = choose_shape(BOARD, views, CalibrationConfig(lens="simple_radial"))
    assert ranked[0].kind == "flat"
    bent = next(row for row in ranked if row.kind == "paraboloid")
    assert bent.held_out_rms_px < ranked[0].held_out_rms_px
    assert bent.refused.endswith("times as uncertain as with a flat one")
    assert bent.would_bring.endswith("it needs boards that are tilted in more directions, or --shape paraboloid")


def test_too_few_views_to_judge_by_leave_the_simplest(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 3, rng), rng)
    ranked = choose_shape(BOARD, views, CONFIG)
    assert ranked[0].kind == "flat"
    assert "too_few_views" in ranked[0].refused
    assert ranked[0].calibration is not None
