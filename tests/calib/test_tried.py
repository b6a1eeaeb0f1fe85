"""Remedies do not advise what the automatic choice has just refused."""

from __future__ import annotations

import dataclasses

import numpy as np

from calib.cli.tried import with_what_was_measured, with_what_was_tried
from calib.diagnose import Finding
from calib.refine import CalibrationConfig
from calib.uncertainty_lenses import RankedLens
from calib.uncertainty_shapes import RankedShape, choose_shape
from calib.yardstick import Yardstick
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen

BENT = Finding("bent_board", "50 %", "let the board's shape be estimated (free), or glue it to glass")
LENS_FINDING = Finding("lens_model", "11 %", "take a lens model with more coefficients than radial")
OTHER = Finding("few_views", "5 views", "take 15 to 30")


def test_what_was_given_and_not_chosen_keeps_its_advice():
    assert with_what_was_tried([BENT, LENS_FINDING, OTHER], (), ()) == (BENT, LENS_FINDING, OTHER)


def test_a_shape_that_was_refused_is_no_remedy():
    shapes = (
        RankedShape("paraboloid"),
        RankedShape("free", refused="that is 1.20 times its error"),
        RankedShape("flat"),
    )
    told, other = with_what_was_tried([BENT, OTHER], (), shapes)
    assert other == OTHER
    assert "free: that is 1.20 times its error" in told.remedy
    assert "flat" not in told.remedy
    assert "let the board's shape" not in told.remedy
    assert with_what_was_tried([BENT], (), (RankedShape("free"),))[0].remedy.startswith("glue the board to glass")


def test_a_lens_that_was_no_better_is_no_remedy():
    lenses = (RankedLens("radial", 2, 0.20), RankedLens("opencv8", 8, 0.19), RankedLens("pinhole", 0, 2.0))
    told = with_what_was_tried([LENS_FINDING], lenses, ())[0].remedy
    assert "opencv8: 0.190 px, radial: 0.200 px" in told
    assert "pinhole" not in told
    bringing = (lenses[0], dataclasses.replace(lenses[1], would_bring="opencv8 would bring 0.1 px"))
    assert "opencv8 would bring 0.1 px" in with_what_was_tried([LENS_FINDING], bringing, ())[0].remedy
    assert "--model opencv12" in with_what_was_tried([LENS_FINDING], lenses[:1], ())[0].remedy


def test_a_shape_that_predicts_worse_is_not_said_to_have_been_refused(rng):
    """Of a free board the flat one is simply worse, whatever else might be said of it."""
    board = flat_board()
    off = np.array([0.0, 0.0, 1.0]) * rng.normal(0, 1e-3, (len(board), 1))
    views = seen(LENS, board + off, poses_before(LENS, 60, rng), rng)
    chosen, *others = choose_shape(board, views, CalibrationConfig(lens="opencv4"))
    assert chosen.kind == "free"
    assert [row.refused for row in others] == ["", ""]
    assert all(row.held_out_rms_px > chosen.held_out_rms_px for row in others)


def test_what_a_splined_lens_says_decides_whether_a_richer_lens_is_a_remedy():
    apart = np.full((2, 2), 0.1)
    measured = Yardstick("radial", "free", 0.2, 0.1, 160, True, apart, (1.0, 1.0), 0.3, 0.1)
    told, other = with_what_was_measured([LENS_FINDING, OTHER], measured)
    assert other == OTHER
    assert "richer lens models with --shape free" in told.remedy
    assert (
        "richer" not in with_what_was_measured([LENS_FINDING], dataclasses.replace(measured, is_lens=False))[0].remedy
    )
    on_flat = dataclasses.replace(measured, shape="flat")
    assert "--shape free" not in with_what_was_measured([LENS_FINDING], on_flat)[0].remedy
