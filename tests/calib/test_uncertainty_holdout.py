"""Views that were held out: errors, halves, and the choice of a lens model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.refine import CalibrationConfig, calibrate
from calib.refine_views import gather
from calib.uncertainty_holdout import hold_out, pose_only_errors, split_half, views_of
from calib.uncertainty_lenses import choose_lens
from sfm.core.errors import Rejected
from tests.calib.boards_in_space import LENS, PINHOLE, flat_board, poses_before, seen, with_corners

BOARD = flat_board()
CONFIG = CalibrationConfig(lens="opencv4", reject=False)


def calibrated(views, config=CONFIG):
    found = calibrate(BOARD, views, config)
    assert not isinstance(found, Rejected), found
    return found


def held(views, config=CONFIG, **how):
    result = hold_out(BOARD, calibrated(views, config), config, rng=np.random.default_rng(0), **how)
    assert not isinstance(result, Rejected), result
    return result


def test_a_right_model_is_hardly_worse_on_views_that_it_has_not_seen(rng):
    result = held(seen(LENS, BOARD, poses_before(LENS, 20, rng), rng))
    assert 1.0 < result.rms_px / result.training_rms_px < 1.05


def test_every_view_is_held_out_once_whatever_the_folds(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 9, rng), rng)
    for folds in (3, 9, 50):
        result = held(views, folds=folds)
        assert result.names == tuple(view.name for view in views)
        assert np.all(np.isfinite(result.squares))


def test_errors_that_views_share_within_are_seen_by_held_out_views(rng):
    """As corners that were refined with a window beyond their neighbours: they deform every view differently."""
    views = []
    for view in seen(LENS, BOARD, poses_before(LENS, 10, rng), rng):
        u, v = (view.points2D / [1280, 960] - 0.5).T
        bowed = np.stack([u * v * rng.normal(), u * u * rng.normal()], 1) * 8
        views.append(with_corners(view, view.points2D + bowed))
    result = held(views, dataclasses.replace(CONFIG, lens="opencv8"), folds=10)
    assert result.rms_px > 1.05 * result.training_rms_px


def test_a_pose_alone_fits_views_of_the_true_camera_to_the_noise(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 20, rng), rng)
    found = dataclasses.replace(calibrated(views), camera=LENS)
    errors = pose_only_errors(found, gather(BOARD, views))
    counts = np.array([len(view.corner_ids) for view in views])
    expected = 2 * 0.01 * (1 - 6 / (2 * counts))
    assert np.mean(errors / expected) == pytest.approx(1.0, abs=0.1)


def test_too_few_views_to_hold_any_out_are_told(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 3, rng), rng)
    result = hold_out(BOARD, calibrated(views), CONFIG, rng=rng)
    assert isinstance(result, Rejected)
    assert result.reason == "too_few_views"


def test_halves_of_many_good_views_agree(rng):
    many = calibrated(seen(LENS, BOARD, poses_before(LENS, 60, rng), rng))
    few = calibrated(seen(LENS, BOARD, poses_before(LENS, 8, rng), rng))
    by_count = [split_half(BOARD, one, CONFIG, rng=np.random.default_rng(1)) for one in (many, few)]
    assert not any(isinstance(one, Rejected) for one in by_count)
    assert by_count[0].rms_px < 0.15
    assert by_count[0].rms_px < by_count[1].rms_px
    assert by_count[0].rms_px <= by_count[0].worst_px


def test_of_lens_models_the_true_one_is_chosen(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 16, rng), rng)
    ranked = choose_lens(BOARD, views, CONFIG, lenses=("pinhole", "simple_radial", "opencv4", "opencv5", "opencv8"))
    assert not isinstance(ranked, Rejected)
    assert ranked[0].lens == "opencv4"
    by_name = {row.lens: row for row in ranked}
    assert by_name["pinhole"].held_out_rms_px > 5 * ranked[0].held_out_rms_px
    assert by_name["pinhole"].differs_px > 1.0
    assert by_name["opencv5"].differs_px < 0.3
    assert ranked[0].differs_px < 1e-9


def test_without_distortion_no_coefficient_is_chosen(rng):
    views = seen(PINHOLE, BOARD, poses_before(PINHOLE, 16, rng), rng)
    ranked = choose_lens(BOARD, views, CONFIG, lenses=("opencv8", "opencv4", "pinhole"))
    assert not isinstance(ranked, Rejected)
    assert ranked[0].lens == "pinhole"


def test_a_choice_among_nothing_is_told(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 2, rng), rng)
    result = choose_lens(BOARD, views, CONFIG, lenses=("opencv4",))
    assert isinstance(result, Rejected)
    assert "too_few_views" in result.detail


def test_views_go_through_flat_columns_and_back(rng):
    views = seen(LENS, BOARD, poses_before(LENS, 3, rng), rng)
    roots = rng.normal(size=(len(views[1].corner_ids), 2, 2)) * 0.1 + 0.3 * np.eye(2)
    views[1] = dataclasses.replace(views[1], covariances=roots @ roots.swapaxes(1, 2))
    observations = gather(BOARD, views)
    again = gather(BOARD, views_of(observations))
    np.testing.assert_array_equal(again.points2D, observations.points2D)
    np.testing.assert_array_equal(again.rows, observations.rows)
    # The unit of weights is arbitrary; their ratios are not.
    ratio = again.roots[:, 0] / observations.roots[:, 0]
    np.testing.assert_allclose(again.roots, ratio[0] * observations.roots, rtol=1e-9, atol=1e-12)


def test_several_halvings_are_told_by_their_median(rng):
    found = calibrated(seen(LENS, BOARD, poses_before(LENS, 12, rng), rng))
    chance = np.random.default_rng(3)
    single = [split_half(BOARD, found, CONFIG, splits=1, rng=chance) for _ in range(5)]
    several = split_half(BOARD, found, CONFIG, splits=5, rng=np.random.default_rng(3))
    assert not isinstance(several, Rejected)
    assert several.splits == 5
    assert several.rms_px == np.median([one.rms_px for one in single])
    assert several.worst_px == np.median([one.worst_px for one in single])
