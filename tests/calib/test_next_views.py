from __future__ import annotations

import numpy as np
import pytest

from calib.next_views import camera_uncertainty, suggest_views
from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.uncertainty import CalibrationCovariance, covariance
from sfm.core.cameras import Camera
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen

BOARD = flat_board()
COLUMNS = np.arange(8)


def calibrated(views) -> Calibration:
    found = calibrate(BOARD, views, CalibrationConfig(lens="opencv4", reject=False))
    assert isinstance(found, Calibration)
    return found


def shared_of(found: Calibration) -> np.ndarray:
    covariances = covariance(found)
    assert isinstance(covariances, CalibrationCovariance)
    return covariances.shared


@pytest.fixture
def few(rng):
    """A calibration from views in the middle of the image, and these."""
    views = seen(LENS, BOARD, poses_before(LENS, 6, rng, tilt=0.4, reach=0.05), rng)
    return calibrated(views), views


def test_suggested_views_keep_their_promise(few, rng):
    """With photos of the boards where they are suggested the camera is as certain as was foretold."""
    found, views = few
    suggested = suggest_views(found.camera, found.columns, shared_of(found), found.sigma_px, BOARD)
    assert len(suggested) == 3
    before = camera_uncertainty(found.camera, found.columns, shared_of(found))
    assert suggested[0].before_px == pytest.approx(before, rel=1e-6)
    assert suggested[2].after_px < suggested[1].after_px < suggested[0].after_px < 0.7 * before
    more = seen(LENS, BOARD, [view.cam_from_board for view in suggested], rng)
    more = [type(view)(f"next{k}", *[getattr(view, f) for f in ("width", "height", "corner_ids", "points2D")])
            for k, view in enumerate(more)]  # fmt: skip
    again = calibrated([*views, *more])
    after = camera_uncertainty(again.camera, again.columns, shared_of(again))
    assert after == pytest.approx(suggested[2].after_px * again.sigma_px / found.sigma_px, rel=0.1)


def test_they_are_worth_more_than_more_of_the_same(few, rng):
    found, _ = few
    suggested = suggest_views(found.camera, found.columns, shared_of(found), found.sigma_px, BOARD, count=1)
    same = seen(LENS, BOARD, poses_before(LENS, 7, rng, tilt=0.4, reach=0.05), rng)
    more = calibrated(same)
    assert suggested[0].after_px < camera_uncertainty(more.camera, more.columns, shared_of(more))


def test_suggested_boards_are_in_the_image_whole_and_apart(few):
    found, _ = few
    suggested = suggest_views(found.camera, found.columns, shared_of(found), found.sigma_px, BOARD)
    for view in suggested:
        assert np.all((view.points2D > 0) & (view.points2D < [LENS.width, LENS.height]))
        projected, valid = found.camera.project(view.cam_from_board @ BOARD)
        assert valid.all()
        np.testing.assert_allclose(projected, view.points2D, atol=1e-6)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        apart = np.linalg.norm(suggested[a].points2D - suggested[b].points2D, axis=1)
        assert np.sqrt(np.mean(apart**2)) > 0.15 * LENS.width


def test_words_name_the_side_that_is_near():
    camera = Camera("PINHOLE", 1280, 960, np.array([1000.0, 1000, 640, 480]))
    open_focal = np.diag([100.0, 100.0, 100.0, 100.0])
    for view in suggest_views(camera, range(4), open_focal, 0.1, BOARD, count=6):
        ranges = np.linalg.norm(view.cam_from_board @ BOARD, axis=1)
        near, middle = view.points2D[np.argmin(ranges)], view.points2D.mean(axis=0)
        for word, off in (("left", near[0] < middle[0]), ("top", near[1] < middle[1])):
            if f" {word}" in view.words.split("with its")[-1]:
                assert off
