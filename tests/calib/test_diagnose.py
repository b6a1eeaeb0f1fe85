"""Causes are told apart: one fault at a time, and none where there is none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.coverage import coverage
from calib.diagnose import board_tilts, diagnose
from calib.refine import CalibrationConfig, calibrate
from calib.whiteness import whiteness
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen, with_corners

BOARD = flat_board()
CONFIG = CalibrationConfig(lens="opencv4", reject=False)


def calibrated(views, config=CONFIG):
    found = calibrate(BOARD, views, config)
    assert not isinstance(found, Rejected), found
    return found


def causes(found) -> list[str]:
    return [finding.cause for finding in diagnose(found)]


def good(rng, count=40, board=BOARD, reach=0.48, **how):
    return seen(LENS, board, poses_before(LENS, count, rng, reach=reach, **how), rng)


def test_nothing_is_wrong_with_good_views(rng):
    assert diagnose(calibrated(good(rng))) == ()


def test_white_residuals_are_within_a_few_deviations_of_chance(rng):
    white = whiteness(calibrated(good(rng)))
    for share, sigma in (white.neighbours, white.board, white.image):
        assert abs(share) < 5 * sigma
        assert 0 < sigma < 0.05


def test_a_bent_board_is_told_and_its_estimated_shape_mends_it(rng):
    bend = 0.0008 * (1 - (BOARD[:, :1] / 0.12) ** 2) * [0, 0, 1.0]
    views = good(rng, board=BOARD + bend)
    assert "bent_board" in causes(calibrated(views))
    assert "bent_board" not in causes(calibrated(views, dataclasses.replace(CONFIG, shape="paraboloid")))


def test_of_a_board_that_adds_less_than_detection_errs_nothing_is_told(rng):
    """Glue mends no shifts of a hundredth of a pixel, which circles and tags of flat boards have, too."""
    off = 4e-6 * rng.normal(size=(len(BOARD), 1)) * [1.0, 0.5, 0]
    found = calibrated(seen(LENS, BOARD + off, poses_before(LENS, 40, rng, reach=0.48), rng, 0.01))
    assert whiteness(found).board[0] > 0.15
    assert diagnose(found) == ()


def test_a_lens_model_that_does_not_fit_is_told(rng):
    found = causes(calibrated(good(rng), dataclasses.replace(CONFIG, lens="simple_radial")))
    assert "lens_model" in found
    assert "bent_board" not in found


def test_a_view_that_errs_more_is_named(rng):
    views = good(rng)
    views[7] = with_corners(views[7], views[7].points2D + 0.4 * rng.normal(size=views[7].points2D.shape))
    details = [finding.detail for finding in diagnose(calibrated(views)) if finding.cause == "outlier_view"]
    assert len(details) == 1
    assert details[0].startswith("view07")


def test_corners_of_the_image_that_were_never_covered_are_told(rng):
    found = calibrated(good(rng, reach=0.0))
    assert "uncovered_border" in causes(found)
    assert not coverage(found)[0, 0]


def within(view, rng, margin):
    """Whether all of the board is in the image, so far from the border."""
    points = view.points2D
    return len(points) == len(BOARD) and np.all(
        (points > margin) & (points < [LENS.width - margin, LENS.height - margin])
    )


def test_a_board_without_marks_is_not_asked_to_be_cut_by_the_border(rng):
    """Its outermost squares are in the image with it: 1.5 squares from the border is as far as corners come."""
    views = [view for view in seen(LENS, BOARD, poses_before(LENS, 900, rng, reach=0.48), rng) if within(view, rng, 40)]
    assert len(views) > 60
    assert "uncovered_border" not in causes(calibrated(views))
    left = [view for view in views if view.points2D[:, 0].max() < 700][:30]
    told = next(f for f in diagnose(calibrated(left)) if f.cause == "uncovered_border")
    assert told.detail.endswith("most of it on the right")
    assert "cut by the border" not in told.remedy


def test_boards_that_are_hardly_tilted_are_told(rng):
    assert "few_tilts" in causes(calibrated(good(rng, tilt=0.2, reach=0.2)))


def test_boards_that_lean_one_way_are_told(rng):
    poses = [
        Rigid3(Rotation3.exp(np.array([a, 0.0, 0.0])), np.append(rng.uniform(-0.1, 0.1, 2), rng.uniform(0.3, 0.5)))
        for a in np.linspace(-0.7, 0.7, 20)
    ]
    assert "tilts_about_one_axis" in causes(calibrated(seen(LENS, BOARD, poses, rng)))


def test_tilts_are_those_of_the_boards(rng):
    turns = [(0.4, 0.0, 0.0), (0.0, -0.5, 0.3), (0.2, 0.2, 0.0), (-0.3, 0.1, 1.0)]
    poses = [Rigid3(Rotation3.exp(np.array(turn)), np.array([0, 0, 0.4])) for turn in turns]
    found = calibrated(seen(LENS, BOARD, poses, rng))
    expected = [np.arccos(pose.rotation.matrix[2, 2]) for pose in poses]
    np.testing.assert_allclose(board_tilts(found)[0], expected, atol=0.02)


def test_a_solution_that_is_not_one_is_told(rng):
    found = calibrated(good(rng), dataclasses.replace(CONFIG, max_iterations=1))
    assert causes(found)[0] == "not_converged"


def test_few_views_are_told(rng):
    assert "few_views" in causes(calibrated(good(rng, count=5)))


@pytest.mark.parametrize("count", [1, 3])
def test_pixels_far_from_any_board_are_uncertain(count, rng):
    found = calibrated(good(rng, count=6 * count, reach=0.05))
    assert "uncertain_corners" in causes(found)


@pytest.mark.parametrize(("count", "remedy"), [(2, "add photos"), (12, "tilt the board")])
def test_how_many_tilts_are_missing_is_told(count, remedy, rng):
    if count == 2:  # two boards, both tilted
        poses = [Rigid3(Rotation3.exp(np.array(turn)), np.array([0, 0, 0.4])) for turn in ([0.6, 0, 0], [0, 0.6, 0.0])]
        views = seen(LENS, BOARD, poses, rng)
    else:
        views = good(rng, count=count, tilt=0.2, reach=0.2)
    found = calibrated(views, dataclasses.replace(CONFIG, min_views=2))
    told = next(finding for finding in diagnose(found) if finding.cause == "few_tilts")
    assert told.detail.startswith("only ")
    assert told.detail.endswith(" should be")
    assert told.remedy.startswith(remedy)
