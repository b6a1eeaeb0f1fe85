from __future__ import annotations

import numpy as np
import pytest

from calib.refine import CalibrationConfig
from calib.turned_photos import turned_back, turned_photos
from sfm.core.cameras import Camera
from tests.calib.boards_in_space import FISHEYE, LENS, flat_board, poses_before, seen

BOARD = flat_board()
CENTRED = Camera("PINHOLE", 1280, 960, np.array([1050.0, 1050.0, 640.0, 480.0]))


@pytest.mark.parametrize("count", [4, 7])
@pytest.mark.parametrize(("camera", "lens"), [(LENS, "opencv4"), (FISHEYE, "fisheye")], ids=["opencv4", "fisheye"])
def test_photos_that_were_turned_in_their_files_are_named(camera, lens, count, rng):
    views = seen(camera, BOARD, poses_before(camera, 16, rng), rng)
    wrong = set(rng.permutation(16)[:count].tolist())
    mixed = [turned_back(view) if v in wrong else view for v, view in enumerate(views)]
    found = turned_photos(BOARD, mixed, CalibrationConfig(lens=lens))
    assert found is not None
    assert set(found.names) == {views[v].name for v in wrong}
    assert found.turned_back_rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    assert found.rms_px > 1.1 * found.turned_back_rms_px


@pytest.mark.parametrize(("camera", "lens"), [(LENS, "opencv4"), (FISHEYE, "fisheye"), (CENTRED, "opencv5")])
def test_of_photos_as_they_were_taken_none_is_named(camera, lens, rng):
    for count in (4, 8, 16):
        views = seen(camera, BOARD, poses_before(camera, count, rng), rng)
        assert turned_photos(BOARD, views, CalibrationConfig(lens=lens)) is None


def test_what_is_symmetric_cannot_be_told_and_is_not(rng):
    views = seen(CENTRED, BOARD, poses_before(CENTRED, 12, rng), rng)
    mixed = [turned_back(view) if v % 2 else view for v, view in enumerate(views)]
    assert turned_photos(BOARD, mixed, CalibrationConfig(lens="opencv4")) is None


def test_a_view_turned_twice_is_the_view(rng):
    (view,) = seen(LENS, BOARD, poses_before(LENS, 1, rng), rng)
    np.testing.assert_allclose(turned_back(turned_back(view)).points2D, view.points2D, atol=1e-9)
    np.testing.assert_array_equal(turned_back(view).corner_ids, view.corner_ids)
