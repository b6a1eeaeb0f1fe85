"""Points of a board that few photos show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_views import BoardView
from calib.uncertainty import CalibrationCovariance, covariance
from calib.uncertainty_corners import jackknife
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen

BOARD = flat_board(7, 5)
CONFIG = CalibrationConfig(lens="opencv4", shape="free")
RARE = 0


def photos(rng: np.random.Generator, showing: int, off_px: float = 0.0) -> list[BoardView]:
    """Of a board that is bent by 0.5 mm; so many show its first corner, the last of them somewhere else."""
    bent = BOARD + np.column_stack([0 * BOARD[:, :2], 5e-4 * (BOARD[:, 0] / BOARD[:, 0].max()) ** 2])
    views, left = [], showing
    for view in seen(LENS, bent, poses_before(LENS, 14, rng), rng, 0.1):
        shows = RARE in view.corner_ids and left > 0
        kept = (view.corner_ids != RARE) | shows
        points2D = view.points2D.copy()
        left -= shows
        if shows and left == 0:
            points2D[view.corner_ids == RARE] += [off_px, -off_px]
        views.append(dataclasses.replace(view, corner_ids=view.corner_ids[kept], points2D=points2D[kept]))
    assert left == 0
    return views


def calibrated(views: list[BoardView]) -> Calibration:
    found = calibrate(BOARD, views, CONFIG)
    assert isinstance(found, Calibration)
    return found


def doubts(found: Calibration, by_view: bool = False) -> CalibrationCovariance:
    known = covariance(found, by_view=by_view)
    assert isinstance(known, CalibrationCovariance)
    return known


def test_a_point_of_which_one_corner_is_left_does_not_move(rng):
    found = calibrated(photos(rng, 2, off_px=15.0))
    assert len(found.rejected_corners) >= 1
    assert found.observations.shown[RARE] < 2
    np.testing.assert_array_equal(found.shape.displacements[RARE], 0.0)
    assert found.converged


def test_a_wrong_corner_of_a_rare_point_costs_the_camera_nothing(rng):
    views = photos(rng, 2, off_px=15.0)
    without = [
        dataclasses.replace(v, corner_ids=v.corner_ids[v.corner_ids != RARE], points2D=v.points2D[v.corner_ids != RARE])
        for v in views
    ]
    found, plain = calibrated(views), calibrated(without)
    for k, name in enumerate(("fx", "fy", "cx", "cy")):
        apart = abs(found.camera.params[k] - plain.camera.params[k])
        assert apart < 0.5 * doubts(plain).deviations[name]
        assert doubts(found).deviations[name] == pytest.approx(doubts(plain).deviations[name], rel=0.05)


def test_a_point_that_two_photos_show_costs_no_deviation_by_views_but_its_own(rng):
    found = calibrated(photos(rng, 2))
    assert found.observations.shown[RARE] == 2
    known, plain = doubts(found, by_view=True), doubts(calibrated(photos(np.random.default_rng(0), 0)), by_view=True)
    by_view = known.deviations
    assert np.all(np.isfinite([by_view[name] for name in found.free_names]))
    assert any(np.isinf(value) for name, value in by_view.items() if name.startswith("shape"))
    assert np.all(np.isfinite(known.frame))
    assert np.all(np.isfinite(list(plain.deviations.values())))


def test_a_step_without_a_view_is_that_of_what_it_leaves_known(rng):
    """One number of three that only two views tell: left out it does not count, and the others are as without it."""
    J = rng.normal(size=(6, 4, 3))
    J[:4, :, 2] = 0.0
    J[4, :, 2] = [1.0, 0, 0, 0]
    J[5, :, 2] = 0.0
    J[5, 0, 2] = 1.0
    J[5, 0, :2] = J[4, 0, :2] = 0.0
    e = rng.normal(size=(6, 4))
    normal = J.reshape(-1, 3)
    e -= (normal @ np.linalg.lstsq(normal, e.ravel(), rcond=None)[0]).reshape(6, 4)
    reduced, scores = J.swapaxes(1, 2) @ J, np.einsum("vij,vi->vj", J, e)
    both = jackknife(reduced, scores, 2)
    less = jackknife(reduced[:, :2, :2], scores[:, :2], 2)
    assert both is not None
    assert less is not None
    np.testing.assert_allclose(both[0][:2, :2], less[0], rtol=1e-9)
    np.testing.assert_array_equal(both[1], False)
    one_tells = reduced.copy(), scores.copy()
    one_tells[0][5, 2] = one_tells[0][5, :, 2] = one_tells[1][4:, 2] = 0.0
    open_now = jackknife(*one_tells, 2)
    assert open_now is not None
    np.testing.assert_array_equal(open_now[1], [False, False, True])
    np.testing.assert_allclose(open_now[0][:2, :2], less[0], rtol=1e-9)
    assert jackknife(*one_tells, 3) is None
