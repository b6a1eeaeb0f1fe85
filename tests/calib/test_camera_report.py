"""What is told of a calibrated camera: doubts by views, with their lower bound beside them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.boards import chessboard
from calib.cli.calibrating import CalibratedCamera, CameraPlan, calibrate_camera, with_yardstick
from calib.cli.camera_report import camera_json, camera_lines, record_of
from calib.cli.next_photos import further_photos, next_photos
from calib.cli.sightings import Sightings
from calib.uncertainty import rms_uncertainty
from calib.yardstick import Yardstick
from sfm.core.errors import Rejected
from tests.calib.boards_in_space import LENS, poses_before, seen, with_corners

BOARD = chessboard(8, 6, 0.03)
CENTRED = BOARD.points3D - BOARD.points3D.mean(axis=0)


def sightings(count: int, rng: np.random.Generator, bow_px: float = 2.0) -> Sightings:
    """Photos each of which is bent in its own way, so that corners of one err together."""
    views = []
    for view in seen(LENS, CENTRED, poses_before(LENS, count, rng), rng):
        u, v = (view.points2D / [1280, 960] - 0.5).T
        bow = bow_px * np.stack([u * v * rng.normal(), u * u * rng.normal()], 1)
        views.append(with_corners(view, view.points2D + bow))
    return Sightings(BOARD, BOARD.points3D, tuple(views), (), "digest")


def made_of(seen_: Sightings, **plan) -> CalibratedCamera:
    made = calibrate_camera(seen_, CameraPlan(**({"lens": "opencv4", "shape": "flat"} | plan)))
    assert not isinstance(made, Rejected), made
    return made


def test_what_is_told_as_uncertainty_is_by_views_and_the_bound_stands_beside_it(rng):
    shown = sightings(14, rng)
    made = made_of(shown)
    told = camera_json(made, shown, ())["uncertainty"]
    assert told["by"] == "views"
    assert told["rms_px"] == pytest.approx(rms_uncertainty(made.found, made.by_view))
    assert told["bound_px"] == pytest.approx(rms_uncertainty(made.found, made.covariances))
    assert told["rms_px"] > 1.5 * told["bound_px"]
    text = "\n".join(camera_lines(made, shown, ()))
    assert f"uncertainty {told['rms_px']:8.4f}  of a pixel far away, one standard deviation by views" in text
    assert f"at least  {told['bound_px']:8.4f}  if all corners were independent" in text


def test_suggested_photos_start_from_the_uncertainty_that_is_told_also_from_the_file(rng):
    shown = sightings(14, rng)
    made = made_of(shown)
    told = camera_json(made, shown, ())["uncertainty"]["rms_px"]
    suggested = next_photos(made, shown)
    assert suggested[0].before_px == pytest.approx(told)
    assert suggested[0].after_px < told
    record = record_of(made, shown, command="")
    assert record.number("uncertainty_px") == pytest.approx(told)
    again = further_photos(made.found.camera, record, shown, made.found)
    assert [view.words for view in again] == [view.words for view in suggested]
    assert again[0].before_px == pytest.approx(told)


def test_views_too_few_for_doubts_of_their_own_leave_the_bound_and_say_so(rng):
    shown = sightings(12, rng)
    made = dataclasses.replace(made_of(shown), by_view=Rejected("undetermined_parameters", "few"))
    told = camera_json(made, shown, ())["uncertainty"]
    assert told["by"] == "corners"
    assert told["rms_px"] == told["bound_px"]
    assert "at least: all corners taken for independent" in "\n".join(camera_lines(made, shown, ()))


def test_halves_differ_by_about_twice_the_uncertainty_by_views(rng):
    ratios = []
    for _ in range(4):
        made = made_of(sightings(20, rng))
        assert not isinstance(made.halves, Rejected)
        ratios.append(made.halves.rms_px / rms_uncertainty(made.found, made.by_view))
    assert 1.3 < np.median(ratios) < 3.2


def test_the_error_of_held_out_photos_is_one_number_whatever_was_left_out(rng):
    """A bent board with corners that only the right shape knows for outliers."""
    bend = 0.0012 * (1 - (CENTRED[:, :1] / 0.1) ** 2) * [0, 0, 1.0]
    views = seen(LENS, CENTRED + bend, poses_before(LENS, 14, rng), rng)
    for k in (2, 5, 9):
        points = np.array(views[k].points2D)
        points[7 * k % 40] += [1.1, -0.9]
        views[k] = with_corners(views[k], points)
    shown = Sightings(BOARD, BOARD.points3D, tuple(views), (), "digest")
    made = made_of(shown, shape="auto")
    told = camera_json(made, shown, ())
    assert told["holdout_rms_px"] == told["shapes"][0]["holdout_rms_px"]
    assert told["rms_px"] == pytest.approx(told["shapes"][0]["rms_px"], rel=1e-6)
    flat = next(row for row in told["shapes"] if row["name"] == "flat")
    assert record_of(made, shown, command="").number("holdout_flat_px") == flat["holdout_rms_px"]


def test_the_error_with_a_flat_board_is_told_for_a_shape_that_was_given(rng):
    bend = 0.0012 * (1 - (CENTRED[:, :1] / 0.1) ** 2) * [0, 0, 1.0]
    shown = Sightings(
        BOARD, BOARD.points3D, tuple(seen(LENS, CENTRED + bend, poses_before(LENS, 12, rng), rng)), (), ""
    )
    made = made_of(shown, shape="paraboloid")
    assert not isinstance(made.held_out, Rejected)
    assert made.flat_px > 1.5 * made.held_out.rms_px


def test_the_yardstick_is_told_where_the_lens_was_chosen_and_only_there(rng):
    shown = sightings(10, rng)
    given = made_of(shown)
    assert given.yardstick is None
    assert camera_json(given, shown, ())["yardstick"] is None
    assert "splined" not in "\n".join(camera_lines(given, shown, ()))
    chosen = with_yardstick(given, shown.points3D)
    assert isinstance(chosen.yardstick, Yardstick)
    text = "\n".join(camera_lines(chosen, shown, ()))
    assert f"  lens    {chosen.yardstick.of_lens}" in text
    told = camera_json(chosen, shown, ())["yardstick"]
    assert told["is_lens"] is chosen.yardstick.is_lens
    assert told["splined_holdout_rms_px"] == chosen.yardstick.splined_rms_px
    refused = dataclasses.replace(given, yardstick=Rejected("too_few_views", "2 of 3"))
    assert "no splined lens as a yardstick: too_few_views: 2 of 3" in "\n".join(camera_lines(refused, shown, ()))
